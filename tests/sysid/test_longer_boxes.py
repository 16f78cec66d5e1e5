"""Fits of frictions: over longer boxes where a noise model learned it, without standstill, and of any width."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_benchmarks.public.emps import PositioningDrive
from nsde_torch.data import DataSet, RawRun, Run
from nsde_torch.recording import assemble
from nsde_torch.sysid import Identification, identify, identify_in_loop
from nsde_torch.sysid.regression import Regression, narrower, regression_of
from nsde_torch.sysid.standstill import moving
from nsde_torch.systems import System, make_system
from tests.helpers.machines import Array, simulated
from tests.helpers.sticking import STICKING, sticking_runs

STEP = 1e-3
GAIN, VISCOUS, DRY, PUSH = 0.02, 2.0, 0.3, 0.05


def axis(seconds: float, slip: float, seed: int) -> DataSet:
    """A carriage under a controller, whose friction gives way over `slip` [m] (Dahl), logged as users do."""
    rng = np.random.default_rng(seed)
    inner, n = 20, round(seconds / STEP)
    h, q, v, share = STEP / inner, 0.0, 0.0, 0.0
    legs = rng.uniform(0.3, 1.0, 2 * round(seconds)) * 0.15 * np.resize((1, 1, -1, -1), 2 * round(seconds))
    wanted = np.cumsum(np.repeat(legs, 500)[:n]) * STEP
    log = np.empty((n, 3))
    for k in range(n):
        force = 60.0 / GAIN * (30.0 * (wanted[k] - q) - v)
        log[k] = q, v, force
        for _ in range(inner):
            share += h * v / slip * (1.0 - share * np.sign(v))
            v += h * (GAIN * force - VISCOUS * v - DRY * share + PUSH)
            q += h * v
    place = filtfilt(*butter(4, 0.2), np.round(log[:, 0] / 1e-6) * 1e-6)
    x = np.stack((place, np.gradient(place, STEP)), 1)[50:-50]
    run = RawRun("axis", STEP * np.arange(len(x)), x, log[50:-50, 2:])
    return assemble([run], PositioningDrive(), kind="simulated")


def identified(data: DataSet, **further: Any) -> Identification:
    system = PositioningDrive(["coulomb_friction", "constant_force"])
    return identify_in_loop(system, data.runs, **further)


@pytest.mark.slow
def test_a_friction_that_the_noise_model_learned_comes_out_of_longer_boxes() -> None:
    found = identified(axis(14.0, slip=5e-4, seed=3))
    assert found.finer.guard is not None
    label = found.vector.labels.index
    dry = label("coulomb_friction.size")
    true = {label("force_gain"): GAIN, label("viscous_friction.damping"): VISCOUS, dry: DRY}
    true[label("constant_force.acceleration")] = PUSH
    errors = {j: abs(found.values[j] / value - 1.0) for j, value in true.items()}
    assert abs(found.finer.values[dry] / DRY - 1.0) > 0.3 > 0.15 > max(errors.values())
    assert np.isnan(found.finer.half_widths(0.9)).all()
    assert found.box_s == pytest.approx(0.05)
    assert found.believed
    assert (found.half_widths(0.9)[found.shown.known] > found.doubt[found.shown.known]).all()
    (warning,) = found.warnings
    assert "means over 0.05 s are fitted" in warning
    assert "least squares" in warning
    told = found.as_dict()["finer"]
    assert told["box_s"] == pytest.approx(0.01)
    assert told["guard"]["objections"][0]["kind"] == "least_squares"


def test_a_friction_that_is_as_declared_needs_none() -> None:
    assert identified(axis(8.0, slip=1e-5, seed=4)).finer is None


@pytest.mark.slow
def test_a_diagnosis_looks_at_rows_further_apart_where_only_these_are_as_predicted() -> None:
    names = ("coulomb_friction", "constant_force", "asymmetric_friction", "cubic_stiffness")
    found = nsde_torch.diagnose(
        axis(28.0, slip=5e-4, seed=3), system=PositioningDrive, candidates=list(names)
    )
    assert found.added == ["coulomb_friction", "constant_force"]
    joint = found.outcome.joint
    assert joint.final.at.of.space.every == [10, 10]  # rows of 5 ms, as taken together
    assert not joint.final.best.misfit
    content = found.content()
    assert content["guard"]["objections"] == []
    # a friction that gives way is no function of the speed: its size is rough, and a lead
    assert content["parameters"]["coulomb_friction.size"]["value"] == pytest.approx(DRY, rel=0.5)
    assert all(f["lead"] for f in content["findings"])


SIZE = 1.4
TRUTH = {**STICKING, "coulomb_friction.size": SIZE}


@pytest.fixture(scope="module")
def system() -> System:
    return make_system("mass_spring_damper", effects=["coulomb_friction"])


@pytest.mark.slow
def test_physics_of_a_machine_that_sticks_is_right_where_it_moves(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, true = assemble(sticking_runs(SIZE), system, kind="test"), list(TRUTH.values())
    found = identify_in_loop(system, data.runs)
    at = [found.vector.labels.index(name) for name in TRUTH]
    assert (np.abs(found.values[at] - true) < 1.5 * found.half_widths(0.9)[at]).all()
    assert found.values[at] == pytest.approx(true, rel=0.03)
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


def test_a_width_goes_on_below_the_bound_of_the_search_and_the_size_is_right(system: System) -> None:
    """A mass on a spring that mostly moves at 2 m/s, and turns round within 4 mm/s."""
    size, runs = 0.6, []

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], u[0] - 2.0 * x[0] - 0.3 * x[1] - size * np.tanh(x[1] / 0.004)]

    for k in range(2):
        rng, t = np.random.default_rng(k), 0.01 * np.arange(1000)
        waves = t[:, None] * (0.9, 2.3, 3.1) + rng.uniform(0.0, 6.3, 3)
        force = np.sin(waves) @ np.array([[2.0], [2.0], [1.5]])
        runs.append(simulated(k, rates, [0.0, 0.5], force, 0.01, noise=1e-4, rng=rng, fine=50))
    within = regression_of(system, assemble(runs, system, kind="test").runs)
    within.run(20)
    dry, width = (within.vector.labels.index(f"coulomb_friction.{name}") for name in ("size", "width"))
    bound = within.vector.low[width]
    assert within.theta[width] == pytest.approx(bound, rel=1e-3)

    def off(fit: Regression) -> float:
        """Distance of the size from the truth in standard errors."""
        basis = fit.shown.basis
        error = np.sqrt((basis @ fit.spread().covariance @ basis.T)[dry, dry])
        return float(abs(fit.theta[dry] - size) / error)

    found = narrower(within, 20)
    assert found.theta[width] < 0.75 * bound
    assert off(within) > 2.5
    assert off(found) < 1.5
