"""Machines of a user's own: a motor with a pendulum that turns many times, a car of one state, a boat.

Their simulators share no code with the package.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.arrays import Array
from nsde_torch.data import RawRun
from nsde_torch.diagnosis.candidates import why_not
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System, make_system
from tests.helpers.diagnosed import assert_interval
from tests.helpers.electric_motors import CoilMotor, turns
from tests.helpers.machines import held, simulated
from tests.helpers.two_joints import TwoJoints

PENDULUM = "pendulum:Pendulum"
Torque = Callable[[float, float], float]
"""Of an angle and its speed."""


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "pendulum")


@final
class Car(System):
    """The speed of a car, which has no position."""

    name = "car"
    state_names, state_units = ("v",), ("m/s",)
    input_names, input_units = ("throttle",), ("1",)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 1.0, "m/s2")}
    sensor_noise = True
    defaults = Defaults(0.05, 20, (0.05,), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {"engine": Parameter(3.0, "m/s2", low=0.0), "rolling": Parameter(0.1, "m/s2", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        pushed = self.value("engine") * u - self.value("rolling")
        return pushed + forces.get(Port.FORCE, 0.0)


@final
class Motor(System):
    """The speed of a motor."""

    name = "motor"
    state_names, state_units = ("omega",), ("rad/s",)
    input_names, input_units = ("voltage",), ("V",)
    ports = {Port.TORQUE: 1}
    residual_ports = {Port.TORQUE: ResidualPort(1, 10.0, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.02, 25, (0.5,), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {"damping": Parameter(10.0, "1/s", low=0.0), "gain": Parameter(30.0, "rad/(s2 V)", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        free = self.value("gain") * u - self.value("damping") * x
        return free + forces.get(Port.TORQUE, 0.0)


@final
class Boat(System):
    """Surge, sway and turn of a boat with two propellers."""

    name = "boat"
    state_names, state_units = ("surge", "sway", "turn"), ("m/s", "m/s", "rad/s")
    input_names, input_units = ("port_side", "starboard"), ("N", "N")
    ports = {Port.FORCE: 2, Port.TORQUE: 1}
    coordinates = (
        Coordinate("surge", "surge", Port.FORCE, row=0),
        Coordinate("sway", "sway", Port.FORCE, row=1),
        Coordinate("turn", "turn", Port.TORQUE),
    )
    residual_ports = {Port.FORCE: ResidualPort(2, 0.1, "m/s2"), Port.TORQUE: ResidualPort(1, 0.1, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.05, 20, (0.01, 0.01, 0.01), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {
        "thrust": Parameter(0.05, "1/kg", low=0.0),
        "lever": Parameter(0.03, "rad/(s2 N)", low=0.0),
        "drag": Parameter(0.4, "1/s", low=0.0),
    }

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        left, right = u[:, :1], u[:, 1:2]
        thrust, turn = self.value("thrust") * (left + right), self.value("lever") * (right - left)
        rates = torch.cat((thrust, torch.zeros_like(thrust), turn), 1) - self.value("drag") * x
        force, torque = forces.get(Port.FORCE, 0.0 * x[:, :2]), forces.get(Port.TORQUE, 0.0 * x[:, :1])
        return rates + torch.cat((force, torque), 1)


def sailed(
    strength: tuple[float, float], sideways: float, slip: float = 0.0, *, late: int = 0
) -> list[RawRun]:
    """Three runs of the boat: what each propeller gives, their force to the side [1/kg], drag of a turn [1/rad].

    `late` is how many rows later than logged starboard acts.
    """
    runs = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(5.0, 40.0, (40, 2)), 15, axis=0)
        acts = u * strength
        acts[late:, 1] = acts[: len(u) - late, 1].copy()
        acts[:late, 1] = acts[0, 1]

        def rates(x: Array, u: Array) -> Array:
            pushed = np.array([0.055 * u.sum(), sideways * u.sum(), 0.028 * (u[1] - u[0])])
            return pushed - 0.45 * x - np.array([slip * abs(x[2]) * x[0], 0.0, 0.0])

        run = simulated(seed, rates, [0.0] * 3, acts, 0.05, noise=0.01, rng=rng)
        runs.append(replace(run, u=u))
    return runs


def turned(torque: Torque, *, seconds: float, dt: float, size: float) -> list[RawRun]:
    """Three runs in which torques of 0.3 to 1.2 s turn the pendulum; `torque` of angle and speed acts on it, too."""

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], 12.0 * u[0] - 9.0 * np.sin(x[0]) - 0.2 * x[1] + torque(x[0], x[1])]

    runs = []
    for seed in range(3):
        rng, rows = np.random.default_rng(seed), round(seconds / dt)
        lasts = rng.uniform(0.3, 1.2, round(4 * seconds)) / dt
        u = np.repeat(rng.uniform(-size, size, len(lasts)), lasts.astype(int))[:rows, None]
        start = [rng.uniform(-1.0, 1.0), 0.0]
        runs.append(simulated(seed, rates, start, u, dt, noise=(0.001, 0.005), rng=rng))
    return runs


def stop(q: float, v: float) -> float:
    return -(60.0 + 8.0 * v) * (q - 0.3) if q > 0.3 else 0.0


LONG, FREE = {"seconds": 15.0, "dt": 0.005}, {"seconds": 20.0, "dt": 0.01}
ENDS = ["stop_above", "stop_below", "cubic_stiffness", "position_dependent_friction"]
Interval = tuple[float, float, float]
"""The truth, what the interval may miss it by, and how wide it may be."""


def swung(run: RawRun, *, bias: float = 0.0, tired: float = 0.0) -> RawRun:
    """A run whose angle reads too much, or on which a share less of the torque acts that grows with the time."""
    return replace(run, x=run.x + np.array([bias, 0.0]), u=run.u / (1.0 - tired * run.t[:, None]))


@pytest.mark.parametrize(
    ("torque", "making", "log", "candidates", "effect", "intervals"),
    [
        (lambda q, v: np.sin(7.0 * q), {**LONG, "size": 1.5}, {}, ["ripple", "coulomb_friction"], "ripple",
         {"order": (7.0, 0.001, np.inf), "sine": (1.0, 0.005, 0.05)}),
        (lambda q, v: 0.8 * np.sin(31.0 * q), {**LONG, "size": 1.0}, {}, None, "ripple",
         {"order": (31.0, 0.01, 0.1)}),
        (stop, {**LONG, "size": 0.4}, {}, ENDS, "stop_above",
         {"stiffness": (60.0, 0.3, np.inf), "end": (0.3, 0.002, np.inf)}),
        (lambda q, v: 0.0, {**LONG, "size": 1.0}, {"bias": 0.04}, None, "position_bias",
         {"bias": (0.04, 0.0003, 0.003)}),
        (lambda q, v: 0.0, {**FREE, "size": 0.6}, {"tired": 0.01}, None, "actuator_gain_drift",
         {"rate": (-0.01, 0.0002, np.inf)}),
    ],
    ids=["cogging over many turns", "teeth of any number", "a stop on one side", "an encoder off its zero",
         "it tires"],
)  # fmt: skip
@pytest.mark.slow
def test_what_turns_a_pendulum_beside_its_motor_is_named_with_its_size(
    torque: Torque,
    making: dict[str, Any],
    log: dict[str, float],
    candidates: list[str] | None,
    effect: str,
    intervals: dict[str, Interval],
) -> None:
    runs = [swung(run, **log) for run in turned(torque, **making)]
    found = nsde_torch.diagnose(runs, system=PENDULUM, candidates=candidates, say=False)
    assert found.added == [effect]
    for name, (truth, slack, width) in intervals.items():
        assert_interval(found.parameters, f"{effect}.{name}", truth, slack=slack, width=width)


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


def test_a_sound_machine_without_a_position_is_sound_in_slow_and_noisy_rows() -> None:
    runs = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(0.0, 0.1, 40), 45)[:, None]
        v = 15.0 + np.cumsum(0.05 * (3.5 * u[:, 0] - 0.15))
        v = np.concatenate(([15.0], v[:-1])) + 0.05 * rng.normal(size=len(u))
        runs.append(RawRun(f"run_{seed}", 0.05 * np.arange(len(u)), v[:, None], u))
    found = nsde_torch.diagnose(runs, system=Car, say=False)
    assert found.verdict == "no_effect"
    assert not found.not_done
    assert not found.content()["guard"]["objections"]


@pytest.mark.parametrize(
    ("strength", "sideways", "slip", "late", "effect", "intervals"),
    [
        ((0.92, 1.0), 0.0, 0.0, 0, "actuator_efficiency_loss", {"loss[0]": (0.08, 0.002, 0.02)}),
        ((1.0, 1.0), 0.0, 0.0, 3, "input_delay[starboard]", {"delay": (0.15, 0.001, 0.01)}),
        ((1.0, 1.0), 0.012, 0.0, 0, "force[sway] = c1 port_side + c2 starboard",
         dict.fromkeys(("c1", "c2"), (0.012, 1e-4, 0.002))),
        ((1.0, 1.0), 0.0, 0.3, 0, "force[surge] = c1 surge abs(turn)", {"c1": (-0.3, 0.01, 0.1)}),
    ],
    ids=["the weaker of two propellers", "one input of two is late", "a force that two inputs make",
         "a drag that grows with turns to both sides"],
)  # fmt: skip
@pytest.mark.slow
def test_what_moves_a_boat_beside_its_propellers_is_named_with_its_size(
    strength: tuple[float, float],
    sideways: float,
    slip: float,
    late: int,
    effect: str,
    intervals: dict[str, Interval],
) -> None:
    found = nsde_torch.diagnose(sailed(strength, sideways, slip, late=late), system=Boat, say=False)
    assert found.added == [effect]
    for name, (truth, slack, width) in intervals.items():
        assert_interval(found.parameters, f"{effect}.{name}", truth, slack=slack, width=width)


def test_the_zero_of_a_position_is_a_candidate_where_something_depends_on_it() -> None:
    assert not why_not(make_system("cartpole"), "position_bias[pole]")
    assert "nothing that is declared depends" in why_not(TwoJoints(), "position_bias[q1]")
    for spring, reason in (("linear_spring", "a steady force is the same"), ("cubic_stiffness", "")):
        sprung = TwoJoints().with_effects(TwoJoints().make_effect(f"{spring}[q1]", {"stiffness": 2.0}))
        found = why_not(sprung, "position_bias[q1]")
        assert reason in found
        assert bool(found) == bool(reason)


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


class Lift(System):
    """A ball under an electromagnet: z'' = g - k (i / z)^2, z the gap."""

    name = "lift"
    state_names, state_units = ("z", "z_dot"), ("m", "m/s")
    input_names, input_units = ("current",), ("A",)
    position_derivatives = (("z", "z_dot", "world"),)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 0.3, "m/s2")}
    defaults = Defaults(0.005, 20, (1e-5, 1e-3), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {"pull": Parameter(1e-3, "m3/(s2 A2)", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        falls = 9.81 - self.value("pull") * (u / x[:, :1]) ** 2
        return torch.cat((x[:, 1:], falls + forces.get(Port.FORCE, 0.0)), 1)


@pytest.mark.slow
def test_the_zero_of_a_gap_is_found_where_a_force_of_it_is_no_line() -> None:
    """Without it two laws, an inertia and a stop stood for 1.28 mm."""
    rng, dt, bias, runs = np.random.default_rng(5), 0.005, 0.0009, []

    def held_up(wanted: Array, seen: Array) -> Array:
        lift = 9.81 + 900.0 * (seen[0] - wanted) + 45.0 * seen[1]
        return np.sqrt(lift.clip(0.0) / 1.2e-3) * seen[0]

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], 9.81 - 1.2e-3 * (u[0] / x[0]) ** 2]

    for run in range(3):
        t, phases = dt * np.arange(1600), rng.uniform(0.0, 6.0, 3)
        waves = np.sin(2.0 * np.pi * rng.uniform(0.2, 1.5, (3, 1)) * t + phases[:, None])
        z = 0.012 + 0.0012 * waves.sum(0)[:, None]
        made = simulated(run, rates, [z[0, 0], 0.0], z, dt, noise=(2e-5, 2e-3), control=held_up, rng=rng)
        runs.append(replace(made, x=made.x + np.array([bias, 0.0])))
    found = nsde_torch.diagnose(runs, system=Lift, say=False)
    assert found.added == ["position_bias"]
    assert_interval(found.parameters, "position_bias.bias", bias, slack=1e-5, width=1e-4)


def test_what_disturbs_a_state_that_no_port_pushes_is_no_effect() -> None:
    found = nsde_torch.diagnose(turns(6, 60.0, ripple=0.3), system=CoilMotor, say=False)
    assert found.content()["verdict"] == "no_effect"


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
