"""The compiled solver and estimator: torch's numbers, and life without a compiler."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from nsde_torch.control.autopilots import Estimator, EstimatorOptions, PredictivePilot
from nsde_torch.control.codegen import scalar
from nsde_torch.control.compiled import compiled_estimator, compiler
from nsde_torch.control.controller import Controller
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import Horizon, ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import Problem, Solution, Solver, SolverOptions
from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE
from nsde_torch.sde import CompilationWarning
from nsde_torch.systems import System
from tests.helpers.control_problems import PAID, horizon_of, problem_of

needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
SMALL = {"horizon": 0.3, "steps": 6}


def _solved(h: Horizon, p: Problem, **options: object) -> Solution:
    solver = Solver(h, SolverOptions(**options), batch=len(p.z0))  # type: ignore[arg-type]
    assert solver.compiled == (options["compile"] == "on")
    u = p.last[:, None].repeat(1, h.steps, 1)
    return solver.solve(p, u, h.rollout(p.z0, u, p.d))


def _near(one: Tensor, other: Tensor, most: float) -> bool:
    return one.dtype == other.dtype and torch.allclose(one, other, rtol=most, atol=most)


def _both(h: Horizon, p: Problem, most: float, **options: object) -> None:
    """Both solve problems alike, in every field of their solutions that is no time."""
    fast, plain = (_solved(h, p, compile=how, **options) for how in ("on", "off"))
    assert len(fast.costs) == len(plain.costs)
    assert fast.in_time == plain.in_time
    assert torch.equal(fast.converged, plain.converged)
    ours, theirs = ((found.u, found.z, found.cost, *found.costs) for found in (fast, plain))
    assert all(_near(one, other, most) for one, other in zip(ours, theirs, strict=True))
    assert torch.allclose(fast.gap, plain.gap, atol=max(1e-9, most))


@needs_compiler
@pytest.mark.parametrize(
    "options", [{}, PAID[0], *(pytest.param(paid, marks=pytest.mark.slow) for paid in PAID[1:])]
)
def test_solutions_are_those_of_torch_whatever_a_plan_pays_for(
    declared: System, path: Reference, options: dict[str, object]
) -> None:
    h = horizon_of(declared, **SMALL, **options)
    # off by so much that several changes of the active set and several iterations are needed
    _both(h, problem_of(h, path, rows=1, off=3.0), 1e-8, iterations=6, tolerance=1e-4)


@needs_compiler
def test_each_row_of_a_batch_is_solved_as_torch_solves_it_alone(declared: System, path: Reference) -> None:
    h = horizon_of(declared, **SMALL)
    p = problem_of(h, path, rows=3, off=3.0)
    together = _solved(h, p, compile="on", iterations=4, tolerance=0.0)
    for row in range(3):
        own = Problem(*(t[row : row + 1] for t in p))
        alone = _solved(h, own, compile="off", iterations=4, tolerance=0.0)
        assert _near(together.u[row], alone.u[0], 1e-8)
        assert _near(together.cost[row], alone.cost[0], 1e-8)


@needs_compiler
@pytest.mark.parametrize(
    "options", [{}, pytest.param({"rate_weight": 3.0, "low": 0.3, "high": 0.5}, marks=pytest.mark.slow)]
)
def test_accelerated_gradients_are_those_of_torch(
    declared: System, path: Reference, options: dict[str, object], tmp_path: Path
) -> None:
    h, said = horizon_of(declared, **SMALL, **options), []
    Solver(h, SolverOptions(name="apg", compile="on", cache=str(tmp_path)), say=said.append)
    assert "compiled apg" in said[0]
    for iterations, tolerance in ((10, 0.0), (40, 2.0)):
        p = problem_of(h, path, rows=2, off=2.0)
        _both(h, p, 1e-7, name="apg", iterations=iterations, tolerance=tolerance, cache=str(tmp_path))
    assert len(list(tmp_path.iterdir())) == 1


@needs_compiler
@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("times", [(0.0, 0.3, 0.0), (0.04, 0.3, 0.2), (0.06, 0.0, 0.0)])
def test_the_estimator_updates_as_that_of_torch(
    model: NeuralSDE, rows: int, times: tuple[float, float, float]
) -> None:
    latency, force, moment = times
    predictor = Predictor(model, dt=0.02, dtype=torch.float64)
    options = EstimatorOptions(latency=latency, force_time=force, moment_time=moment)
    made = Estimator(predictor, options, period=0.04)
    g = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(rows, *shape, generator=g, dtype=torch.float64)

    x = draw(13)
    x[:, 6:10] = torch.nn.functional.normalize(x[:, 6:10], dim=1)
    given = (x, x + 0.1 * draw(13), draw(6), draw(made.past + made.ahead, 6).sigmoid())
    for fast, plain in zip(compiled_estimator(made, predictor)(*given), made(*given), strict=True):
        assert torch.allclose(fast, plain, atol=1e-12)
    missed = (x * torch.nan, *given[1:])
    for fast, plain in zip(compiled_estimator(made, predictor)(*missed), made(*missed), strict=True):
        assert torch.equal(torch.isfinite(fast), torch.isfinite(plain))


@needs_compiler
def test_a_flight_of_a_compiled_controller_is_that_of_torch(declared: System, path: Reference) -> None:
    words = []
    for how in ("on", "off"):
        problem, solver = ProblemOptions(**SMALL), SolverOptions(compile=how, iterations=3)  # type: ignore[arg-type]
        controller = Controller(declared, problem=problem, solver=solver, dtype=torch.float64)
        estimator = EstimatorOptions(latency=0.04, force_time=0.3)
        pilot = PredictivePilot(controller, declared, path, period=0.02, sample=0.01, estimator=estimator)
        x = path.at(torch.tensor(2.0))[None].double()
        pilot.reset(x)
        made = []
        for k in range(25):
            seen = path.at(torch.tensor(2.0 + 0.02 * k))[None].double()
            seen[0, 2] += 0.05
            if k == 9:
                seen = seen * torch.nan
            if k in (14, 15):
                seen[0, 0] += 5.0
            made.append(pilot.command(2.0 + 0.02 * k, seen))
        words.append(made)
    assert {"bad_state:kept", "state_jump:kept", "converged"} <= {d.status[0] for d in words[0]}
    for fast, plain in zip(*words, strict=True):
        assert fast.status == plain.status
        assert fast.iterations == plain.iterations
        assert torch.allclose(fast.u, plain.u, atol=1e-8)


# ---- libraries ------------------------------------------------------------------------------------------


def test_without_a_compiler_the_solver_says_so_and_runs(
    declared: System, path: Reference, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "no_such_compiler")
    h = horizon_of(declared, steps=2, horizon=0.1)
    with pytest.warns(CompilationWarning, match="no C compiler"):
        solver = Solver(h, SolverOptions(cache=str(tmp_path)))
    assert not solver.compiled
    p = problem_of(h, path, rows=1)
    u = p.last[:, None].repeat(1, 2, 1)
    assert bool(torch.isfinite(solver.solve(p, u, h.rollout(p.z0, u, p.d)).cost).all())
    with pytest.raises(ConfigError, match="compile=off"):
        Solver(h, SolverOptions(compile="on", cache=str(tmp_path)))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: torch.cat(x.split(1, -1)[::-1], -1),
        lambda x: torch.cat(x.split(3, -1)[::-1], -1),
        lambda x: torch.cat(x.chunk(2, -1)[::-1], -1),
        lambda x: x[:, [2, 0]],
        lambda x: x.flip(-1),
        lambda x: x.prod(-1, keepdim=True),
        lambda x: x @ torch.arange(4.0, dtype=x.dtype),
        lambda x: torch.hypot(x[:, :1], x[:, 1:2]),
        lambda x: torch.nn.functional.softplus(30.0 * x),
        *(torch.sinh, torch.cosh, torch.ceil),
    ],
)
def test_operations_of_machines_of_ones_own_are_those_of_torch(function: Callable[[Tensor], Tensor]) -> None:
    x = torch.linspace(-1.4, 1.1, 8, dtype=torch.float64).reshape(2, 4)
    (made,) = scalar.run(lambda x: [function(x)], [np.array(x.tolist(), object)])
    np.testing.assert_allclose(made.astype(float), function(x).numpy(), rtol=1e-12)


def test_what_c_does_not_hold_runs_in_torch_and_is_said(
    declared: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = SolverOptions(cache=str(tmp_path))
    with pytest.warns(CompilationWarning, match=r"several paths \(particles\)"):
        assert not Solver(horizon_of(declared, **SMALL, particles=2), options).compiled
    monkeypatch.delitem(scalar._RULES, "mul")  # type: ignore[arg-type]
    with pytest.warns(CompilationWarning, match=r"torch's mul, which cannot be written in C\.$"):
        assert not Solver(horizon_of(declared, **SMALL), options).compiled
    monkeypatch.undo()
    h = horizon_of(declared, **SMALL)
    advance = h.advance
    monkeypatch.setattr(h, "advance", lambda z, *given: advance(z if z.tolist()[0][0] > 0 else -z, *given))
    with pytest.warns(CompilationWarning, match="without compilation"):
        assert not Solver(h, options).compiled
    assert not list(tmp_path.iterdir())
