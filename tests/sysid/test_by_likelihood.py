"""Values of largest likelihood, from all sensors and from positions alone: the truth is in their intervals."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

from nsde_torch.data import DataSet, RawRun
from nsde_torch.recording import assemble
from nsde_torch.sysid.guard import Guarded, Objection
from nsde_torch.sysid.identify import by_likelihood, identify_in_loop
from nsde_torch.systems import System, make_system
from tests.helpers.encoders import DT, SPRING, TRUTH, encoder_runs

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "blind"))
from two_joints import make_data


def spring(rate: str, **options: Any) -> tuple[System, DataSet]:
    system = make_system("mass_spring_damper")
    return system, assemble(encoder_runs(rate, **options), system, kind="test")


@pytest.mark.slow
def test_intervals_hold_the_truth_over_seeds() -> None:
    inside = []
    for seed in range(6):
        system, data = spring("none", seed=seed, friction=0.0, runs=3, seconds=8.0)
        found = identify_in_loop(system, data.runs)
        at = [found.vector.labels.index(name) for name in TRUTH]
        assert np.isfinite(found.standard_errors[at]).all()
        inside += (np.abs(found.values[at] - list(TRUTH.values())) < found.half_widths(0.9)[at]).tolist()
    assert 13 <= sum(inside) <= 18  # 90 % of 18, by chance fewer than 13 once in a hundred


@pytest.mark.slow
def test_of_two_joints_the_likelihood_is_nearer_than_physics_at_inferred_rates() -> None:
    damping, runs, rng = 0.002, [], np.random.default_rng(1)

    def friction(q: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.array([0.0, -damping * abs(w[1]) * w[1]])

    for k in range(3):
        table = make_data.kept(900, np.random.default_rng(k), friction, 0.0)
        x = np.column_stack([table[:, :2] + 1e-3 * rng.standard_normal((900, 2)), np.full((900, 2), np.nan)])
        runs.append(RawRun(f"run_{k}", make_data.DT * np.arange(900) + 100.0 * k, x, table[:, 4:]))
    values = {"quadratic_damping[q2].damping": 0.003}
    system = make_system("double_pendulum:DoublePendulum", effects=["quadratic_damping[q2]"], values=values)
    data = assemble(runs, system, kind="test")
    found = identify_in_loop(system, data.runs)
    j = found.vector.labels.index("quadratic_damping[q2].damping")
    assert found.likelihood.theta[j] == pytest.approx(damping, rel=1e-3)
    assert found.values[j] == pytest.approx(damping, rel=5e-3)


def test_a_fit_that_simple_ones_speak_against_stays_as_it_is() -> None:
    system, data = spring("sensor", runs=1)
    found = identify_in_loop(system, data.runs, likelihood=False)
    assert found.likelihood is None
    objection = Objection("worse", "it leaves more", "look at the columns")
    doubted = replace(found, guard=replace(Guarded(), objections=(objection,)))
    assert by_likelihood(doubted, system, data.runs) is doubted


def test_innovations_that_are_not_white_leave_the_values_of_the_regression_and_say_why() -> None:
    system, data = spring("sensor", runs=2)
    b, a = butter(2, 3.0, fs=1.0 / DT)
    slow = [replace(run, x=np.column_stack([run.x[:, 0], filtfilt(b, a, run.x[:, 1])])) for run in data.runs]
    found = identify_in_loop(system, slow, likelihood=False)
    kept = by_likelihood(replace(found, guard=None), system, slow)
    assert not kept.likelihood_used
    assert kept.values is found.values
    said = kept.as_dict()["likelihood"]
    assert not said["used"]
    assert any("q_dot" in sentence for sentence in said["objections"])


def _lagging(tau: float) -> list[RawRun]:
    """Springs whose force lags by a time constant, by small steps of Euler's rule."""
    out, fine = [], 20
    h = DT / fine
    for k in range(3):
        rng = np.random.default_rng(k)
        u = np.repeat(rng.uniform(-2.0, 2.0, 40), 40)
        q, v, m, rows = 0.3, 0.0, float(u[0]), []
        for now in u:
            rows.append(q)
            for _ in range(fine):
                m += h * (now - m) / tau
                v += h * (SPRING["g"] * m - SPRING["k"] * q - SPRING["b"] * v)
                q += h * v
        x = np.column_stack([np.array(rows) + 1e-3 * rng.standard_normal(len(u)), np.full(len(u), np.nan)])
        out.append(RawRun(f"run_{k}", DT * np.arange(len(u)) + 100.0 * k, x, u[:, None]))
    return out


@pytest.mark.slow
def test_a_lag_that_lasts_longer_than_a_piece_is_remembered() -> None:
    system = make_system("mass_spring_damper", effects=["actuator_lag"])
    data = assemble(_lagging(1.0), system, kind="test")
    found = identify_in_loop(system, data.runs)
    j = found.vector.labels.index("actuator_lag.time_constant")
    half = found.half_widths(0.99)[j]
    assert half < 0.05
    assert abs(found.values[j] - 1.0) < half
