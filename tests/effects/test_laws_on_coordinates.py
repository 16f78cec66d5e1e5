"""Laws of one coordinate: made for each coordinate of a machine, on its columns, in its units, and nowhere else."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.diagnosis.candidates import candidate_names, on_coordinates, why_not
from nsde_torch.effects import (
    EFFECTS,
    Coordinate,
    Effect,
    Law,
    Parameter,
    Port,
    Size,
    effect_class,
    effects_of,
    key_of,
    units,
)
from nsde_torch.errors import ConfigError
from nsde_torch.systems import ResidualPort, System, make_system, system_class
from nsde_torch.systems.coordinates import check_pushes
from nsde_torch.systems.parameters import ParameterVector
from tests.helpers.effect_rows import made, term
from tests.helpers.two_joints import HOME, TwoJoints

X = torch.tensor([[3.0, -0.5, 0.4, 0.2]])  # w2, w1, q2, q1


class Teeth(Law):
    reads_position = True
    formula = "-c sin(2 pi q / p)"
    source = "a test"
    size, pitch = Size(1.0, "force"), Parameter(0.4, "position", low=0.0)
    shapes = {"pitch": (0.4,)}
    relative = {"pitch": "position"}
    sentence = "Teeth hold {it} with {size}."

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.size * torch.sin(2.0 * torch.pi * self.q(x) / self.pitch)


class Narrow(Effect):  # of width 1 on a port of width 2
    port, formula, source = Port.TORQUE, "1", "a test"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return x[:, :1]


class Far(Narrow):  # reads columns that are not there
    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return x[:, [8, 9]]


STOP = {"stiffness": 2.0, "damping": 0.5, "end": 0.1}


@pytest.mark.parametrize(
    ("name", "values", "x", "expected"),
    [
        ("coulomb_friction[q1]", {"size": 0.3, "width": 0.01}, X, [0.3, 0.0]),
        ("coulomb_friction[q2]", {"size": 0.3, "width": 0.01}, X, [0.0, -0.3]),
        ("load_friction[q1]", {"coefficient": 0.1, "width": 0.01}, X, [0.5, 0.0]),
        ("ripple[q2]", {"sine": 0.2, "order": 5.0}, X, [0.0, 0.2 * math.sin(5.0 * 0.4)]),
        # a stop pushes back beyond its end alone, and one below is its mirror image
        ("stop_above[q2]", STOP, torch.tensor([[0.3, 0.0, -0.5, 0.0]]), [0.0, 0.0]),
        ("stop_above[q2]", STOP, torch.tensor([[0.3, 0.0, 0.1, 0.0]]), [0.0, 0.0]),
        ("stop_above[q2]", STOP, torch.tensor([[0.3, 0.0, 0.4, 0.0]]), [0.0, -0.6 - 0.045]),
        ("stop_below[q2]", {**STOP, "end": -0.1}, torch.tensor([[-0.3, 0.0, -0.4, 0.0]]), [0.0, 0.6 + 0.045]),
        ("stop_below[q2]", {**STOP, "end": -0.1}, torch.tensor([[-0.3, 0.0, 0.5, 0.0]]), [0.0, 0.0]),
    ],
)
def test_a_law_acts_on_the_columns_and_the_row_of_its_coordinate_alone(
    name: str, values: dict[str, float], x: Tensor, expected: list[float]
) -> None:
    u = torch.tensor([[0.0, 0.0, 5.0]])  # two inputs, then the load
    found = term(made(HOME, name, values), x, u)
    torch.testing.assert_close(found, torch.tensor([expected]), atol=1e-6, rtol=1e-6)


def test_a_weight_is_no_candidate_where_the_first_link_of_a_chain_or_gravity_itself_is() -> None:
    able = TwoJoints.able_effects()
    assert "gravity_torque[q2]" in able
    assert "gravity_torque[q1]" not in able
    assert "gravity and track_tilt" in why_not(make_system("cartpole"), "gravity_torque[pole]")


@pytest.mark.parametrize("link", [1, 2])
def test_a_link_weight_is_another_weight_in_the_equations_of_a_double_pendulum(link: int) -> None:
    home = "examples.double_pendulum.double_pendulum:DoublePendulum"
    x, u = torch.tensor([[0.3, -0.8, 0.5, 1.0], [2.0, 0.7, -0.4, 0.2]]), torch.full((2, 2), 0.1)
    sound = make_system(home, values={f"g{link}": 2.0}).drift(0.0, x, u)
    name, lighter = f"link_weight[q{link}]", {f"g{link}": 2.3, f"link_weight[q{link}].sine": 0.3}
    same = make_system(home, effects=[name], values=lighter).drift(0.0, x, u)
    torch.testing.assert_close(same.detach(), sound.detach())


def test_laws_of_two_coordinates_have_values_of_their_own() -> None:
    both = make_system(
        HOME,
        effects=["viscous_friction[q1]", "viscous_friction[q2]"],
        values={"viscous_friction[q1].damping": 1.0, "viscous_friction": {"q2": {"damping": 2.0}}},
    )
    rate = both.drift(0.0, X, torch.zeros(1, 2)).detach()
    torch.testing.assert_close(rate[:, :2], torch.tensor([[-2.0 * 3.0 / 0.2, 0.5 / 0.5]]))


def test_units_are_those_of_the_coordinate() -> None:
    system = make_system(HOME, effects=["cubic_stiffness[q1]", "stribeck_friction[q2]"])
    found = {name: unit for name, (_, unit) in system.all_declared().items()}
    assert found["cubic_stiffness[q1].stiffness"] == "N m/rad3"
    assert found["stribeck_friction[q2].size"] == "N m"
    assert found["stribeck_friction[q2].speed"] == "rad/s"
    assert units.of("force/speed", {"force": "m/s2", "speed": "m/s"}) == "1/s"
    assert units.of("force/speed2", {"force": "N", "speed": "m/s"}) == "N s2/m2"
    assert units.of("force/speed", {"force": "per cent!", "speed": "m/s"}) == "(per cent!)/(m/s)"


def test_every_coordinate_has_the_laws_of_the_catalogue_as_candidates() -> None:
    names = candidate_names(make_system(HOME))
    for law in ("coulomb", "viscous", "stribeck", "asymmetric", "position_dependent"):
        assert {f"{law}_friction[q1]", f"{law}_friction[q2]"} <= set(names)
    assert {f"constant_force[q{k}]" for k in (1, 2)} <= set(names)
    assert "load_friction[q1]" in names
    assert "load_friction[q2]" not in names, "that joint says no load"
    assert "coulomb_friction" not in names
    spread = on_coordinates(make_system(HOME), ["coulomb_friction", "input_delay"])
    each = ["input_delay", "input_delay[tau1]", "input_delay[tau2]"]
    assert spread == ["coulomb_friction[q1]", "coulomb_friction[q2]", *each]


def test_a_machine_with_one_coordinate_has_plain_names_and_takes_the_long_ones() -> None:
    for name in ("coulomb_friction", "coulomb_friction[q]"):
        system = make_system("mass_spring_damper", effects=[name], values={f"{name}.size": 0.7})
        assert system.effect_names[-1] == "coulomb_friction"
        assert float(system.all_declared()["coulomb_friction.size"][0]) == pytest.approx(0.7)


class Motor(System):
    """The speed of a motor, without its angle."""

    name = "motor"
    state_names, state_units = ("omega", "current"), ("rad/s", "A")
    input_names, input_units = ("voltage",), ("V",)
    ports = {Port.TORQUE: 1}
    residual_ports = {Port.TORQUE: ResidualPort(1, 10.0, "rad/s2")}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        raise NotImplementedError


def test_a_velocity_without_its_position_is_a_coordinate() -> None:
    (at,) = Motor.bound_coordinates()
    assert (at.declared, at.name, at.position, at.velocity, at.kind) == ("omega", "", None, 0, "joint")
    assert dict(at.units) == {"position": "rad", "speed": "rad/s", "force": "rad/s2"}
    able = effects_of("motor", Motor.ports, Motor.bound_coordinates())
    assert {"constant_force", "coulomb_friction", "viscous_friction", "quadratic_damping"} <= set(able)
    assert "linear_spring" not in able, "its position is not logged"


@pytest.mark.parametrize(
    "other",
    [
        {"state_units": ("K", "A")},
        {"residual_ports": {Port.TORQUE: ResidualPort(1, 10.0, "A/s")}},
        {"state_units": ("rad/s", "rad/s")},
        {"ports": {Port.TORQUE: 2}},
    ],
    ids=["no speed", "what is added is no force", "two speeds", "two rows"],
)
def test_what_is_not_surely_a_motion_is_no_coordinate(other: dict[str, Any]) -> None:
    assert {at.kind for at in type("Other", (Motor,), other).bound_coordinates()} == {"store"}


@pytest.mark.parametrize(
    ("older", "name"),
    [
        ("cart_coulomb_friction", "coulomb_friction[cart]"),
        ("pole_coulomb_friction", "coulomb_friction[pole]"),
        ("cart_viscous_friction", "viscous_friction[cart]"),
        ("pole_viscous_friction", "viscous_friction[pole]"),
        ("stribeck_friction", "stribeck_friction[cart]"),
        ("constant_force", "constant_force[cart]"),
    ],
)
def test_older_names_of_the_cart_and_pole_are_the_same_effects(older: str, name: str) -> None:
    assert make_system("cartpole", effects=[older]).effect_names == (name,)


def test_a_law_of_ones_own_is_an_effect_on_every_coordinate() -> None:
    key = f"{__name__}:Teeth"
    system = make_system(HOME, effects=[f"{key}[q2]"], values={"teeth[q2].size": 2.0})
    assert system.effect_names == ("teeth[q2]",)
    assert key_of(type(system.effects[0])) == f"{key}[q2]"  # type: ignore[arg-type]
    expected = -2.0 * torch.sin(torch.tensor(2.0 * torch.pi))
    torch.testing.assert_close(term(system.effects[0], X)[0, 1], expected, atol=1e-5, rtol=0.0)  # type: ignore[arg-type]
    cls = effect_class(f"{key}[q2]")
    assert cls.relative == {"pitch": "position[q2]"}
    assert cls.sentence == "Teeth hold q2 with {size}."


@pytest.mark.parametrize(
    ("system", "effect", "words"),
    [
        (HOME, "coulomb_friction", ["several coordinates", "coulomb_friction[q1], coulomb_friction[q2]"]),
        (HOME, "coulomb_friction[q3]", ["'q3' is none", "coulomb_friction[q1]"]),
        (HOME, "actuator_efficiency_loss[q1]", ["no law of one coordinate", "leave out [q1]"]),
        (HOME, "load_friction[q2]", ["`load`", "'q2'"]),
        ("cartpole", "link_weight[pole]", ["one of several angles", "'pole'"]),
        ("cartpole", "cubic_stiffness[pole]", ["rail or joint", "'pole' is of kind axis"]),
        ("quadrotor", "coulomb_friction", ["does not act on", "Coordinate("]),
        (HOME, f"{__name__}:Narrow", ["1", "port 'torque'", "has 2", "Law"]),
        (HOME, f"{__name__}:Far", ["cannot be worked out", "w2, w1, q2, q1"]),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(system: str, effect: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        make_system(system, effects=[effect])
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"velocity": "w9"}, ["velocity is 'w9'", "w2, w1"]),
        ({"position": "w1"}, ["the same state"]),
        ({"port": Port.FORCE}, ["port 'force'", "torque"]),
        ({"row": 2}, ["row 2", "has 2"]),
        ({"kind": "wheel"}, ["rail, joint, axis"]),
        ({"load": "weight"}, ["load 'weight'"]),
        ({"name": "q 1"}, ["must be a word"]),
        ({"name": "q2"}, ["two coordinates called 'q2'"]),
    ],
)
def test_a_coordinate_that_does_not_fit_its_machine_is_refused(
    change: Mapping[str, Any], words: list[str]
) -> None:
    given: dict[str, Any] = {"name": "q1", "velocity": "w1", "port": Port.TORQUE, "position": "q1", **change}

    class Wrong(TwoJoints):
        coordinates = (Coordinate(**given), TwoJoints.coordinates[1])

    with pytest.raises(ConfigError) as caught:
        Wrong()
    assert [word for word in words if word not in str(caught.value)] == []


def test_a_coordinate_on_the_wrong_row_is_refused_before_a_diagnosis() -> None:
    class Crossed(TwoJoints):
        coordinates = (replace(TwoJoints.coordinates[0], row=1), replace(TwoJoints.coordinates[1], row=0))

    for system in (make_system(n) for n in ("mass_spring_damper", "cartpole", HOME)):
        check_pushes(system, torch.zeros(3, system.nx), torch.zeros(3, system.nu))
    with pytest.raises(ConfigError, match=r"'q1'.*row 1.*'w1' \(it speeds up w2\)"):
        check_pushes(Crossed(), torch.zeros(3, 4), torch.zeros(3, 2))


def test_it_is_another_inertia_of_its_joint() -> None:
    u = torch.tensor([[0.4, -0.7]])
    heavy = make_system(HOME, values={"inertia": [0.5, 0.25]}).drift(0.0, X, u)
    effect = {"effects": ["added_inertia[q2]"], "values": {"added_inertia[q2].share": 0.2}}
    same = make_system(HOME, **effect).drift(0.0, X, u)
    torch.testing.assert_close(same.detach(), heavy.detach())


EACH = sorted(name for name, cls in EFFECTS.items() if cls.each_input)


@torch.no_grad()
@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize("step", [0.0, 0.02])
def test_the_input_gets_what_it_gets_of_the_effect_on_all_and_the_other_nothing(
    name: str, step: float
) -> None:
    machine, g = make_system(HOME, declared=[]).double(), torch.Generator().manual_seed(1)
    values = {key: max(0.3, 2.0 * (spec.low or 0.0)) for key, spec in EFFECTS[name].PARAMETERS.items()}
    whole, one = (machine.make_effect(n, values).double() for n in (name, f"{name}[tau2]"))
    whole.step = one.step = step
    x, u = (torch.randn(30, k, generator=g, dtype=torch.float64) for k in (4, 2))
    parts = whole.n_memory // 2
    memory = torch.randn(30, whole.n_memory, generator=g, dtype=torch.float64)
    own = (
        memory[:, 1::2] if parts else memory
    )  # that of the second input: its states follow those of the first
    assert one.n_memory == parts
    term = one(0.7, x, u, own)
    torch.testing.assert_close(term[:, 1], whole(0.7, x, u, memory)[:, 1])
    assert not term[:, 0].any()
    torch.testing.assert_close(one.memory_rate(0.7, x, u, own), whole.memory_rate(0.7, x, u, memory)[:, 1::2])
    torch.testing.assert_close(one.memory_start(x, u), whole.memory_start(x, u)[:, 1::2])
    if (held := whole.held(u, 0.02)) is not None:
        torch.testing.assert_close(one.held(u, 0.02), held[:, 1::2])


def test_it_has_the_unit_of_its_input_and_is_found_again_by_its_name() -> None:
    cls = system_class(HOME).effect_class("actuator_rate_limit[tau1]")
    assert cls.PARAMETERS["rate"].unit == "N m/s"
    assert cls.relative == {"rate": "input[tau1]"}
    assert key_of(cls) == "actuator_rate_limit[tau1]"
    assert "On tau1 alone" in cls.sentence


def test_machines_with_one_input_and_rotors_have_none() -> None:
    several = candidate_names(make_system(HOME))
    assert {f"{name}[{at}]" for name in EACH for at in ("tau1", "tau2")} <= set(several)
    named = ["actuator_lag", "actuator_lag[tau1]", "actuator_lag[tau2]"]
    assert on_coordinates(make_system(HOME), ["actuator_lag"]) == named
    for system in ("cartpole", "hexacopter"):
        names = system_class(system).able_effects()
        assert not [n for n in names if n.partition("[")[0] in EACH and "[" in n]


def test_a_stop_begins_where_the_data_are() -> None:
    system = make_system("mass_spring_damper", effects=["stop_above"])
    vector = ParameterVector(system)
    vector.limit({"position": 2.0})
    (end,) = (j for j, label in enumerate(vector.labels) if label == "stop_above.end")
    assert (vector.low[end], vector.high[end]) == (-3.0, 3.0)
