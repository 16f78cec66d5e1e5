"""Machines that do not fly: swing-ups, paths of arms, limits of each input, and pushes that are learned on any port."""

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from examples.double_pendulum.double_pendulum import DoublePendulum
from nsde_torch.control import feasible
from nsde_torch.control.autopilots import EstimatorOptions, PredictivePilot
from nsde_torch.control.compiled import compiler
from nsde_torch.control.controller import Controller, Plan
from nsde_torch.control.loop import Flight, fly, summarise
from nsde_torch.control.options import ProblemOptions, SolverOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import problem_of
from nsde_torch.control.reference import Reference, StateReference, course, setpoint
from nsde_torch.control.shapes import hover
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation import make_plant
from nsde_torch.simulation.plant import Plant
from nsde_torch.systems import Machine, System, make_plant_system, make_system
from nsde_torch.systems.machine import Limits
from tests.helpers.two_joints import TwoJoints

UP = {"theta": 0.0}


def followed(
    reference: StateReference,
    *,
    start: dict[str, float],
    effects: tuple[object, ...] = (),
    force_time: float = 0.5,
    machines: int = 1,
    noise: float = 0.0,
) -> Flight:
    declared = make_plant_system("cartpole", effects=(), declared_only=True)
    given: dict[str, Any] = {"effects": effects, "process_noise": noise, "sensor_noise": noise}
    g = torch.Generator().manual_seed(3)
    plant = make_plant("cartpole", generator=g, check=False, **given)
    problem, solver = problem_of(declared, low=-10.0, high=10.0), SolverOptions(compile="on")
    controller = Controller(declared, problem=problem, solver=solver, batch=machines)
    estimator = EstimatorOptions(force_time=force_time)
    times: dict[str, Any] = {"period": 0.02, "sample": plant.dt, "estimator": estimator}
    pilot = PredictivePilot(controller, declared, reference, **times)
    begin = setpoint(declared, start, duration=1.0).states[0]
    return fly(pilot, plant, reference, machines=machines, start=begin)


def test_a_cart_swings_its_pole_up_with_half_of_the_force_that_would_push_it_up() -> None:
    system = make_system("cartpole")
    flight = followed(setpoint(system, UP, duration=6.0), start={"theta": math.pi}, machines=8, noise=1.0)
    found = summarise([flight], system)
    assert found["lost"] == 0
    assert set(found["status"]) == {"converged"}
    assert all(row["rmse_last_s"]["attitude"] < 3.0 for row in found["flights"])  # deg
    assert all(row["rmse_last_s"]["position"] < 0.1 for row in found["flights"])
    assert flight.u.abs().max() == pytest.approx(10.0)


@pytest.mark.slow
def test_what_pushes_all_the_time_is_learned_on_the_ports_of_the_machine() -> None:
    still = setpoint(make_system("cartpole"), UP, duration=8.0)
    pushed = ({"track_tilt": {"slope": 0.1}},)  # 1 m/s2 along the track
    flights = (followed(still, start=UP, effects=pushed, force_time=t) for t in (0.0, 0.3))
    off = [abs(float(flight.x[-1, 0, 0])) for flight in flights]
    assert off[0] > 0.05
    assert off[1] < 0.2 * off[0]


def test_a_course_is_read_from_columns_of_states_with_the_velocities_of_its_positions(tmp_path: Path) -> None:
    file = tmp_path / "arm.csv"
    rows = [f"{0.1 * k:.2f},{math.sin(0.1 * k):.6f}" for k in range(31)]
    file.write_text("\n".join(("t,x", *rows)), encoding="utf-8")
    path = course(make_system("cartpole"), file)
    assert path.duration == pytest.approx(3.0)
    now = path.at(torch.tensor([1.03, 99.0]))
    assert now[0].tolist() == pytest.approx([math.sin(1.03), math.cos(1.03), 0.0, 0.0], abs=6e-3)
    assert now[1].tolist()[0] == pytest.approx(math.sin(3.0), abs=1e-3)  # the end is held


def test_an_angle_that_was_wrapped_goes_on(tmp_path: Path) -> None:
    t = [0.05 * k for k in range(80)]
    rows = [f"{s:.2f},{math.remainder(2.0 * s, math.tau):.6f}" for s in t]
    (tmp_path / "turns.csv").write_text("\n".join(("t,theta", *rows)), encoding="utf-8")
    path = course(make_system("cartpole"), tmp_path / "turns.csv")
    assert torch.allclose(path.states[5:-5, 3], torch.tensor(2.0, dtype=torch.float64), atol=1e-3)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("t,y\n0,1\n1,2\n", "no column of a state; it has x, x_dot, theta, theta_dot"),
        ("t,x\n0,1\n0,2\n", "`t` must increase"),
        ("t,x\n0,one\n1,2\n", "no number"),
        ("t,x\n0,1\n", "over two rows or more"),
        ("x\n1\n2\n", "no column t"),
        ("t,x\n", "no rows"),
        ("t,x\n0,1\n1e9,2\n", "is `t` in seconds"),
    ],
)
def test_a_file_that_is_no_course_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "bad.csv").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=says):
        course(make_system("cartpole"), tmp_path / "bad.csv")


def test_a_state_that_the_machine_lacks_and_inputs_without_ends_are_refused() -> None:
    with pytest.raises(ConfigError, match="no state 'angle'; it has x, x_dot"):
        setpoint(make_system("cartpole"), {"angle": 1.0}, duration=1.0)
    spring = make_system("mass_spring_damper")
    with pytest.raises(ConfigError, match=r"give mpc\.low and mpc\.high"):
        problem_of(spring)
    made = problem_of(spring, low=-2.0, high=4.0)
    assert made.state_weights == (10.0, 0.1)
    assert (made.input_weight, made.input_centre) == (pytest.approx(0.1 / 9.0), 1.0)


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
        ({"rate_weight": -1.0}, "`rate_weight` must be at least 0"),
        ({"steps": 0}, "steps"),
        ({"horizon": 0.0}, "horizon"),
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
