"""Systems by name, and their declared parameters as one vector; every mistake is refused with the choices at hand."""

import copy
import math
import zlib
from pathlib import Path
from typing import Any

import pytest
import torch

from nsde_torch.effects.multirotor_forces import LinearDrag
from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.systems import make_system


def test_values_reach_the_system_and_its_effects_and_one_number_serves_all_axes() -> None:
    values = {"thrust_gain": 5.5, "linear_drag.drag": [0.2, 0.3, 0.4]}
    declared = make_system("hexacopter", effects=["linear_drag"], values=values).all_declared()
    assert declared["thrust_gain"][1] == "m/s2"
    torch.testing.assert_close(declared["thrust_gain"][0], torch.tensor([5.5]))
    torch.testing.assert_close(declared["linear_drag.drag"][0], torch.tensor([0.2, 0.3, 0.4]))
    one = make_system("hexacopter", effects=["linear_drag"], values={"linear_drag.drag": 0.2})
    torch.testing.assert_close(one.all_declared()["linear_drag.drag"][0], torch.full((3,), 0.2))


def test_an_effect_may_be_an_object() -> None:
    s = make_system("quadrotor", effects=[LinearDrag({"drag": 0.7})])
    assert s.effect_names == ("linear_drag",)
    torch.testing.assert_close(s.all_declared()["linear_drag.drag"][0], torch.full((3,), 0.7))


def test_effects_on_one_port_add_up() -> None:
    x, u, friction = torch.tensor([[0.3, 0.7]]), torch.zeros(1, 1), ["coulomb_friction"]
    both, alone, plain = (
        make_system("mass_spring_damper", **made).drift(0.0, x, u)[0, 1]
        for made in ({"effects": friction}, {"declared": [], "effects": friction}, {})
    )
    torch.testing.assert_close(both, alone + plain)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("hexacoptr", {}, ["unknown", "mass_spring_damper", "Did you mean 'hexacopter'", "module:Class"]),
        ("no_such_module:Mine", {}, ["no module 'no_such_module'", "--config-dir", "PYTHONPATH"]),
        ("nsde_torch.errors:Mine", {}, ["no class 'Mine'"]),
        ("nsde_torch.errors:ConfigError", {}, ["subclass of nsde_torch.systems.System"]),
        ("hexacopter", {"effects": ["linear_drg"]}, ["not in the catalogue", "Did you mean 'linear_drag'"]),
        ("hexacopter", {"effects": ["viscous_friction"]}, ["does not act on", "hexacopter", "motor_lag"]),
        ("mass_spring_damper", {"effects": ["linear_drag"]}, ["does not act on", "coulomb_friction"]),
        ("cartpole", {"effects": ["motor_lag"]}, ["does not act on", "viscous_friction"]),
        ("hexacopter", {"effects": ["linear_drag", "linear_drag"]}, ["twice", "linear_drag"]),
        ("mass_spring_damper", {"effects": ["linear_spring"]}, ["twice", "linear_spring"]),
        ("hexacopter", {"values": {"mass": 1.0}}, ["no parameter 'mass'", "thrust_gain"]),
        ("hexacopter", {"values": {"linear_drag.drag": 1.0}}, ["does not have", "linear_drag", "none"]),
        ("hexacopter", {"effects": ["linear_drag"], "values": {"linear_drag.size": 1.0}},
         ["LinearDrag has no parameter 'size'", "drag"]),
        ("hexacopter", {"values": {"thrust_gain": -1.0}}, ["thrust_gain", "m/s2", "above 0", "-1.0"]),
        ("hexacopter", {"values": {"thrust_gain": 0.0}}, ["above 0", "0.0"]),
        ("cartpole", {"values": {"pole_share": 1.0}}, ["pole_share", "0.95"]),
        ("hexacopter", {"values": {"thrust_gain": [1.0, 2.0]}}, ["takes 1 number", "got 2"]),
        ("cartpole", {"thrust_degree": 2}, ["cartpole", "thrust_degree"]),
        ("quadrotor", {"thrust_degree": 4}, ["thrust_degree", "1, 2 or 3"]),
        ("quadrotor", {"thrust_degree": 1.5}, ["thrust_degree", "1, 2 or 3"]),
        ("hexacopter", {"yaw_direction": 0}, ["`yaw_direction` must be 1 or -1"]),
        *(("hexacopter", {"values": {name: value}}, [name, "must be finite"])
          for name in ("thrust_gain", "thrust_offset", "inertia_x") for value in (math.nan, math.inf)),
    ],
)  # fmt: skip
def test_a_mistake_is_refused_with_its_remedy(name: str, options: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        make_system(name, **options)
    assert [word for word in words if word not in str(caught.value)] == []


def test_rows_of_the_wrong_width_are_refused_with_the_names_of_the_columns() -> None:
    s = make_system("cartpole")
    with pytest.raises(ShapeError, match=r"`x` must have 4 columns \(x, x_dot, theta, theta_dot\); got 3"):
        s.check_rows("x", torch.zeros(2, 3), s.nx)


def test_a_system_of_ones_own_is_found_by_module_and_class_and_what_it_cannot_import_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_machines.py").write_text("from nsde_torch.systems import MassSpringDamper as Springs\n")
    (tmp_path / "my_broken_machine.py").write_text("import no_such_package_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert make_system("my_machines:Springs").name == "mass_spring_damper"
    with pytest.raises(ConfigError, match="no_such_package_at_all"):
        make_system("my_broken_machine:Mine")


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ('"q_dot", "world"', '"q_dot"', r"has \(position, velocity, frame\).* got \('q', 'q_dot'\)"),
        ('(("q", "q_dot",', '(("q", "qdot",', r"pair of states \(q, q_dot\)"),
        ('"m", "m/s"', '"m",', "`state_units` must have one unit for each of the 2"),
        ('("force",)', '("force")', "are tuples, .* got 'force'"),
        ('("force",)', '("q",)', "has several columns called q"),
        (
            "import torch\nfrom nsde_torch.effects",
            "import torch\nfrom nsde_torch.systems import Sytem\nfrom nsde_torch.effects",
            r"does not load: ImportError.*line 2",
        ),
        ("def dynamics(self", "def dynamics self", "does not load: SyntaxError"),
        ("class Mass(", "class Masses(", "has no class 'Mass'. Did you mean 'Masses'"),
        ("    ports = {Port.FORCE: 1}\n", "", "does not say what its `ports` are"),
        ("dw), 1)", "dw), 0)", r"must return rates \(N, 2\); of 3 states it returned \(6, 1\)"),
        ("x[:, 1:]", "x[:, 2:3] @ x", r"fails: RuntimeError.*line 18"),
        ("+ forces[Port.FORCE]", "", r"a force \(N, 1\) on 'force', does not answer it"),
    ],
)
def test_a_mistake_in_a_machine_of_ones_own_is_named(
    right: str, wrong: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MASS.count(right) == 1
    name = f"mass_{zlib.crc32((right + wrong).encode())}"
    (tmp_path / f"{name}.py").write_text(MASS.replace(right, wrong))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=said):
        make_system(f"{name}:Mass")


MASS = """import torch
from nsde_torch.effects import Port
from nsde_torch.systems import Defaults, ResidualPort, System

class Mass(System):
    name = "mass"
    state_names, state_units = ("q", "q_dot"), ("m", "m/s")
    input_names, input_units = ("force",), ("N",)
    position_derivatives = (("q", "q_dot", "world"),)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 5.0, "m/s2")}
    defaults = Defaults(0.02, 25, (0.2, 1.0), 0.1, 1.0, "euler_maruyama")

    def dynamics(self, t, x, u, forces):
        dw = u
        if Port.FORCE in forces:
            dw = dw + forces[Port.FORCE]
        return torch.cat((x[:, 1:], dw), 1)
"""


def test_a_copy_has_numbers_of_its_own() -> None:
    system = make_system("hexacopter", effects=["motor_lag", "linear_drag"])
    before = {name: value.clone() for name, value in system.state_dict().items()}
    for mine in (copy.deepcopy(system), system.with_effects()):
        for value in mine.parameters():
            torch.nn.init.constant_(value, 7.0)
        mine.set_step(0.5)
    assert all(torch.equal(value, before[name]) for name, value in system.state_dict().items())
    assert system.step != 0.5


def test_a_copy_with_further_effects_moves_as_one_made_with_them() -> None:
    names = ["motor_lag", "battery_voltage", "linear_drag", "input_delay"]
    values = {"linear_drag.drag": 0.3}
    made = make_system("hexacopter", effects=names, values=values).double()
    plain = make_system("hexacopter", effects=names[:1]).double()
    effects = dict(zip(made.effect_names, made.effects, strict=True))
    grown = plain.with_effects(*(effects[n] for n in names[1:]))
    x, u = torch.randn(5, 13).double(), torch.rand(5, 7).double()
    z = made.augment(x, u)
    torch.testing.assert_close(grown.augment(x, u), z)
    torch.testing.assert_close(grown.drift(0.0, z, u), made.drift(0.0, z, u))
    assert plain.effect_names == ("motor_lag",)
    less = plain.drift(0.0, plain.augment(x, u), u)[:, :13] - grown.drift(0.0, z, u)[:, :13]
    assert float(less.detach().abs().max()) > 0.01
    with pytest.raises(ConfigError, match="already"):
        grown.with_effects(effects["linear_drag"])  # type: ignore[arg-type]


def test_an_effect_finds_its_column_among_those_that_a_machine_is_given() -> None:
    given = make_system("hexacopter").reading("air_temperature", "battery_voltage")
    assert given.exogenous == ("air_temperature", "battery_voltage")
    told = given.with_effects(*make_system("hexacopter", effects=["battery_voltage"]).effects)
    x, u = torch.zeros(1, 13), torch.full((1, 8), 0.4)
    x[:, 6] = 1.0
    u[:, 6:] = torch.tensor([400.0, 16.0])  # at 16 V the effect is nothing, whatever the temperature is
    torch.testing.assert_close(told.drift(0.0, x, u), given.drift(0.0, x, u))
    u[:, 7] = 15.0
    assert told.drift(0.0, x, u)[0, 5] < given.drift(0.0, x, u)[0, 5] - 0.1
