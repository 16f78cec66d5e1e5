"""Both solvers against an independent optimiser, and what iterations promise."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from nsde_torch.control.gauss_newton import AcceleratedGradient, GaussNewton
from nsde_torch.control.problem import Horizon
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import Problem, Solution, Solver, SolverOptions
from nsde_torch.models import NeuralSDE
from nsde_torch.systems import System
from tests.helpers.control_problems import horizon_of, problem_of


def _start(h: Horizon, p: Problem) -> tuple[torch.Tensor, torch.Tensor]:
    u = p.last[:, None].repeat(1, h.steps, 1)
    return u, h.rollout(p.z0, u, p.d)


def _solved(h: Horizon, p: Problem, **options: object) -> Solution:
    given = {"compile": "off", "tolerance": 0.0, **options}
    solver = Solver(h, SolverOptions(**given), batch=len(p.z0))  # type: ignore[arg-type]
    return solver.solve(p, *_start(h, p))


def _independent(h: Horizon, p: Problem, row: int, first: torch.Tensor) -> float:
    """The optimum by scipy's L-BFGS-B from some first inputs; it shares no code with either solver."""
    one = Problem(*(t[row : row + 1] for t in p))

    def value(flat: np.ndarray) -> tuple[float, np.ndarray]:
        u = torch.tensor(flat).view(1, h.steps, h.nu).requires_grad_()
        cost = h.cost(h.rollout(one.z0, u, one.d), u, one.ref, one.last)[0]
        (gradient,) = torch.autograd.grad(cost, u)
        return float(cost.detach()), gradient.flatten().numpy()

    bounds, few = [(h.options.low, h.options.high)] * (h.steps * h.nu), {"maxiter": 60, "maxfun": 80}
    start = first.double().numpy().ravel()
    return float(minimize(value, start, jac=True, method="L-BFGS-B", bounds=bounds, options=few).fun)


@pytest.mark.slow
def test_gauss_newton_finds_the_optimum_of_an_independent_optimiser(
    model: NeuralSDE, path: Reference
) -> None:
    h = horizon_of(model, steps=10, horizon=0.5)
    p = problem_of(h, path, rows=2, off=2.0)
    found = _solved(h, p, iterations=15)
    afar = torch.full((h.steps, h.nu), 0.4)
    for row in range(2):
        # L-BFGS-B stops a little short of it from afar, and finds nothing better beside it
        assert float(found.cost[row]) <= _independent(h, p, row, afar) * 1.001
        assert float(found.cost[row]) <= _independent(h, p, row, found.u[row]) * 1.001


def test_the_gradients_of_both_methods_are_that_of_the_cost(model: NeuralSDE, path: Reference) -> None:
    paid: dict[str, object] = {"rate_weight": 3.0, "speed_limit": 2.0, "uncertainty_weight": 5.0}
    h = horizon_of(model, input_centre=0.3, particles=2, **paid)
    p = problem_of(h, path, rows=2)
    u = torch.rand(2, 20, 6, generator=torch.Generator().manual_seed(3)).double().requires_grad_()
    z = h.rollout(p.z0, u, p.d)
    cost = h.cost(z, u, p.ref, p.last)
    (wanted,) = torch.autograd.grad(cost.sum(), u)
    _, half, value = GaussNewton(h).quadratic(p.z0, u.detach(), z.detach(), p.ref, p.last, p.d)
    assert torch.allclose(2.0 * half, wanted.flatten(1), rtol=1e-6, atol=1e-6)
    assert torch.allclose(value, cost.detach())
    found = AcceleratedGradient(h).gradient(p.z0, u.detach(), p.ref, p.last, p.d)
    assert torch.allclose(found, wanted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("name", "iterations"), [("gauss_newton", 8), ("apg", 30)])
@pytest.mark.slow
def test_iterations_never_make_a_plan_worse_and_never_leave_the_box(
    model: NeuralSDE, path: Reference, name: str, iterations: int
) -> None:
    h = horizon_of(model)
    p = problem_of(h, path, rows=6, off=6.0)
    found = _solved(h, p, name=name, iterations=iterations)
    costs = torch.stack(found.costs)
    assert bool((costs.diff(dim=0) <= 1e-9).all())
    assert float(costs[-1].max()) < float(costs[0].max())
    assert 0.0 <= float(found.u.min()) <= float(found.u.max()) <= 1.0
    assert torch.allclose(h.cost(h.rollout(p.z0, found.u, p.d), found.u, p.ref, p.last), found.cost)


def test_a_far_start_with_inputs_at_their_bounds_is_solved_too(declared: System, path: Reference) -> None:
    h = horizon_of(declared)
    p = problem_of(h, path, rows=4, off=6.0)
    found = _solved(h, p, iterations=20)
    held = (found.u <= 0.0) | (found.u >= 1.0)
    assert int(held.sum()) > 10
    assert float(found.gap.max()) < 1e-3


@pytest.mark.slow
def test_accelerated_gradient_comes_to_the_same_optimum(model: NeuralSDE, path: Reference) -> None:
    h = horizon_of(model, steps=10, horizon=0.5)
    p = problem_of(h, path, rows=3, off=0.5)
    fast, slow = _solved(h, p, iterations=10), _solved(h, p, name="apg", iterations=250)
    assert bool((slow.cost <= 1.01 * fast.cost).all())
    assert bool((slow.cost >= fast.cost * (1.0 - 1e-6)).all())


def test_a_batch_is_solved_as_each_of_its_rows_is(model: NeuralSDE, path: Reference) -> None:
    h = horizon_of(model)
    p = problem_of(h, path, rows=3)
    together = _solved(h, p, iterations=6)
    for row in range(3):
        alone = _solved(h, Problem(*(t[row : row + 1] for t in p)), iterations=6)
        assert float(alone.cost[0]) == pytest.approx(float(together.cost[row]), rel=1e-6)


def test_at_the_deadline_the_best_plan_so_far_is_returned(model: NeuralSDE, path: Reference) -> None:
    h = horizon_of(model)
    p = problem_of(h, path, rows=1)
    now = iter(range(1000))
    options = SolverOptions(compile="off", iterations=50, tolerance=0.0, deadline=10.0)
    solver = Solver(h, options, clock=lambda: next(now))
    found = solver.solve(p, *_start(h, p))
    assert 2 <= len(found.costs) < 10
    assert found.in_time
    assert float(found.cost[0]) < float(found.costs[0][0])
