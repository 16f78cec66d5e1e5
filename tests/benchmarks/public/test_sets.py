"""Each set from files in its layout to rows, and what is found where the truth is known."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from nsde_benchmarks.public import BENCHMARKS, nanobench, nanodrone, run_benchmark
from nsde_benchmarks.public.nanobench import FLIGHTS, THRUST_MODELS, BatteryFlight, NanoBench, read_flight
from nsde_benchmarks.public.output_error import output_error, simulated, windows
from nsde_benchmarks.public.running import listing, table
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError
from nsde_torch.systems import System, make_system

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


def test_motors_are_put_in_the_order_of_the_package(tmp_path: Path) -> None:
    head = "t,x,y,z,vx,vy,vz,qx,qy,qz,qw,wx,wy,wz,m1_rads,m2_rads,m3_rads,m4_rads"
    rows = np.random.default_rng(0).uniform(0.1, 1.0, (160, 18))
    rows[:, 7:11] /= np.linalg.norm(rows[:, 7:11], axis=1, keepdims=True)
    np.savetxt(tmp_path / "melon.csv", rows, delimiter=",", header=head, comments="")
    x, u = nanodrone._read(tmp_path / "melon.csv")
    assert np.allclose(u, (rows[:, [14, 16, 17, 15]] / nanodrone.SPEED) ** 2)
    assert np.allclose(x[:, 6], rows[:, 10])  # the scalar part comes first


TRUTH = {"force_gain": 1.3, "linear_spring.stiffness": 9.0, "viscous_friction.damping": 0.4}


def _spring(values: dict[str, float], *effects: str) -> System:
    return make_system("mass_spring_damper", effects=effects, values=values).double()


def _measured(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(10), 20)[None, :, None]
    truth = _spring({**TRUTH, "cubic_stiffness.stiffness": 5.0}, "cubic_stiffness")
    x = simulated(truth, np.array([[0.3, 0.0]]), u, dt=0.02)[0]
    return x + noise * rng.standard_normal(x.shape), u[0]


def test_the_cost_never_rises_and_what_is_fixed_stays() -> None:
    x, u = _measured(1e-3)
    system = _spring({"force_gain": 1.1})
    data = windows([x], [u], dt=0.02, length=60, stride=40)
    how = {"fixed": ("force_gain",), "groups": ((0,), (1,)), "iterations": 6}
    made = output_error(system, data, weights=np.array([100.0, 10.0]), **how)
    assert made.values["force_gain"] == pytest.approx(1.1)
    assert made.cost[-1] < made.cost[0]


def test_windows_longer_than_every_run_are_refused() -> None:
    x, u = _measured()
    with pytest.raises(DataError, match=r"the longest has 201"):
        windows([x], [u], dt=0.02, length=300)


def _record(rows: int = 400) -> BatteryFlight:
    rng = np.random.default_rng(1)
    t = 0.01 * np.arange(rows)
    u = 0.7 + 0.1 * rng.random((rows, 4))
    voltage = 4.0 - 0.1 * t + 0.05 * rng.standard_normal(rows)
    gain = 11.0 * (1.0 + 0.5 * (voltage - 4.0) + 0.2 * (voltage - 4.0) ** 2)
    return BatteryFlight("made", t, np.zeros((rows, 13)), u, voltage, gain * (u**2).sum(1))


def test_the_model_of_the_voltage_is_exact_where_thrust_follows_it_and_the_others_are_not() -> None:
    record = _record()
    true = record.vertical[record.split :]
    left = {name: float(np.abs(model(record) - true).max()) for name, model in THRUST_MODELS.items()}
    assert left.pop("voltage-conditioned") < 1e-6
    assert min(left.values()) > 0.05


def test_nothing_of_the_test_part_is_used() -> None:
    record = _record()
    other = replace(record, vertical=record.vertical.copy())
    other.vertical[record.split :] = 0.0
    for model in THRUST_MODELS.values():
        assert np.array_equal(model(record), model(other))


def test_rows_on_which_the_motors_stand_are_left_out_and_motors_are_in_order(
    nanobench_folder: Path, tmp_path: Path
) -> None:
    path = nanobench_folder / f"{FLIGHTS[0]}.csv"
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    rows[:100, 14] = 0.0
    rows[:, 15:18] *= [0.5, 0.6, 0.7]
    changed = tmp_path / path.name
    np.savetxt(changed, rows, delimiter=",", header=",".join(nanobench.COLUMNS), comments="")
    flight = read_flight(changed)
    assert len(flight.t) == len(rows) - 100
    assert flight.u == pytest.approx(rows[100:, [14, 16, 17, 15]] / 65535.0)
    assert flight.split == int(0.7 * len(flight.t))
    assert (flight.training().x[:, 2] > nanobench.AIRBORNE).all()


def test_the_voltage_explains_what_the_rigid_body_does_not(
    nanobench_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    diagnosed: Callable[..., list[RawRun]],
) -> None:
    files = tuple(f"datasets/dataset/{name}.csv" for name in FLIGHTS[:3])
    monkeypatch.setattr(NanoBench, "files", files)
    monkeypatch.setattr(nanobench, "DIAGNOSED", FLIGHTS[:1])
    monkeypatch.setattr(nanobench, "read", partial(nanobench.read, state_smoothing="keep"))
    monkeypatch.setattr(nanobench, "RUNGS", ((), ("battery_voltage",)))
    hidden = {"roll_gain": {"value": 5e-5, "interval_90": None, "unit": "rad/s2"}}
    lead = [{"name": "battery_voltage", "lead": True}]
    logs = diagnosed("battery_voltage", declared_parameters=hidden, findings=lead)
    content = run_benchmark("nanobench", nanobench_folder, out_dir=tmp_path)
    assert [log.name for log in logs] == [FLIGHTS[0]]
    assert all("battery_voltage" in log.extra for log in logs)
    assert content["found"][1:] == ["Provisional: battery_voltage.", "Not shown by the data: roll_gain."]
    assert content["ratio_to_best_published"] == {}  # what was published is of another flight
    rows = content["ours"]
    assert rows["voltage-conditioned, fitted here"]["rmse"] < rows["constant gain, fitted here"]["rmse"]
    assert rows["ours, quadrotor + battery_voltage"]["rmse"] < 0.8 * rows["ours, quadrotor"]["rmse"]
    wrong = content["details"]["with_gravity_as_in_the_compiled_script"]
    assert wrong["constant gain"]["rmse"] > 5.0  # gravity is off on one side alone
    assert wrong["linear regression"] == rows["linear regression, fitted here"]
    assert content["parameters"]["all flights: battery_voltage.sensitivity"]["value"] > 0.1
