"""Strong order of every step on one Brownian path coarsened by summing, against closed forms."""

import pytest
import torch

from nsde_torch.sde import STEPS, brownian, coarsen, make_step, rollout
from tests.helpers.sde_problems import (
    DistanceAware,
    GeometricBrownianMotion,
    Problem,
    SquareRoot,
    Tangent,
    slope,
    strong_errors,
)

STOCHASTIC = [name for name, cls in STEPS.items() if not cls.deterministic]
FACTORS = (4, 8, 16, 32)


@pytest.mark.parametrize("name", STOCHASTIC)
@pytest.mark.parametrize("kind", [GeometricBrownianMotion, Tangent])
def test_step_has_the_strong_order_it_states_on_uncoupled_noise(name: str, kind: type[Problem]) -> None:
    step = make_step(name)
    errors = strong_errors(kind(calculus=step.calculus), step, paths=1500, finest=1024, factors=FACTORS)
    assert slope(FACTORS, errors) == pytest.approx(step.strong_order, abs=0.15)


@pytest.mark.parametrize("name", ["euler_maruyama", "heun", "milstein_stratonovich_free"])
def test_step_has_the_strong_order_it_states_on_square_root_noise(name: str) -> None:
    step = make_step(name)
    errors = strong_errors(SquareRoot(step.calculus), step, paths=1500, finest=1024, factors=FACTORS)
    assert slope(FACTORS, errors) == pytest.approx(step.strong_order, abs=0.15)


@pytest.mark.parametrize("name", ["milstein", "milstein_ito", "milstein_stratonovich"])
def test_milstein_is_exact_where_the_solution_is_quadratic_in_the_noise(name: str) -> None:
    step = make_step(name)
    assert max(strong_errors(SquareRoot(step.calculus), step, paths=1500, finest=64, factors=(1, 64))) < 1e-12


@pytest.mark.parametrize("name", STOCHASTIC)
def test_the_limit_is_the_closed_form_of_the_stated_calculus_and_not_the_other(name: str) -> None:
    step, problem = make_step(name), GeometricBrownianMotion()
    fine = brownian(
        2000, 1, 512, 1, dt=1 / 512, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    z0, u = torch.ones(1, 1, dtype=torch.float64), torch.zeros(1, 512, 1, dtype=torch.float64)
    end = rollout(problem, z0, u, dt=1 / 512, step=step, noise=fine)[:, :, -1]
    other = {"ito": "stratonovich", "stratonovich": "ito"}[step.calculus]
    assert (end - problem.solution(1.0, fine.sum(2), step.calculus)).abs().mean() < 0.05
    assert (end - problem.solution(1.0, fine.sum(2), other)).abs().mean() > 0.4


def coupled_errors(name: str) -> list[float]:
    problem, step = DistanceAware(), make_step(name)
    fine = brownian(
        1500, 1, 4096, 3, dt=1 / 4096, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    z0 = torch.full((1, 3), 0.5, dtype=torch.float64)

    def end(factor: int) -> torch.Tensor:
        dw = coarsen(fine, factor)
        return rollout(problem, z0, z0.new_zeros(1, dw.shape[2], 1), dt=factor / 4096, step=step, noise=dw)[
            :, :, -1
        ]

    reference = end(1)
    return [float((end(factor) - reference).abs().mean()) for factor in (64, 128, 256, 512)]


def test_milstein_ito_order_drops_to_half_on_coupled_noise() -> None:
    errors = coupled_errors("milstein_ito")
    assert slope((64, 128, 256, 512), errors) == pytest.approx(0.5, abs=0.12)


def test_derivative_free_milstein_order_drops_to_half_on_coupled_noise() -> None:
    errors = coupled_errors("milstein")
    assert slope((64, 128, 256, 512), errors) == pytest.approx(0.5, abs=0.12)


def test_heun_order_drops_to_half_on_coupled_noise() -> None:
    errors = coupled_errors("heun")
    assert slope((64, 128, 256, 512), errors) == pytest.approx(0.5, abs=0.12)
