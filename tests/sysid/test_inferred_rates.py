"""Friction of logs whose rate no sensor measured is right, and its interval holds; a difference of rows bends it."""

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.recording import assemble
from nsde_torch.sysid import regression
from nsde_torch.sysid.identify import identify_in_loop, with_rates
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import make_system
from tests.helpers.encoders import TRUTH, encoder_runs

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


def test_a_log_with_a_sensor_is_left_alone() -> None:
    system = make_system("mass_spring_damper")
    data = assemble(encoder_runs("sensor", runs=1), system, kind="test")
    assert with_rates(system, data.runs)[0] is data.runs[0]


def test_rates_that_diverge_between_rows_are_refused_with_what_to_record() -> None:
    stiff = make_system("mass_spring_damper", values={"linear_spring.stiffness": 400.0})
    t = 0.5 * np.arange(60)
    run = Run("r", t, np.stack([np.sin(t), np.cos(t)], 1), np.zeros((60, 1)), inferred={"q_dot": 0.1})
    with pytest.raises(DataError, match=r"q_dot cannot be inferred from q: over steps of 0\.5 s .* diverges"):
        with_rates(stiff, [run])


def test_slopes_that_cannot_be_squared_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(regression, "_UNBOUNDED", 1e-6)
    with pytest.raises(NonFiniteError, match="grows without bound"):
        _identified("sensor")
