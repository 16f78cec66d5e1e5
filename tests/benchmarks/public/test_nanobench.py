"""NanoBench: read, split and scored as its protocol says, on small files whose thrust follows a voltage."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from nsde_benchmarks.public import nanobench, run_benchmark
from nsde_benchmarks.public.nanobench import (
    FLIGHTS,
    THRUST_MODELS,
    NanoBench,
    VerticalRecord,
    read_flight,
)
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError


def _record(rows: int = 400) -> VerticalRecord:
    rng = np.random.default_rng(1)
    t = 0.01 * np.arange(rows)
    u = 0.7 + 0.1 * rng.random((rows, 4))
    voltage = 4.0 - 0.1 * t + 0.05 * rng.standard_normal(rows)
    gain = 11.0 * (1.0 + 0.5 * (voltage - 4.0) + 0.2 * (voltage - 4.0) ** 2)
    return VerticalRecord(t, u, voltage, gain * (u**2).sum(1))


def test_the_model_of_the_voltage_is_exact_where_thrust_follows_it_and_the_others_are_not() -> None:
    record, split = _record(), 280
    true = record.vertical[split:]
    left = {name: float(np.abs(model(record, split) - true).max()) for name, model in THRUST_MODELS.items()}
    assert left.pop("voltage-conditioned") < 1e-6
    assert min(left.values()) > 0.05


def test_nothing_of_the_test_part_is_used() -> None:
    record, split = _record(), 280
    other = VerticalRecord(record.t, record.u, record.voltage, record.vertical.copy())
    other.vertical[split:] = 0.0
    for model in THRUST_MODELS.values():
        assert np.array_equal(model(record, split), model(other, split))


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


def test_cut_and_foreign_files_are_refused(nanobench_folder: Path, tmp_path: Path) -> None:
    path = nanobench_folder / f"{FLIGHTS[0]}.csv"
    lines = path.read_text().splitlines()
    cut = tmp_path / path.name
    cut.write_text("\n".join(lines[:100]) + "\n")
    with pytest.raises(DataError, match="has 99 rows, and the protocol needs 200"):
        read_flight(cut)
    cut.write_text("\n".join(lines).replace("pwr_pm_vbat", "volts"))
    with pytest.raises(DataError, match="lacks the columns pwr_pm_vbat: it is not of NanoBench"):
        read_flight(cut)
