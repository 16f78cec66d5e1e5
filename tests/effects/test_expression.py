"""Expressions as effects: their grammar, their values by hand, and what is refused."""

from pathlib import Path

import pytest
import torch
import yaml
from torch import Tensor

from nsde_torch.effects import Effect, Parameter, Port, files
from nsde_torch.effects.expression_grammar import (
    Variable,
    in_text,
    is_law,
    latex,
    nodes,
    parse,
    sympy_text,
    valued,
)
from nsde_torch.errors import ConfigError
from nsde_torch.rotation import rotate_back
from nsde_torch.systems import make_system
from nsde_torch.systems.options import system_options
from nsde_torch.systems.vocabulary import seen_by
from tests.helpers.effect_rows import random_rows

STOP = "force = c1 q q_dot - c2 max(q - k1, 0)"
TWIST = "body_moment[y] = c1 v_body_x w_z + c2 up_x collective^2"


class ByHand(Effect):
    """The same as `TWIST`."""

    port, formula, source = Port.BODY_MOMENT, "see TWIST", "this test"
    c1, c2 = Parameter(0.0, "1/m"), Parameter(0.0, "rad/s2")

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        q = x[:, 6:10]
        up = torch.zeros_like(x[:, :3])
        up[:, 2] = 1.0
        forward, tilt = rotate_back(q, x[:, 3:6])[:, 0], rotate_back(q, up)[:, 0]
        out = torch.zeros_like(x[:, :3])
        out[:, 1] = self.c1 * forward * x[:, 12] + self.c2 * tilt * u[:, :6].sum(1) ** 2
        return out


def test_a_law_as_text_is_the_effect_that_a_class_of_ten_lines_would_be() -> None:
    values = {"c1": 0.44, "c2": -0.3}
    ours = make_system("hexacopter", effects=[TWIST], values={f"{TWIST}.{k}": v for k, v in values.items()})
    theirs = make_system("hexacopter").with_effects(ByHand(values))
    x, u = random_rows(ours, 50)
    rates = [system.double().drift(0.0, x, u) for system in (ours, theirs)]
    assert torch.allclose(*rates, rtol=1e-6, atol=1e-6)
    assert (rates[0] - make_system("hexacopter").double().drift(0.0, x, u))[:, 11].abs().max() > 0.1


def test_a_law_reads_states_inputs_and_columns_of_the_log_and_has_derivatives() -> None:
    law = "force = c1 sign(q_dot, k1) logged(load) - c2 min(q, 0)^2 cos(k2 q) force"
    law += " + c3 peak(q_dot, k3) expm1(k4 q) time + c4 root(q) + c5 pow(q, k5)"
    values = {"c1": 0.5, "c2": 0.2, "c3": 0.3, "c4": 0.6, "c5": 0.8}
    values |= {"k1": 0.1, "k2": 3.0, "k3": 0.7, "k4": 0.9, "k5": 1.3}
    system = make_system("mass_spring_damper", effects=[law]).double()
    for name, value in values.items():
        system.effects[-1].set_value(name, torch.tensor([value]))  # type: ignore[operator]
    assert system.exogenous == ("load",)
    x, u = random_rows(system, 50)
    u = torch.cat((u, torch.linspace(0.0, 2.0, len(u), dtype=torch.float64)[:, None]), 1)
    q, v = x[:, 0], x[:, 1]
    expected = 0.5 * torch.tanh(v / 0.1) * u[:, 1] - 0.2 * q.clamp(max=0) ** 2 * torch.cos(3.0 * q) * u[:, 0]
    expected = expected + 1.5 * 0.3 * 1.4 * v / (v**2 + 0.49) * (torch.exp(0.9 * q) - 1.0)
    expected = expected + 0.6 * q.sign() * q.abs().sqrt() + 0.8 * q.sign() * q.abs() ** 1.3
    effect = system.effects[-1]
    assert isinstance(effect, Effect)
    found = effect(1.5, x, seen_by(system, effect, 1.5, x, u), x[:, :0])[:, 0]
    assert torch.allclose(found, expected, rtol=1e-6, atol=1e-7)
    system.drift(1.5, x, u).square().sum().backward()  # type: ignore[no-untyped-call]
    assert all(p.grad is not None and bool(p.grad.abs() > 0) for p in effect.parameters())


def test_a_file_holds_laws_and_gives_them_back(tmp_path: Path) -> None:
    path = tmp_path / "effects.yaml"
    files.write(path, "mass_spring_damper", {STOP: {"c1": 0.3, "c2": 1.5, "k1": 0.4}}, "a test")
    system = system_options("mass_spring_damper", effects=path).make()
    assert system.effect_names[-1] == STOP
    found = {k: float(v) for k, (v, _) in system.all_declared().items() if k.startswith(STOP)}
    assert found == pytest.approx({f"{STOP}.c1": 0.3, f"{STOP}.c2": 1.5, f"{STOP}.k1": 0.4})
    hostile = {"effects": {"force = c1 __import__('os')": {"c1": 1.0}}}
    path.write_text(yaml.safe_dump(hostile), encoding="utf-8")
    with pytest.raises(ConfigError, match="is not of the grammar"):
        system_options("mass_spring_damper", effects=path).make()


SPRING, HEXA = "mass_spring_damper", "hexacopter"


def units(system: str, law: str) -> dict[str, str]:
    made = make_system(system).make_effect(law)
    return {name: unit for name, (_, unit) in made.declared_parameters().items()}


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("force=c1*q*q_dot", "force = c1 q q_dot"),
        ("force = c1 q  q_dot - c2*max( q-k1 , 0 )^2", "force = c1 q q_dot - c2 max(q - k1, 0)^2"),
        ("body_moment[y] = -c_swing v_body_x w_z", "body_moment[y] = -c_swing v_body_x w_z"),
        ("torque = c1 ((q + k1)) sin(2 theta)", "torque = c1 (q + k1) sin(2 theta)"),
        ("force=c1 logged(voltage) sign(q_dot, k1)", "force = c1 logged(voltage) sign(q_dot, k1)"),
        ("force = c1 (-q)^2 (-(q - k1))", "force = c1 (-q)^2 (-(q - k1))"),
        ("force = c1", "force = c1"),
    ],
)
def test_every_spelling_of_a_law_has_one_name_which_is_a_spelling_of_it(written: str, name: str) -> None:
    assert parse(written).text == name
    assert parse(name) == parse(written)
    assert is_law(name)


def test_a_variable_may_be_called_as_a_function_is() -> None:
    variables = {
        n.name for n in nodes(parse("flow = c1 window (a - b) + c2 root^2").right) if isinstance(n, Variable)
    }
    assert variables == {"window", "root", "a", "b"}


def test_sizes_are_the_factors_of_terms_and_all_other_coefficients_are_shapes() -> None:
    law = parse("force = c1 max(q - k1, 0) - c2 sign(q_dot, k2) cos(k1 q)")
    assert (law.sizes, law.shapes) == (("c1", "c2"), ("k1", "k2"))
    assert in_text(law.right).startswith("c1 max(q - k1, 0)")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("force = c1 __import__('os').system('true')", r"\"'\" is not of the grammar \(character 23\)"),
        ("force = c1 q.__class__", r"'\.' is not of the grammar \(character 13\)"),
        ("force = c1 eval(q)", "'eval' is no function; functions are abs, sin"),
        ("force = c1 [q for q in q]", r"'\[' does not belong here"),
        ("force = c1 q; c2", "';' is not of the grammar"),
        ("force = c1 ${oc.env:HOME}", r"'\$' is not of the grammar"),
        ("force = c1 {c1}", r"'\{' is not of the grammar"),
        ("force = c1 " + "(" * 40 + "q" + ")" * 40, "nested more than 12 deep"),
        ("force = c1 " + "q " * 300, "at most 400 characters"),
        ("force = c1 q^99", "whole number from 2 to 9; got '99'"),
        ("force = c1 q^q", "whole number from 2 to 9; got 'q'"),
        ("force = c1 q^2^2", "does not belong here"),
        ("force = 0.3 q", r"numbers in a law are whole .* \{c1: 0.3\}"),
        ("force = q q_dot", "the term 'q q_dot' has no coefficient"),
        ("force = c1 c2 q", "has 2 coefficients as a factor"),
        ("force = c1 q + c1 q_dot", "'c1' stands twice"),
        ("force = c1 (q + c1)", "'c1' stands twice"),
        ("force = c1 max(q)", r"max takes 2 argument\(s\); got 1"),
        ("force = c1 max(q, 0", r"expected '\)', got the end"),
        ("force = c1 q +", "expected a variable, a coefficient or a function, got the end"),
        ("force[ = c1 q", "expected the name of a row, got '='"),
        ("= c1 q", "expected the name of a port, got '='"),
        ("force = ", "expected a variable"),
    ],
)
def test_what_is_not_of_the_grammar_is_refused_with_its_place(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        parse(text)


@pytest.mark.parametrize(
    ("system", "text", "says"),
    [
        (SPRING, "force = c1 qdot", "'qdot' is no variable .* there are q, q_dot, force.*Did you mean 'q"),
        (SPRING, "forse = c1 q", "'forse' is no port .* there are force, input, rate"),
        (HEXA, "body_moment = c1 w_x", r"written body_moment\[x\], body_moment\[y\], body_moment\[z\]"),
        (SPRING, "force[y] = c1 q", "is written force = "),
        (SPRING, "force = c1 max(q - q_dot, 0)", "q is in m and q_dot in m/s"),
        (SPRING, "force = c1 expm1(q)", "takes a number without unit; q is in m"),
        (SPRING, "force = c1 sin(q)", r"takes an angle \[rad\]; q is in m. Write sin\(k1 q\)"),
        (HEXA, "input[u_1] = c1 v_body_x", "a law of the input reads states and inputs, not 'v_body_x'"),
    ],
)
def test_what_does_not_fit_the_machine_is_refused_and_what_there_is_is_listed(
    system: str, text: str, says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        make_system(system, effects=[text])


def test_coefficients_have_the_units_that_the_port_asks_for() -> None:
    law = "force = c1 q q_dot - c2 max(q - k1, 0)^2 + c3 sin(k2 q) + c4 sign(q_dot, k3) + c5 q force"
    assert units(SPRING, law) == {
        **{"c1": "1/(m s)", "c2": "1/(m s2)", "c3": "m/s2", "c4": "m/s2", "c5": "1/(s2 N)"},
        **{"k1": "m", "k2": "rad/m", "k3": "m/s"},
    }
    assert units("hexacopter", "body_moment[y] = c1 v_body_x w_z") == {"c1": "1/m"}
    assert units("hexacopter", "body_force[z] = c1 logged(battery_voltage)") == {"c1": "SI"}
    assert units("cartpole", "rate[x_dot] = c1 sin(theta)") == {"c1": "m/s2"}


def test_a_law_with_its_values_reads_in_text_in_latex_and_for_sympy() -> None:
    law = parse("body_force[z] = c1 v_body_x^2 - c2 max(q_dot - k1, 0) abs(theta) + c3 sign(q_dot, k2)")
    values = {"c1": -0.298, "c2": -1e-5, "c3": 2.0, "k1": -0.4, "k2": 0.01}
    text = "body_force[z] = -0.298 v_body_x^2 + 1e-05 max(q_dot + 0.4, 0) abs(theta) + 2 sign(q_dot, 0.01)"
    assert valued(law, values) == text
    assert latex(law, values) == (
        r"\mathrm{body\ force}_{z} = -0.298\,v_{body\,x}^{2} + 1 \cdot 10^{-5}\,\max\left(\dot{q} + 0.4, 0\right)"
        r"\,\left|\theta\right| + 2\,\tanh\left(\dot{q} / 0.01\right)"
    )
    assert sympy_text(law, values) == (
        "-0.298*v_body_x**2 + 1e-05*Max(q_dot + 0.4, 0)*Abs(theta) + 2.0*tanh((q_dot)/(0.01))"
    )
    assert sympy_text(parse("force = c1 root(q)"), {"c1": 2.0}) == "2.0*sign(q)*sqrt(Abs(q))"
    assert latex(parse("force = c1 root(q)"), {"c1": 2.0}).endswith(r"\sqrt{\left|q\right|}")
    law = parse("force = c1 peak(q_dot, k1) + c2 expm1(k2 q)")
    values = {"c1": -30.0, "c2": 0.5, "k1": 8.0, "k2": 2.0}
    assert valued(law, values) == "force = -30 peak(q_dot, 8) + 0.5 (exp(2 q) - 1)"
    assert latex(law, values) == (
        r"\mathrm{force} = -30\,\frac{2\,(\dot{q})\,8}{(\dot{q})^2 + 8^2} + 0.5\,\left(e^{2\,q} - 1\right)"
    )
    assert sympy_text(law, values) == ("-30.0*2*(q_dot)*(8.0)/((q_dot)**2 + (8.0)**2) + 0.5*(exp(2.0*q) - 1)")
