"""Machines that do not fly: swing-ups, paths of arms, and pushes that are learned on any port."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from nsde_torch.control.autopilots import EstimatorOptions, PredictivePilot
from nsde_torch.control.controller import Controller
from nsde_torch.control.loop import Flight, fly, summarise
from nsde_torch.control.options import SolverOptions
from nsde_torch.control.problem import problem_of
from nsde_torch.control.reference import StateReference, course, setpoint
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation import make_plant
from nsde_torch.systems import make_plant_system, make_system

UP = {"theta": 0.0}


def followed(
    reference: StateReference,
    *,
    start: dict[str, float],
    effects: tuple[object, ...] = (),
    force_time: float = 0.5,
    machines: int = 1,
    noise: float = 0.0,
    low: float = -10.0,
    compiled: str = "on",
    latency: float = 0.0,
) -> Flight:
    declared = make_plant_system("cartpole", effects=(), declared_only=True)
    given: dict[str, Any] = {"effects": effects, "process_noise": noise, "sensor_noise": noise}
    g = torch.Generator().manual_seed(3)
    plant = make_plant("cartpole", generator=g, latency=latency, check=False, **given)
    problem, solver = problem_of(declared, low=low, high=-low), SolverOptions(compile=compiled)
    controller = Controller(declared, problem=problem, solver=solver, batch=machines)
    estimator = EstimatorOptions(force_time=force_time, latency=latency)
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


def test_a_plan_that_stays_beside_its_optimum_is_left() -> None:
    """A cart that balances its pole 0.9 m from where it should be, each plan putting the way there off."""
    still = setpoint(make_system("cartpole"), UP, duration=3.0)
    late = {"theta": 0.3}
    flight = followed(still, start=late, low=-25.0, latency=0.02)
    assert flight.x[-1, 0, 0].abs() < 0.02


def test_machine_code_does_what_torch_does() -> None:
    still = setpoint(make_system("cartpole"), {"x": 0.5}, duration=0.2)
    ends = [followed(still, start={"theta": 0.3}, compiled=way).x[-1] for way in ("on", "off")]
    assert torch.allclose(*ends, atol=2e-4)


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
