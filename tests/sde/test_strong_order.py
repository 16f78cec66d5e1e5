"""Order of every step against closed forms, strong and of ordinary equations."""

import math

import pytest
import torch
from torchdiffeq import odeint

from nsde_torch.sde import STEPS, Time, brownian, coarsen, make_step, rollout
from tests.helpers.sde_problems import (
    DistanceAware,
    GeometricBrownianMotion,
    Problem,
    Quiet,
    SharedSum,
    SquareRoot,
    slope,
    strong_errors,
)

STOCHASTIC = [name for name, cls in STEPS.items() if not cls.deterministic]
FACTORS = (4, 8, 16, 32)


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *((GeometricBrownianMotion, name) for name in STOCHASTIC),
        *((SquareRoot, name) for name in ("euler_maruyama", "heun", "milstein_stratonovich_free")),
    ],
)
def test_step_has_the_strong_order_it_states_on_uncoupled_noise(name: str, kind: type[Problem]) -> None:
    step = make_step(name)
    errors = strong_errors(kind(calculus=step.calculus), step, paths=1500, finest=512, factors=FACTORS)
    assert slope(FACTORS, errors) == pytest.approx(step.strong_order, abs=0.15)


@pytest.mark.parametrize("name", ["milstein", "milstein_ito", "milstein_stratonovich"])
def test_milstein_is_exact_where_the_solution_is_quadratic_in_the_noise(name: str) -> None:
    step = make_step(name)
    assert max(strong_errors(SquareRoot(step.calculus), step, paths=1500, finest=64, factors=(1, 64))) < 1e-12


@pytest.mark.parametrize("name", [pytest.param("milstein_ito", marks=pytest.mark.slow), "milstein", "heun"])
def test_the_order_drops_to_half_on_coupled_noise(name: str) -> None:
    problem, step = DistanceAware(), make_step(name)
    g = torch.Generator().manual_seed(3)
    fine = brownian(1500, 1, 2048, 3, dt=1 / 2048, generator=g, dtype=torch.float64)
    z0 = torch.full((1, 3), 0.5, dtype=torch.float64)

    def end(factor: int) -> torch.Tensor:
        dw = coarsen(fine, factor)
        u = z0.new_zeros(1, dw.shape[2], 1)
        return rollout(problem, z0, u, dt=factor / 2048, step=step, noise=dw)[:, :, -1]

    reference, factors = end(1), (32, 64, 128, 256)
    errors = [float((end(factor) - reference).abs().mean()) for factor in factors]
    assert slope(factors, errors) == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize(
    ("name", "order"),
    [("milstein_heun", 2.0), ("heun", 2.0), ("milstein", 1.0), ("midpoint", 2.0), ("rk4", 4.0)],
)
def test_the_order_in_the_drift_where_there_is_no_noise(name: str, order: float) -> None:
    class Swing(Quiet):
        """theta'' = -sin(theta) + 0.3 cos(t) + u; deterministic steps do not ask for its diffusion."""

        def drift(self, t: Time, z: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            forcing = 0.3 * torch.cos(torch.as_tensor(t, dtype=z.dtype))
            return torch.stack((z[:, 1], u[:, 0] + forcing - torch.sin(z[:, 0])), -1)

        def diffusion(self, t: Time, z: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            assert not make_step(name).deterministic
            return super().diffusion(t, z, u)

    z0 = torch.tensor([[1.0, 0.0]], dtype=torch.float64)

    def end(steps: int) -> torch.Tensor:
        step, u = make_step(name), z0.new_full((1, steps, 1), 0.2)
        noise = None if step.deterministic else z0.new_zeros(1, 1, steps, 2)
        return rollout(Swing(), z0, u, dt=2 / steps, step=step, noise=noise)[0, 0, -1]

    u = torch.tensor([0.2], dtype=torch.float64)
    times = torch.tensor([0.0, 2.0], dtype=torch.float64)
    exact = odeint(lambda t, z: Swing().drift(t, z, u[None]), z0, times, rtol=1e-12, atol=1e-12)[-1, 0]
    errors = [float((end(n) - exact).abs().max()) for n in (20, 40, 80)]
    assert slope((1 / 20, 1 / 40, 1 / 80), errors) == pytest.approx(order, abs=0.15)
    assert not make_step(name).deterministic or make_step(name).strong_order == order


def test_milstein_heun_is_as_its_drift_where_noise_is_small_and_steps_are_long() -> None:
    problem = GeometricBrownianMotion(a=1.0, b=0.004)
    errors = {
        name: strong_errors(problem, make_step(name), paths=300, finest=64, factors=(4, 8))
        for name in ("milstein", "milstein_heun")
    }
    assert max(errors["milstein_heun"]) < 0.1 * min(errors["milstein"])
    assert errors["milstein_heun"][1] / errors["milstein_heun"][0] > 3.0  # four, of a second order


@pytest.mark.parametrize("name", STOCHASTIC)
def test_the_mean_on_coupled_noise_is_that_of_the_stated_calculus(name: str) -> None:
    step, steps = make_step(name), 64
    g = torch.Generator().manual_seed(6)
    noise = brownian(40000, 1, steps, 2, dt=1 / steps, generator=g, dtype=torch.float64)
    z0, u = torch.full((1, 2), 0.5, dtype=torch.float64), torch.zeros(1, steps, 1, dtype=torch.float64)
    mean = rollout(SharedSum(0.5), z0, u, dt=1 / steps, step=step, noise=noise)[:, 0, -1].sum(-1).mean()
    assert float(mean) == pytest.approx(1.0 if step.calculus == "ito" else math.exp(0.25), rel=0.02)
