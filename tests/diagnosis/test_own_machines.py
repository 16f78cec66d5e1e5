"""Machines of a user's own: a motor with a pendulum that turns many times, a car of one state, boats, a lift, a room.

What acts beside their physics is named alone, with its size; of sound ones nothing is.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.diagnosis.candidates import starts, why_not, without_motion
from nsde_torch.diagnosis.decision import inputs_know
from nsde_torch.diagnosis.residual_tests import Dependence
from nsde_torch.errors import ConfigError
from nsde_torch.sysid.feedback_test import Answer, FeedbackTest
from nsde_torch.systems import System, make_system
from tests.helpers.diagnosed import assert_interval
from tests.helpers.electric_motors import CoilMotor, turns
from tests.helpers.machines import held, simulated
from tests.helpers.own_machines import (
    LOSS,
    Boat,
    Car,
    Lift,
    Motor,
    Room,
    Ship,
    behind_a_servo,
    driven,
    lifted,
    sailed,
    turned,
    voyages,
    warmed,
)  # fmt: skip
from tests.helpers.two_joints import TwoJoints

PENDULUM, SPRING = "pendulum:Pendulum", "mass_spring_damper"


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "pendulum")


def stop(q: float, v: float) -> float:
    return -(60.0 + 8.0 * v) * (q - 0.3) if q > 0.3 else 0.0


LONG, FREE = {"seconds": 15.0, "dt": 0.005}, {"seconds": 20.0, "dt": 0.01}
ENDS = ["stop_above", "stop_below", "cubic_stiffness", "position_dependent_friction"]


def biased(runs: list[RawRun]) -> list[RawRun]:
    """Runs whose angle reads too much."""
    return [replace(run, x=run.x + np.array([0.04, 0.0])) for run in runs]


def tired(runs: list[RawRun]) -> list[RawRun]:
    """Runs, by clocks that start with them, on which a share less of the torque acts that grows with the time."""
    clocks = [run.t - run.t[0] for run in runs]
    return [replace(r, t=t, u=r.u / (1.0 - 0.01 * t[:, None])) for r, t in zip(runs, clocks, strict=True)]


def none(q: float, v: float) -> float:
    return 0.0


Intervals = Mapping[str, tuple[float, float, float]]
"""Of each parameter the truth, what the interval may miss it by, and how wide it may be."""


def case(
    name: str,
    system: str | type[System],
    runs: Callable[[], list[RawRun]],
    intervals: Intervals,
    candidates: list[str] | None = None,
    *,
    slow: bool = True,
) -> Any:
    return pytest.param(
        system, runs, candidates, intervals, id=name, marks=[pytest.mark.slow] if slow else []
    )


ANY = np.inf
ROOT, AIR, SURGE = "heat = c1 root(T)", "heat = c1 pow(T, k1)", "force[surge] = c1 surge abs(turn)"
SWAY = "force[sway] = c1 port_side + c2 starboard"
WALL = {"relaxation.exchange": (0.015, 5e-4, 0.01), "relaxation.time": (120.0, 4.0, 60.0)}


def servo(hertz: float, ratio: float) -> Intervals:
    true = {"actuator_resonance.period": 1.0 / hertz, "actuator_resonance.damping": ratio}
    return {name: (value, 0.015 * value, 0.02 * value) for name, value in true.items()}


@pytest.mark.parametrize(
    ("system", "runs", "candidates", "intervals"),
    [
        case("cogging over many turns", PENDULUM, lambda: turned(lambda q, v: np.sin(7.0 * q), **LONG, size=1.5),
             {"ripple.order": (7.0, 0.001, ANY), "ripple.sine": (1.0, 0.005, 0.05)}, ["ripple", "coulomb_friction"]),
        case("teeth of any number", PENDULUM, lambda: turned(lambda q, v: 0.8 * np.sin(31.0 * q), **LONG, size=1.0),
             {"ripple.order": (31.0, 0.01, 0.1)}),
        case("a stop on one side", PENDULUM, lambda: turned(stop, **LONG, size=0.4),
             {"stop_above.stiffness": (60.0, 0.3, ANY), "stop_above.end": (0.3, 0.002, ANY)}, ENDS),
        case("an encoder off its zero", PENDULUM, lambda: biased(turned(none, **LONG, size=1.0)),
             {"position_bias.bias": (0.04, 0.0003, 0.003)}),
        case("it tires", PENDULUM, lambda: tired(turned(none, **FREE, size=0.6)),
             {"actuator_gain_drift.rate": (-0.01, 0.0002, ANY)}),
        case("the weaker of two propellers", Boat, lambda: sailed((0.92, 1.0)),
             {"actuator_efficiency_loss.loss[0]": (0.08, 0.002, 0.02)}),
        case("one input of two is late", Boat, lambda: sailed(late=3),
             {"input_delay[starboard].delay": (0.15, 0.001, 0.01)}),
        case("a force that two inputs make", Boat, lambda: sailed(sideways=0.012),
             {f"{SWAY}.{c}": (0.012, 1e-4, 0.002) for c in ("c1", "c2")}),
        case("a drag that grows with turns to both sides", Boat, lambda: sailed(slip=0.3),
             {f"{SURGE}.c1": (-0.3, 0.01, 0.1)}),
        case("the zero of a gap, of which a force is no line", Lift, lambda: lifted(bias=0.0009),
             {"position_bias.bias": (0.0009, 1e-5, 1e-4)}),
        case("a current", Ship, lambda: voyages((0.12, -0.2)),
             {"drift_velocity[x].velocity": (0.12, 0.002, 0.02), "drift_velocity[y].velocity": (-0.2, 0.002, 0.02)}),
        case("still water", Ship, lambda: voyages((0.0, 0.0)), {}, slow=False),
        case("a wall that stores heat", Room, lambda: warmed(exchange=0.015), WALL, slow=False),
        # which was `unexplained`
        case("a wall that is colder at first", Room, lambda: warmed(exchange=0.015, wall=-8.0), WALL, slow=False),
        # beside a loss that is declared, which an exchange with surroundings would be half of
        case("a hole", Room, lambda: warmed(leak=0.05), {f"{ROOT}.c1": (-0.05, 0.0015, ANY)}, slow=False),
        case("air that carries heat off", Room, lambda: warmed(leak=0.01, power=1.25),
             {f"{AIR}.c1": (-0.01, 0.001, ANY), f"{AIR}.k1": (1.25, 0.05, 0.2)}, slow=False),
        case("a sound room", Room, warmed, {}, slow=False),
        case("a sound car", Car, driven, {}, slow=False),
        case("what disturbs a state that no port pushes", CoilMotor, lambda: turns(6, 60.0, ripple=0.3).runs, {}),
        case("a servo that swings", SPRING, lambda: behind_a_servo(1.5, 0.1), servo(1.5, 0.1)),
        # of this one the fit without it takes the input for nothing
        case("a fast servo that swings", SPRING, lambda: behind_a_servo(3.0, 0.3), servo(3.0, 0.3)),
    ],
)  # fmt: skip
def test_what_acts_beside_the_physics_is_named_alone_with_its_size(
    system: Any, runs: Callable[[], list[RawRun]], candidates: list[str] | None, intervals: Intervals
) -> None:
    found = nsde_torch.diagnose(runs(), system=system, candidates=candidates, say=False)
    assert {*found.added} == {label.rpartition(".")[0] for label in intervals}
    assert not any(f["lead"] for f in found.content()["findings"])
    assert found.verdict == ("effect_found" if intervals else "no_effect")
    for label, (truth, slack, width) in intervals.items():
        assert_interval(found.parameters, label, truth, slack=slack, width=width)
    if AIR in found.added:  # how heat is shared out between a loss and a power of the same is the formula's
        assert found.content()["declared_parameters"]["loss"]["given"] == [AIR]


@pytest.mark.slow
def test_a_friction_of_the_place_is_found_as_one_law_or_as_the_sum_of_several() -> None:
    def torque(q: float, v: float) -> float:
        return float(-(0.3 + 0.2 * np.cos(2.0 * q)) * np.tanh(v / 0.05))

    found = nsde_torch.diagnose(turned(torque, **FREE, size=1.0), system=PENDULUM, say=False)
    machine = found.outcome.system
    x = torch.cartesian_prod(torch.linspace(-3.0, 3.0, 25), torch.tensor([-8.0, -2.0, -0.5, 0.5, 2.0, 8.0]))
    u, before = torch.zeros(len(x), 1), machine.without_effects(*found.added)
    assert (machine.nz, before.nz) == (2, 2), "something has a memory"
    with torch.no_grad():
        acts = (machine.drift(0.0, x, u) - before.drift(0.0, x, u))[:, 1]
    assert acts.numpy() == pytest.approx([torque(q, v) for q, v in x.tolist()], abs=0.01)


def test_the_zero_of_a_position_is_a_candidate_where_something_depends_on_it() -> None:
    assert not why_not(make_system("cartpole"), "position_bias[pole]")
    assert "nothing that is declared depends" in why_not(TwoJoints(), "position_bias[q1]")
    for spring, reason in (("linear_spring", "a steady force is the same"), ("cubic_stiffness", "")):
        sprung = TwoJoints().with_effects(TwoJoints().make_effect(f"{spring}[q1]", {"stiffness": 2.0}))
        found = why_not(sprung, "position_bias[q1]")
        assert reason in found
        assert bool(found) == bool(reason)


@pytest.mark.slow
def test_what_a_motor_that_turns_one_way_cannot_tell_is_a_tie() -> None:
    """Dry friction, a steady torque and a dead band are one constant, beside what differs within a run too."""
    runs = []
    for k, (rows, dampings) in enumerate(((1995, (25.0, 25.2)), (150, (25.1, 25.1)))):
        rng = np.random.default_rng(k)
        volts = held(rng, 1.5, 3.0, rows, each=15)
        damping = np.where(2 * np.arange(rows) > rows, *dampings[::-1])
        run = simulated(
            k,
            lambda omega, u: 70.0 * u[:1] - u[1] * omega - 16.5,
            (70.0 * volts[0] - 16.5) / 25.0,
            np.column_stack((volts, damping)),
            0.02,
            noise=0.03,
            rng=rng,
        )
        runs.append(replace(run, u=volts))
    content = nsde_torch.diagnose(runs, system=Motor, say=False).content()
    differs = "run_difference[damping]"
    (constant,) = {*content["added"]} - {differs}
    same = {"constant_force", "coulomb_friction", "actuator_deadband"}
    assert constant in same
    assert any(same <= {*tie["effects"]} for tie in content["ties"])
    # what changes in the first run is held against its other part, not against the second run
    ends = [p["interval_90"] for name, p in content["parameters"].items() if name.startswith(differs)]
    assert content["parameters"][f"{differs}.change[0]"]["against"].startswith("run_0")
    assert max(abs(low + high) / 2 for low, high in ends) == pytest.approx(0.2, abs=0.02)


@pytest.mark.slow
def test_dry_friction_of_a_motor_whose_current_settles_within_a_row() -> None:
    few = ("coulomb_friction", "relaxation", "viscous_friction", "actuator_lag")
    found = nsde_torch.diagnose(
        turns(6, 1000.0, friction=3.0, seconds=8.0), system=CoilMotor, candidates=few, say=False
    )
    content = found.content()
    assert content["added"] == ["coulomb_friction"]
    assert not any(f["lead"] for f in content["findings"])
    assert_interval(content["parameters"], "coulomb_friction.size", 3.0, slack=0.05, width=0.7)
    errors = content["errors"]  # of predictions: by a rule of Runge and Kutta all of them diverge
    assert errors["diverged"] == {"before": 0, "after": 0}
    assert errors["after"]["w"]["0.25"] < errors["before"]["w"]["0.25"]


def test_places_have_no_friction_and_velocities_none_of_their_own() -> None:
    able = Ship.able_effects()
    assert {n for n in able if n.endswith(("[x]", "[y]"))} == {"drift_velocity[x]", "drift_velocity[y]"}
    with pytest.raises(ConfigError, match=r"choose among drift_velocity\[x\], drift_velocity\[y\]"):
        Ship().make_effect("drift_velocity")


def test_an_input_that_never_comes_near_zero_has_no_dead_band_and_one_of_one_sign_no_gain_by_it() -> None:
    near, far = (
        {"input": 1.0, "least input": least, "rarer sign": 0.3, "step": 0.1} for least in (0.01, 0.9)
    )
    assert starts(Room(), "actuator_deadband", near, ())
    assert not starts(Room(), "actuator_deadband", far, ())
    assert starts(Room(), "asymmetric_gain", near, ())
    assert not starts(Room(), "asymmetric_gain", {**near, "rarer sign": 0.0}, ())
    assert starts(Room(), "input_delay", far, ())


def test_in_a_closed_loop_inputs_a_moment_before_are_what_the_controller_knew() -> None:
    before, of_state = (
        Dependence("T", variable, 1e-9, 0.2, 0.5, gain, 2)
        for variable, gain in (("heater before", 300.0), ("T", 30.0))
    )
    loop = FeedbackTest((Answer("heater", "T", 0.2, 1e-9),), (Answer("heater", "T", 0.2, 1e-9),), rows=900)
    assert inputs_know([before, of_state], loop) == {"T"}
    assert not inputs_know([before, of_state], FeedbackTest())
    assert not inputs_know([replace(before, gain=3.0), of_state], loop), "a law of the state is more"


def test_stores_of_a_machine_without_coordinates_have_no_friction() -> None:
    assert {"relaxation", "exchange"} <= set(Room.able_effects())
    assert without_motion(Room()) == ("", "")
    assert "coulomb_friction" not in Room.able_effects()
    with pytest.raises(ConfigError, match="declares none"):
        Room().make_effect("coulomb_friction")
    with torch.no_grad():
        still = Room().with_effects(Room().make_effect("relaxation", {"exchange": 0.1, "time": 5.0}))
        rate = still.drift(0.0, torch.tensor([[2.0, 1.0]]), torch.tensor([[0.0]]))
    assert rate[0].tolist() == pytest.approx([-LOSS * 2.0 - 0.1, 0.2], rel=1e-5)
