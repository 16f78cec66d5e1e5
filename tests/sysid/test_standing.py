"""Rows in which dry friction holds the machine are left out, and physics is right without them."""

import numpy as np
import pytest

from nsde_torch.data import DataSet, Run
from nsde_torch.recording import assemble
from nsde_torch.sysid import identify
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.standstill import moving, slowest
from nsde_torch.systems import System, make_system
from tests.helpers.sticking import STICKING, sticking_runs

SIZE = 1.4
TRUTH = {**STICKING, "coulomb_friction.size": SIZE}


@pytest.fixture(scope="module")
def system() -> System:
    return make_system("mass_spring_damper", effects=["coulomb_friction"])


@pytest.fixture(scope="module")
def data(system: System) -> DataSet:
    return assemble(sticking_runs(SIZE), system, kind="test")


def _off(found: Identification) -> np.ndarray:
    """Distance from the truth in half-widths of 90 % intervals."""
    at = [found.vector.labels.index(name) for name in TRUTH]
    return np.abs(found.values[at] - list(TRUTH.values())) / found.half_widths(0.9)[at]


@pytest.mark.slow
def test_physics_of_a_machine_that_sticks_is_right_where_it_moves(
    system: System, data: DataSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = identify_in_loop(system, data.runs)
    assert (_off(found) < 1.5).all()
    at = [found.vector.labels.index(name) for name in TRUTH]
    assert found.values[at] == pytest.approx(list(TRUTH.values()), rel=0.03)
    assert found.as_dict()["standing_share"] == pytest.approx(found.standstill)
    assert f"{found.standstill:.0%} of the rows were left out" in found.notes[0]
    monkeypatch.setattr(identify, "SHARE", 2.0)
    bent = identify_in_loop(system, data.runs)
    assert not bent.standstill
    assert not any("left out" in note for note in bent.notes)
    assert bent.values[at[2]] < 0.7 * TRUTH["viscous_friction.damping"]


def test_rows_within_noise_of_a_standstill_and_of_a_turn_are_left_out() -> None:
    t = 0.01 * np.arange(400)
    v = np.where(t < 2.0, np.clip(2.0 * (t - 1.0), 0.0, 1.0), np.cos(np.pi * (t - 2.0)))
    run = Run("run", t, np.stack((np.cumsum(v) * 0.01, v), 1), np.zeros((400, 1)))
    (cut,), share = moving([run], {1: 0.02})
    assert share == pytest.approx(0.28, abs=0.03)
    assert cut.segments[0][0] == pytest.approx(100, abs=3)
    kept = np.concatenate([np.arange(a, b) for a, b in cut.segments])
    assert np.abs(v[kept]).min() > 0.02
    turns = np.flatnonzero(np.diff(np.sign(v[201:]))) + 201
    assert not set(turns) & set(kept)


def test_a_run_that_stands_throughout_stays() -> None:
    still = Run("still", 0.01 * np.arange(50), np.zeros((50, 2)), np.zeros((50, 1)))
    (kept,), share = moving([still], {1: 0.1})
    assert kept.segments == still.segments
    assert share == 0.0


def test_no_speed_is_slow_without_dry_friction_or_of_inferred_rates(data: DataSet) -> None:
    std = np.array([0.005, 0.005])
    dry = make_system("mass_spring_damper", effects=["coulomb_friction"])
    assert slowest(dry, std, data.runs) == {1: pytest.approx(0.015)}
    wet = make_system("mass_spring_damper", effects=["quadratic_damping"])
    assert slowest(wet, std, data.runs) == {}
    run = data.runs[0]
    inferred = Run(run.name, run.t, run.x, run.u, inferred={"q_dot": 0.01})
    assert slowest(dry, std, [inferred]) == {}
