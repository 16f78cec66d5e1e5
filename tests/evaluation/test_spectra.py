"""Laws of residuals are recovered from noise whose parts are known."""

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

from nsde_torch.effects import Port
from nsde_torch.evaluation.one_step import Disturbance, fit, spectrum
from nsde_torch.inference.steps import steps_of
from nsde_torch.sysid.noise import Series
from nsde_torch.sysid.physics import Physics
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.inference.springs import rubbing, small_runs

H, N = 0.01, 6000


def residual(seed: int, *, std: float, tau: float, sigma: float, sensor: float) -> np.ndarray:
    """Exact Ornstein-Uhlenbeck force, diffusion and differences of a sensor's errors."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-H / tau)
    push = std * np.sqrt(1 - keep**2) * rng.standard_normal(N + 2000)
    force = lfilter([1.0], [1.0, -keep], push)[2000:]
    error = sensor * rng.standard_normal(N + 1)
    return np.asarray(H * force + sigma * H**0.5 * rng.standard_normal(N) + np.diff(error))


def test_force_diffusion_and_sensor_are_told_apart() -> None:
    truth = {"std": 0.6, "tau": 0.3, "sigma": 0.1, "sensor": 0.02}
    series = Series(((0, N),))
    found = [
        fit(spectrum(residual(s, **truth)[:, None], series, H), lasting=True, shortest=0.1) for s in range(8)
    ]
    for name, value in (("std", 0.6), ("diffusion", 0.1), ("sensor", 0.02)):
        values = [getattr(law, name) for law in found]
        assert np.mean(values) == pytest.approx(value, rel=0.12), name
    assert np.median([law.tau for law in found]) == pytest.approx(0.3, rel=0.35)


def test_a_force_without_a_state_moves_the_machine_as_far_over_a_window() -> None:
    law = Disturbance(0.1, 0.6, 0.3, 0.02)
    rng = np.random.default_rng(0)
    keep, steps = np.exp(-H / 0.3), 100
    push = 0.6 * np.sqrt(1 - keep**2) * rng.standard_normal((4000, 2000 + steps))
    force = lfilter([1.0], [1.0, -keep], push, axis=1)[:, 2000:]
    moved = H * force.sum(1) + 0.1 * np.sqrt(H * steps) * rng.standard_normal(4000)
    plain = law.without_memory(H * steps)
    assert plain.std == 0.0
    assert plain.diffusion * (H * steps) ** 0.5 == pytest.approx(moved.std(), rel=0.05)


def test_a_sensor_alone_is_not_taken_for_a_diffusion() -> None:
    series = Series(tuple((k * 500, k * 500 + 500) for k in range(4)))
    for seed in range(5):
        r = residual(seed, std=1e-9, tau=1.0, sigma=1e-9, sensor=0.01)[:2000, None]
        law = fit(spectrum(r, series, H), lasting=False, shortest=0.1)
        assert law.sensor == pytest.approx(0.01, rel=0.1)
        assert law.diffusion < 0.1 * 0.01 / H**0.5 * 0.3


def test_a_force_beside_physics_leaves_what_the_declared_law_leaves() -> None:
    runs = small_runs(rubbing(0.2), 2, 6.0, seed=3)
    values = {"quadratic_damping.damping": 3.0}

    def physics(*effects: str) -> Physics:
        system = make_system("mass_spring_damper", effects=list(effects), values=values if effects else {})
        return Physics(ParameterVector(system), steps_of(system, runs, clock=1.0, smooth=False))

    def law(x: torch.Tensor) -> Mapping[Port, torch.Tensor]:
        return {Port.FORCE: -3.0 * x[:, 1:] * x[:, 1:].abs()}

    declared, plain = physics("quadratic_damping"), physics()
    beside = plain.beside(law)
    theta, own = declared.vector.start, plain.vector.start
    assert beside.residual(own) == pytest.approx(declared.residual(theta), abs=1e-12)
    assert beside.middle(own).numpy() == pytest.approx(declared.middle(theta).numpy(), abs=1e-12)
    # where networks would be asked instead
    assert abs(plain.middle(own) - declared.middle(theta)).max() > 0.05
