"""What changes in the middle of a run is named with its moment and the sizes before and after it; a drift stays one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.diagnosis.reading import cut_at

DT = 0.01


def spring(seed: int, seconds: float, push: Any) -> Run:
    """A spring that is pushed by u and `push(t, v, u)` [m/s2]."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(round(seconds / DT) + 1)
    f, phase = rng.uniform(0.1, 1.6, (4, 1)), rng.uniform(0.0, 2.0 * np.pi, (4, 1))
    u = 1.2 * np.sin(2.0 * np.pi * f * t + phase).sum(0)
    rows, q, v = np.empty((len(t), 2)), 0.2, 0.0
    for k, (now, force) in enumerate(zip(t, u, strict=True)):
        rows[k] = q, v
        for _ in range(10):  # semi-implicit Euler, 1 ms
            v += 1e-3 * (force - 4.0 * q - 0.5 * v + push(now, v, force) + rng.normal(0.0, 0.05))
            q += 1e-3 * v
    return Run("run", t, rows + rng.normal(0.0, (0.002, 0.01), rows.shape), u[:, None])


def diagnosed(folder: Path, *runs: Run) -> dict[str, Any]:
    folder.mkdir()
    for r, run in enumerate(runs):
        columns = np.column_stack((run.t, run.x, run.u))
        np.savetxt(folder / f"run_{r}.csv", columns, "%.6f", ",", header="t,q,q_dot,force", comments="")
    few = ("coulomb_friction", "quadratic_damping", "actuator_gain_drift", "constant_force")
    return dict(nsde_torch.diagnose(folder, system="mass_spring_damper", candidates=few, say=False).content())


@pytest.mark.slow
def test_a_gain_that_falls_at_moments_of_two_runs_is_no_drift(tmp_path: Path) -> None:
    moments = (17.0, 12.5)
    runs = [
        spring(r, 30.0, lambda t, v, u, at=at: -0.25 * u * (t > at))
        for r, at in enumerate(moments)  # type: ignore[misc]
    ]
    content = diagnosed(tmp_path / "gain", *runs)
    name = "run_difference[force_gain]"
    assert content["added"] == [name]
    assert not any(f["lead"] for f in content["findings"])
    for (first, last), moment in zip(content["data"]["moments"].values(), moments, strict=True):
        assert first - 0.1 <= moment <= last + 0.1
        assert last - first < 2.0
        assert f"between {first:.2f} and {last:.2f} s" in content["summary"]
    own = [p for key, p in content["parameters"].items() if key.startswith(name)]
    gain = content["declared_parameters"]["force_gain"]["value"]
    # the reference is one of the parts
    values = sorted([gain, *(gain + p["value"] for p in own)])
    assert values == pytest.approx([0.75, 0.75, 1.0, 1.0], abs=0.02)


def test_friction_that_begins_in_a_single_run(tmp_path: Path) -> None:
    run = spring(5, 50.0, lambda t, v, u: -0.3 * np.tanh(v / 0.01) * (t > 22.0))
    content = diagnosed(tmp_path / "friction", run)
    name = "run_difference[coulomb_friction/size]"
    assert set(content["added"]) == {name, "coulomb_friction"}
    (size,) = (p for key, p in content["parameters"].items() if key.startswith(name))
    assert abs(size["value"]) == pytest.approx(0.3, abs=0.02)
    ((first, last),) = content["data"]["moments"].values()
    assert first - 0.1 <= 22.0 <= last + 0.1


@pytest.mark.slow
def test_a_gain_that_falls_all_the_time_stays_a_drift(tmp_path: Path) -> None:
    runs = [spring(7 + r, 40.0, lambda t, v, u: -0.006 * t * u) for r in range(2)]
    content = diagnosed(tmp_path / "drift", *runs)
    assert content["added"] == ["actuator_gain_drift"]
    assert content["data"]["moments"] == {}


def test_rows_between_the_two_times_are_in_neither_part() -> None:
    run = spring(1, 2.0, lambda t, v, u: 0.0)
    before, after = cut_at([run], {"run": (0.5, 0.8)})
    assert (before.name, after.name) == ("run before 0.50 s", "run from 0.80 s")
    assert (before.t[-1], after.t[0]) == (pytest.approx(0.49), pytest.approx(0.8))
    assert len(before) + len(after) == len(run) - 30
