"""Each set from files in its layout to rows, and what is found where the truth is known."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from nsde_benchmarks.public import BENCHMARKS, nanodrone, run_benchmark, silverbox
from nsde_benchmarks.public.output_error import machine, simulated
from nsde_benchmarks.public.running import listing, table
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError

pytestmark = pytest.mark.drawn


def test_every_set_says_what_to_fetch_and_how_it_is_scored() -> None:
    text = "\n".join(listing())
    for name, cls in BENCHMARKS.items():
        assert name == cls.name
        assert cls.repository in text
        assert cls.repository.count("/") == 1
        known = {metric.key for metric in cls.metrics}
        for row in cls.published:
            assert set(row.values) <= known
            assert row.source


@pytest.mark.slow
def test_the_drive_is_found_and_the_second_call_keeps_the_stages(emps_folder: Path, tmp_path: Path) -> None:
    told: list[str] = []
    content = run_benchmark("emps", emps_folder, out_dir=tmp_path, tell=told.append)
    assert not told
    assert any("friction" in name for name in content["effects"])
    assert content["parameters"]["mass"]["value"] == pytest.approx(90.0, rel=0.02)
    assert content["ours"]["ours, output error"]["r2"] > 0.99
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "benchmark.json").read_text()) == content
    assert run_benchmark("emps", emps_folder, out_dir=tmp_path, tell=told.append) == content
    assert "kept from before: diagnosis" in told
    lines = table(content, BENCHMARKS["emps"].metrics)
    assert lines[0].split() == ["r2", "rmse", "[mm]"]
    assert any(line.startswith("linear models") and line.endswith("-") for line in lines)


def test_the_pendulum_is_found(pendulum_folder: Path, tmp_path: Path) -> None:
    content = run_benchmark("pendulum", pendulum_folder, out_dir=tmp_path)
    assert content["parameters"]["inertia"]["value"] == pytest.approx(1 / 8.0, rel=0.05)
    error = {name: row["angle"] for name, row in content["ours"].items()}
    assert error["ours, output error"] < 0.1 * error["published parameters, simulated here"]


@pytest.mark.slow
def test_the_cubic_spring_is_found_from_the_output_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = {
        "ARROW": slice(20, 420),
        "INSIDE": 300,
        "MULTISINE": slice(440, 1640),
        "SKIPPED": 20,
        "WINDOW": 40,
    }
    for name, value in {**sizes, "STRETCHES": 5, "CANDIDATES": ("cubic_stiffness",)}.items():
        monkeypatch.setattr(silverbox, name, value)
    t = silverbox.STEP * np.arange(1700)
    rng = np.random.default_rng(3)
    u = sum(0.02 * np.cos(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (20.0, 41.0, 63.0, 80.0, 97.0))
    values = {"linear_spring.stiffness": 1.8e5, "viscous_friction.damping": 42.0}
    values["cubic_stiffness.stiffness"] = 7e5
    truth = machine(silverbox.SilverboxCircuit, ["cubic_stiffness"], values)
    fine = silverbox._finer(u)[None, :, None]
    y = simulated(truth, np.zeros((1, 2)), fine, dt=silverbox.STEP, finer=silverbox.FINER)
    noisy = y[0, :1700, 0] + 1e-5 * rng.standard_normal(1700)
    savemat(tmp_path / "SNLS80mV.mat", {"V1": u[None], "V2": noisy[None]})
    content = run_benchmark("silverbox", tmp_path, out_dir=tmp_path / "out")
    assert content["effects"] == ["cubic_stiffness"]
    assert content["parameters"]["cubic_stiffness.stiffness"]["value"] == pytest.approx(7e5, rel=0.02)
    linear, found = (row["arrow"] for row in content["ours"].values())
    assert found < 0.05 < 0.2 * linear
    assert content["ratio_to_best_published"]["arrow"] == pytest.approx(found / 0.638965)
    savemat(tmp_path / "SNLS80mV.mat", {"V1": u[None, :900], "V2": y[None, 0, :900, 0]})
    with pytest.raises(DataError, match="has 900 rows, and the protocol needs 1640"):
        run_benchmark("silverbox", tmp_path, out_dir=tmp_path / "out2")


@pytest.mark.slow
def test_the_nano_drone_is_read_and_scored_as_its_protocol_says(
    nanodrone_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    diagnosed: Callable[..., list[RawRun]],
) -> None:
    monkeypatch.setattr(nanodrone, "TERMS", ("linear_drag",))
    monkeypatch.setattr(nanodrone, "RUNGS", (0, 1))
    monkeypatch.setattr(nanodrone, "ITERATIONS", 1)
    logs = diagnosed("flapping_moment")
    content = run_benchmark("nanodrone", nanodrone_folder, out_dir=tmp_path)
    assert len(logs) == 3
    assert list(content["ours"]) == ["ours, rigid body", "ours, linear_drag"]
    assert len(content["published"]) == 5
    last = content["ours"]["ours, linear_drag"]
    assert last["rates_h1"] < last["rates_h50"] < last["rates_sum"]
    assert set(content["ratio_to_best_published"]) == set(content["units"])


def test_motors_are_put_in_the_order_of_the_package(nanodrone_folder: Path) -> None:
    path = nanodrone_folder / "data" / "test" / "melon_20251017_run1.csv"
    x, u = nanodrone._read(path)
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    assert np.allclose(u, (rows[:, [14, 16, 17, 15]] / nanodrone.SPEED) ** 2)
    assert np.allclose(x[:, 6], rows[:, 10])  # the scalar part comes first
