"""A machine with an attitude: a flight of the simulated hexacopter is fitted."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from nsde_torch.data import Run
from nsde_torch.inference import fit, log_likelihood
from nsde_torch.inference.levels import Levels
from nsde_torch.recording import assemble
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system


def flight(seconds: float) -> tuple[Sequence[Run], dict[str, float]]:
    """A flight of the declared physics alone, and its true values."""
    made = simulate("hexacopter", seed=1, durations=[seconds], declared_only=True)
    data = assemble(list(made.runs), make_system("hexacopter"), kind="test")
    return data.runs, {name: told["value"] for name, told in made.truth["declared"].items()}


@pytest.mark.slow
def test_a_flight_settles_near_the_simulated_gains() -> None:
    (run,), truth = flight(12.0)
    found = fit(make_system("hexacopter"), [run])
    assert found.settled
    assert np.isfinite(found.likelihood)
    assert np.isfinite(found.theta).all()
    assert np.isfinite(found.levels.vector().numpy()).all()
    assert len(found.channels) == 12  # an attitude is three of them, not four
    assert found.objections == []
    values = dict(zip(found.vector.labels, found.theta, strict=True))
    for name in ("thrust_gain", "roll_gain", "pitch_gain", "yaw_gain"):
        assert values[name] == pytest.approx(truth[name], rel=0.2)
    assert list(found.free) == list(range(len(found.theta)))
    assert (found.standard_errors[found.free] < np.abs(found.theta[found.free])).all()


@pytest.mark.slow
def test_the_likelihood_asks_for_the_attitude_and_not_for_the_sign_of_its_quaternion() -> None:
    (run,), truth = flight(4.0)
    system = make_system("hexacopter", values=truth)
    turned = np.array(run.x)
    assert system.quaternion is not None
    turned[:, system.quaternion] *= -1.0
    sensor = [1e-3] * 3 + [1e-2] * 3 + [3.5e-3] * 3 + [2e-2] * 3
    levels = Levels(
        torch.tensor(sensor, dtype=torch.float64).log(),
        *(torch.full((6,), np.log(size), dtype=torch.float64) for size in (0.01, 0.3, 0.3)),
    )
    expected = log_likelihood(system, [run], levels=levels)
    assert log_likelihood(system, [replace(run, x=turned)], levels=levels) == pytest.approx(expected)
