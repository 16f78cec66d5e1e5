"""Limits, weights and centres that are not the same for all inputs."""

import copy
from typing import Any

import pytest
import torch

from examples.double_pendulum.double_pendulum import DoublePendulum
from nsde_torch.control import feasible
from nsde_torch.control.codegen.library import compiler
from nsde_torch.control.controller import Controller, Plan
from nsde_torch.control.options import ProblemOptions, SolverOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import problem_of
from nsde_torch.control.reference import Reference
from nsde_torch.control.shapes import hover
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.plant import Plant
from nsde_torch.systems import Machine, System
from nsde_torch.systems.machine import Limits
from tests.helpers.two_joints import TwoJoints

needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
LOW, HIGH = (-4.0, -0.5), (4.0, 1.0)
SWINGING = torch.tensor([[1.0, 1.0, -6.0, 6.0]], dtype=torch.float64)


def limited(limits: Limits) -> System:
    """Two joints whose machine says so."""
    system = copy.copy(TwoJoints())
    values: dict[str, Any] = {"values": {}, "dt": 0.01, "step": 0.01, "sensor_std": (0.0,) * 4}
    object.__setattr__(system, "machine", Machine(**values, limits=limits))
    return system


def planned(
    compiled: str, *, name: str = "gauss_newton", batch: int = 1, **options: Any
) -> tuple[Plan, Controller]:
    """The plan of an arm that swings and is to come to rest."""
    arm = DoublePendulum()
    solver = SolverOptions(name=name, compile=compiled, iterations=12, tolerance=0.0)
    problem = problem_of(arm, **{"low": LOW, "high": HIGH, **options})
    controller = Controller(arm, problem=problem, solver=solver, batch=batch, dtype=torch.float64)
    rest = torch.zeros(batch, problem.steps, 4, dtype=torch.float64)
    return controller.plan(SWINGING.expand(batch, -1), rest), controller


@pytest.mark.parametrize("paid", [{}, {"rate_weight": 0.001}])
def test_a_plan_is_the_best_within_the_limits_of_each_input(paid: dict[str, float]) -> None:
    plan, controller = planned("off", **paid)
    h, u = controller.horizon, plan.u.clone().requires_grad_()
    assert plan.u.amin((0, 1)).tolist() == list(LOW)
    assert plan.u.amax((0, 1)).tolist() == list(HIGH)
    path = h.rollout(SWINGING, u, torch.zeros(1, h.nd, dtype=torch.float64))
    rest = torch.zeros(1, h.steps, 4, dtype=torch.float64)
    (slope,) = torch.autograd.grad(h.cost(path, u, rest, controller.hover[None])[0], u)
    # down the slope lies what is out of the box, or nothing
    assert torch.allclose((u - 0.02 * slope).clamp(h.low, h.high), u, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("name", ["gauss_newton", "apg"])
@pytest.mark.slow
def test_machine_code_and_batches_keep_to_the_limits_as_torch_does(name: str) -> None:
    paid = {"name": name, "input_weight": (0.02, 0.3), "input_centre": (0.5, -0.1), "rate_weight": 0.01}
    (fast, _), (plain, _), (many, _) = (
        planned(way, batch=n, **paid) for way, n in (("on", 1), ("off", 1), ("off", 3))
    )
    assert torch.allclose(fast.u, plain.u, atol=1e-8)
    assert torch.allclose(fast.gap, plain.gap, rtol=1e-6, atol=1e-9)
    assert torch.allclose(many.u, plain.u.expand(3, -1, -1), atol=1e-8)
    for i in range(2):
        assert LOW[i] <= float(fast.u[..., i].min()) <= float(fast.u[..., i].max()) <= HIGH[i]


def test_equal_numbers_for_each_input_are_one_for_all() -> None:
    one, each = (planned("off", low=low, high=high)[0] for low, high in ((-2, 2), ([-2, -2], [2, 2])))
    assert torch.equal(one.u, each.u)


def test_weights_and_centres_follow_the_limits_of_each_input() -> None:
    made = problem_of(limited(((-4, 4), (-0.5, 1.0))))
    assert (made.low, made.high) == (LOW, HIGH)
    assert made.input_centre == (0.0, 0.25)
    assert made.input_weight == pytest.approx((0.1 / 16.0, 0.1 / 0.75**2))
    mixed = problem_of(TwoJoints(), low=-1.0, high=[4.0, 0.5])
    assert (mixed.low, mixed.input_centre) == (-1.0, (1.5, -0.25))
    plain = problem_of(limited((-2.0, 2.0)))
    assert (plain.low, plain.high, plain.input_weight, plain.input_centre) == (-2.0, 2.0, 0.025, 0.0)


def test_a_plant_clips_each_command_at_its_own_limits() -> None:
    made: dict[str, Any] = {"dt": 0.1, "generator": torch.Generator(), "step": 0.1}
    for limits, sent in ((((-4, 4), (-1, 0.5)), [4.0, 0.5]), ((-2.0, 2.0), [2.0, 2.0])):
        plant = Plant(TwoJoints(), **made, limits=limits)
        plant.reset(torch.zeros(1, 4), torch.zeros(1, 2))
        w2, w1 = plant.step(torch.full((1, 2), 9.0))[0, :2].tolist()
        assert [w1, w2] == pytest.approx([0.1 * sent[0] / 0.5, 0.1 * sent[1] / 0.2], rel=1e-6)


@pytest.mark.parametrize("name", ["low", "high", "input_weight", "input_centre"])
def test_numbers_for_more_inputs_than_there_are_are_refused(name: str) -> None:
    given = {"low": -1.0, "high": 1.0, name: (0.5, 0.6, 0.7)}
    with pytest.raises(ConfigError, match=rf"`{name}` takes .* 2 \(tau1, tau2\); got 3"):
        planned("off", **given)


@pytest.mark.parametrize("limits", [((-4, 4),), ((-4, 4), (-1, 1), (-1, 1)), ((-4, 4), 1.0), (1.0,)])
def test_limits_of_a_machine_are_one_pair_or_one_for_each_input(limits: Any) -> None:
    for made in (
        lambda: problem_of(limited(limits)),
        lambda: Plant(TwoJoints(), dt=0.1, generator=torch.Generator(), limits=limits),
    ):
        with pytest.raises(ConfigError, match=r"`limits` of a machine .* 2 \(tau1, tau2\); got"):
            made()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"low": (-1.0, 1.0), "high": (1.0, 1.0)}, "`low` must lie below `high`"),
        ({"low": (-1.0, 1.0)}, "`low` must lie below `high`"),
        ({"low": "none"}, "`low` takes a number, or one for each input"),
        ({"high": (1.0, True)}, "`high` takes a number"),
        ({"input_centre": ()}, "`input_centre` takes a number"),
        ({"input_weight": (1.0, 0.0)}, "must be above 0"),
        ({"input_weight": (1.0, -1.0)}, "`input_weight` must be at least 0"),
    ],
)
def test_what_is_no_limit_or_weight_is_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        ProblemOptions(**given)


def test_a_path_is_held_against_the_limits_of_each_motor(declared: System) -> None:
    path, known = Reference(hover()), Predictor(declared, dt=0.05)
    feasible.check(path, known, ProblemOptions(high=(1.0, 1.0, 0.5, 1.0, 1.0, 1.0)))
    with pytest.raises(ConfigError, match=r"command of 0\.39 \(u_3\) .* the largest is 0\.4, and 0\.02 "):
        feasible.check(path, known, ProblemOptions(high=(1.0, 1.0, 0.4, 1.0, 1.0, 1.0)))
    with pytest.raises(ConfigError, match=r"\(u_2\) .* the least is 0\.38"):
        feasible.check(path, known, ProblemOptions(low=(0.0, 0.38, 0.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("compiled", ["off", pytest.param("on", marks=needs_compiler)])
def test_a_plan_whose_active_set_was_not_found_has_not_converged(compiled: str) -> None:
    """From rest, an iteration of two joints found half of its active set and said that it had converged: 701 of 305."""
    arm = TwoJoints()
    problem = problem_of(arm, low=-3.0, high=5.0)
    controller = Controller(
        arm, problem=problem, solver=SolverOptions(compile=compiled), batch=1, dtype=torch.float64
    )
    wanted = torch.tensor([0.0, 0.0, 1.0, 2.0], dtype=torch.float64).expand(1, problem.steps, 4)
    plan = controller.plan(torch.zeros(1, 4, dtype=torch.float64), wanted)
    assert float(plan.cost[0]) == pytest.approx(305.30, rel=0.005)
