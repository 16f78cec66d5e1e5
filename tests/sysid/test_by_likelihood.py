"""Values of largest likelihood, from all sensors, from positions alone, and where no sensor measured a rate."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nsde_torch.data import DataSet, RawRun, Run
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from nsde_torch.sysid.identify import identify_in_loop, with_rates
from nsde_torch.sysid.result import Identification
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


RUBBING = {**TRUTH, "coulomb_friction.size": 0.2}


def _identified(rate: str, *, policy: str = "infer", counts: bool = False, seed: int = 0) -> Identification:
    system = make_system("mass_spring_damper", effects=["coulomb_friction"])
    runs = encoder_runs(rate, counts=counts, seed=seed, seconds=20.0)
    data = assemble(runs, system, kind="test", derived_rates=policy)
    return identify_in_loop(system, data.runs)


def _off(found: Identification) -> np.ndarray:
    at = [found.vector.labels.index(name) for name in RUBBING]
    return np.abs(found.values[at] - list(RUBBING.values())) / found.half_widths(0.95)[at]


@pytest.mark.parametrize("counts", [False, True])
@pytest.mark.slow
def test_friction_is_right_from_positions_alone(counts: bool) -> None:
    found = _identified("none", counts=counts)
    assert found.believed
    assert (_off(found) < 1.6).all()
    size = found.vector.labels.index("coulomb_friction.size")
    assert found.values[size] == pytest.approx(0.2, abs=0.02)
    assert found.standard_errors[size] < 0.01


@pytest.mark.slow
def test_a_difference_of_rows_gives_the_same_as_no_rate_at_all() -> None:
    made, none = _identified("backward", seed=1), _identified("none", seed=1)
    assert np.abs(made.values - none.values).max() < 0.01 * np.abs(none.values).max()


@pytest.mark.slow
def test_kept_as_it_is_a_difference_of_rows_bends_the_estimate_or_is_not_believed() -> None:
    kept, right = (_identified("backward", policy=policy, seed=1) for policy in ("keep", "infer"))
    assert (_off(right) < 1.6).all()
    assert not kept.believed or (_off(kept) > 1.3).any()


def test_rates_with_physics_are_nearer_than_those_without() -> None:
    values = {**RUBBING, "coulomb_friction.width": 0.01}
    system = make_system("mass_spring_damper", effects=["coulomb_friction"], values=values)
    raw = encoder_runs("none", noise=5e-3)
    data = assemble(raw, system, kind="test")
    true = np.concatenate([run.x[:, 1] for run in encoder_runs("truth")])
    before, after = (
        np.concatenate([run.x[:, 1] for run in runs]) for runs in (data.runs, with_rates(system, data.runs))
    )
    assert np.std(after - true) < 0.7 * np.std(before - true)


def test_rates_that_diverge_between_rows_are_refused_with_what_to_record() -> None:
    stiff = make_system("mass_spring_damper", values={"linear_spring.stiffness": 400.0})
    t = 0.5 * np.arange(60)
    run = Run("r", t, np.stack([np.sin(t), np.cos(t)], 1), np.zeros((60, 1)), inferred={"q_dot": 0.1})
    with pytest.raises(DataError, match=r"q_dot cannot be inferred from q: over steps of 0\.5 s .* diverges"):
        with_rates(stiff, [run])
