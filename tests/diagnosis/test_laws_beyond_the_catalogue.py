"""Laws that no catalogue has: found, verified and written, or unexplained; silence where there are none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.diagnosis.beyond_catalogue import same_effect, zero_of_an_input
from nsde_torch.diagnosis.candidates import candidate_names, joined
from nsde_torch.diagnosis.decisions import Budgets, Decisions, Options
from nsde_torch.diagnosis.laws import Term, terms_of
from nsde_torch.diagnosis.result import looks_like
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects.expression_grammar import parse
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system
from nsde_torch.systems.options import system_options
from tests.helpers.diagnosed import assert_interval, diagnosed, recorded
from tests.helpers.machines import Array, simulated
from tests.helpers.two_joints import HOME

LAW = "force = c1 q q_dot"
HALF = "force = c1 max(q_dot, 0)^2"
SHORT: dict[str, Any] = {"durations": (8.0,) * 4, "dt": 0.02}


def finding(content: dict[str, Any], name: str) -> dict[str, Any]:
    return next(f for f in content["findings"] if f["name"] == name)


def test_a_product_that_no_catalogue_has_is_found_added_verified_and_written(tmp_path: Path) -> None:
    found, content = diagnosed("mass_spring_damper", {LAW: {"c1": 0.8}}, **SHORT)
    assert (content["verdict"], content["added"]) == ("effect_found", [LAW])
    assert not any(row["chosen"] for row in content["ranking"]), "the law came before what imitates it"
    own = finding(content, LAW)
    assert (own["kind"], own["verified"], own["lead"]) == ("formula", True, False)
    assert own["latex"].endswith(r"\,q\,\dot{q}")
    assert own["sympy"].endswith("*q*q_dot")
    assert own["law"].startswith("force = 0.")
    assert own["looks_like"] == "friction that depends on the place"
    assert_interval(content["parameters"], f"{LAW}.c1", 0.8, slack=0.05)
    assert content["parameters"][f"{LAW}.c1"]["unit"] == "1/(m s)"
    assert content["errors"]["residual"]["q_dot"]["ratio"] < 0.8
    assert LAW in found.report
    assert own["law"] in found.report
    page = found.save(tmp_path).read_text(encoding="utf-8")
    assert "LaTeX" in page
    assert (tmp_path / "plots" / "effect_force_c1_q_q_dot.png").is_file()
    system = system_options("mass_spring_damper", effects=tmp_path / "effects.yaml").make()
    value = float(system.all_declared()[f"{LAW}.c1"][0])
    assert value == pytest.approx(content["parameters"][f"{LAW}.c1"]["value"], rel=1e-5)


@pytest.mark.slow
def test_a_spring_that_rests_under_preload_is_that() -> None:
    """In a throttle it was a magnet, a ripple and two waves."""
    law, rng, runs = "force = c1 sign(q - k1, k2)", np.random.default_rng(5), []

    def rates(x: Array, u: Array) -> list[float]:
        return [x[1], u[0] - 4.0 * x[0] - 0.5 * x[1] - 0.6 * np.tanh((x[0] - 0.12) / 0.01)]

    for run in range(2):
        waves, phase = rng.uniform(0.3, 4.0, 5), rng.uniform(0.0, 6.3, 5)
        u = 0.8 * np.sin(0.02 * np.arange(600)[:, None] * waves + phase).sum(1, keepdims=True)
        runs.append(simulated(run, rates, [0.1, 0.0], u, 0.02, noise=(0.001, 0.005), rng=rng))
    content = nsde_torch.diagnose(runs, system="mass_spring_damper", say=False).content()
    assert content["added"] == [law]
    assert "preload" in finding(content, law)["looks_like"]
    assert_interval(content["parameters"], f"{law}.c1", -0.6, slack=0.02)
    assert_interval(content["parameters"], f"{law}.k1", 0.12, slack=0.001)


@pytest.mark.slow
def test_a_law_that_explains_a_part_of_what_functions_do_is_not_named() -> None:
    most = Decisions(law_share=5.0)  # no law explains five times what functions do
    _, content = diagnosed("mass_spring_damper", {HALF: {"c1": -6.0}}, decisions=most, **SHORT)
    assert (content["verdict"], content["added"]) == ("unexplained", [])
    _, content = diagnosed("mass_spring_damper", {HALF: {"c1": -6.0}}, **SHORT)
    assert content["added"] == [HALF]


@pytest.mark.slow
def test_beside_an_effect_of_the_catalogue_that_one_keeps_its_name() -> None:
    law = "force = c1 q^2"
    both = ({law: {"c1": -1.0}}, {"coulomb_friction": {"size": 0.15}})
    _, content = diagnosed("mass_spring_damper", *both, **SHORT)
    assert content["verdict"] == "effect_found"
    assert sorted(content["added"]) == ["coulomb_friction", law]


@pytest.mark.slow
def test_laws_are_tried_neither_beside_named_candidates_nor_where_the_budget_has_none() -> None:
    truth = {LAW: {"c1": 0.8}}
    few = Options(candidates=("coulomb_friction",))
    _, content = diagnosed("mass_spring_damper", truth, options=few, **SHORT)
    assert (content["verdict"], content["added"]) == ("unexplained", [])
    _, content = diagnosed("mass_spring_damper", truth, budgets=Budgets(laws=0), **SHORT)
    assert all(f["lead"] and f["kind"] != "formula" for f in content["findings"])


def test_every_term_of_the_library_is_of_the_grammar_and_has_one_spelling() -> None:
    rng = np.random.default_rng(0)
    names = ["theta", "theta_dot", "x_dot"]
    terms = terms_of(names, {n: rng.normal(size=200) for n in names}, {"theta": "rad"})
    texts = [
        "torque = " + " + ".join(f"c{n} {part}".strip() for n, part in enumerate(term.parts, 1))
        for term in terms
    ]
    assert all(parse(text).text == text for text in texts)
    assert len(set(texts)) == len({(term.parts, *dict(term.start)) for term in terms})
    system = make_system("cartpole")
    for term, text in zip(terms, texts, strict=True):
        sizes = {"c1", "c2"} if len(term.parts) > 1 else {"c1"}
        assert set(system.make_effect(text).declared_parameters()) == {*sizes, *dict(term.start)}
    assert {
        "torque = c1 theta_dot x_dot",
        "torque = c1 sin(theta) x_dot",
        "torque = c1 sin(3 theta)",
        "torque = c1 theta + c2 x_dot",
        "torque = c1 expm1(k1 theta)",
        "torque = c1 peak(x_dot, k1)",
        "torque = c1 window(theta - k1, k2)",
        "torque = c1 pow(theta_dot, k1)",
        "torque = c1 pow(max(theta - k1, 0), k2)",
    } <= set(texts)


@pytest.mark.parametrize(
    ("unit", "level", "pole"), [("rad", True, False), ("m/s", False, False), ("m", True, True)]
)
def test_a_speed_has_no_power_beyond_a_level_and_an_angle_no_pole(unit: str, level: bool, pole: bool) -> None:
    values = {"v": np.random.default_rng(0).normal(size=200)}
    parts = {part for term in terms_of(["v"], values, {"v": unit}) for part in term.parts}
    assert ("pow(max(v - k1, 0), k2)" in parts, "pow(v - k1, k2)" in parts) == (level, pole)


@pytest.mark.parametrize(
    ("general", "special", "is_it"),
    [
        (("sign(v - k1, k2)",), ("sign(v, k1)",), True),
        (("max(v - k1, 0)",), ("max(v, 0)",), True),
        (("sin(k1 psi)", "cos(k1 psi)"), ("sin(2 psi)",), True),
        (("peak((a - b), k1)",), ("(a - b)",), True),
        (("abs(turn) (surge - sway)",), ("surge abs(turn)",), True),
        (("cos(2 theta) theta_dot v",), ("theta_dot v",), True),
        (("pow(v, k1)",), ("v^2",), True),
        (("pow(v, k1)",), ("abs(v) v",), True),
        (("pow(max(v - k1, 0), k2)",), ("max(v - k1, 0)",), True),
        (("pull(v - k1, k2)",), ("sign(v, k1)",), False),
        (("sign(v, k1)",), ("sign(v - k1, k2)",), False),
    ],
)
def test_a_law_that_is_another_at_one_value_of_its_shapes_contains_it(
    general: tuple[str, ...], special: tuple[str, ...], is_it: bool
) -> None:
    one, two = (Term("", parts, {"k1": 1.0} if "k1" in str(parts) else {}, 0) for parts in (general, special))
    assert one.contains(two) == is_it


def test_what_is_exchanged_with_a_stream_goes_by_a_difference_and_the_root_of_the_stream() -> None:
    rng = np.random.default_rng(0)
    values = {n: rng.uniform(1.0, 2.0, 200) for n in ("flow", "inner", "outer")}
    values["(inner - outer)"] = values["inner"] - values["outer"]
    parts = {part for term in terms_of(list(values), values, {}) for part in term.parts}
    assert {"root(flow) (inner - outer)", "flow (inner - outer)^2", "(inner - outer)^2"} <= parts
    assert not [part for part in parts if part.startswith("inner (inner")]


@pytest.mark.parametrize(
    ("system", "law", "c1", "words"),
    [
        ("mass_spring_damper", "force = c1 q^2", 1.0, "a spring that is not straight"),
        ("mass_spring_damper", "force = c1 expm1(k1 q)", -1.0, "rubber"),
        ("mass_spring_damper", "force = c1 window(q - k1, k2)", -0.4, "a force between two places"),
        ("mass_spring_damper", "force = c1 time q", 0.1, "a drift"),
        ("mass_spring_damper", "force = c1", 0.1, "always there"),
        ("mass_spring_damper", "force = c1 logged(load)", 0.1, None),
        ("mass_spring_damper", "force = c1 peak(q_dot, k1)", -1.0, "eddy currents"),
        ("mass_spring_damper", "force = c1 peak(q_dot, k1)", 1.0, None),
        ("mass_spring_damper", "force = c1 q force", 1.0, "a gain of the input"),
        ("mass_spring_damper", "force = c1 min(q, 0)", -1.0, "met below"),
        ("mass_spring_damper", "force = c1 max(q, 0)", 1.0, None),
        ("mass_spring_damper", "force = c1 q q_dot^2", 1.0, None),
        ("hexacopter", "body_moment[y] = c1 v_body_x w_z", 0.4, "a coupling of motions"),
        ("cartpole", "torque = c1 x_dot theta_dot", -0.15, "a coupling of motions"),
        ("hexacopter", "body_moment[y] = c1 collective^2", 0.4, None),
        ("cartpole", "torque = c1 x", 0.4, "a spring that is not straight"),
        ("cartpole", "force = c1 sign(x - k1, k2)", -0.4, "preload"),
        ("cartpole", "force = c1 sign(x - k1, k2)", 0.4, None),
    ],
)
def test_what_a_law_looks_like_is_said_where_something_can_be_said(
    system: str, law: str, c1: float, words: str | None
) -> None:
    found = looks_like(parse(law), {"c1": c1}, make_system(system))
    assert found is None if words is None else words in str(found)


@pytest.fixture(scope="module")
def runs() -> list[RawRun]:
    """A spring that is damped where it is stretched: -0.7 q q_dot above zero, by an integrator of its own."""
    rng, out = np.random.default_rng(5), []
    t = np.arange(0.0, 20.0, 0.01)

    def rates(x: Array, push: Array) -> list[float]:
        return [x[1], push[0] - 1.3 * x[0] - (0.6 + 0.7 * max(x[0], 0.0)) * x[1]]

    for number in range(4):
        waves = np.sin(np.outer(t, rng.uniform(0.2, 2.5, 6)) + rng.uniform(0, 6.28, 6))
        force, gusts = waves @ rng.uniform(0.2, 0.6, (6, 1)), 0.3 * rng.standard_normal((len(t), 1))
        start, push = [0.3 * rng.standard_normal(), 0.0], 1.1 * force + gusts
        run = simulated(number, rates, start, push, 0.01, noise=(0.001, 0.01), rng=rng, fine=2)
        out.append(replace(run, u=force))
    return out


@pytest.mark.slow
def test_a_law_is_sought_in_the_place_of_a_friction_that_is_none(runs: list[RawRun]) -> None:
    found = nsde_torch.diagnose(runs, system="mass_spring_damper").content()
    assert found["added"] == ["force = c1 max(q, 0) q_dot"]
    assert_interval(found["parameters"], "force = c1 max(q, 0) q_dot.c1", -0.7)


@pytest.mark.slow
def test_where_no_law_may_be_tried_it_is_provisional(runs: list[RawRun]) -> None:
    only = ("position_dependent_friction",)
    found = nsde_torch.diagnose(runs, system="mass_spring_damper", candidates=only).content()
    (finding,) = [f for f in found["findings"] if f["kind"] == "effect"]
    assert finding["name"] == "position_dependent_friction"
    assert finding["lead"]
    assert "another law" in finding["lead_reason"]


@pytest.mark.parametrize(
    ("law", "values", "name"),
    [
        ("force = c1 q^3", {"c1": -2.0}, "cubic_stiffness"),
        ("force = c1 sign(q_dot, k1)", {"c1": -0.2, "k1": 0.05}, "coulomb_friction"),
        ("force = c1 q q_dot", {"c1": 0.8}, None),
    ],
)
def test_a_law_that_is_a_multiple_of_an_effect_takes_its_name(
    law: str, values: dict[str, float], name: str | None
) -> None:
    data, system = recorded("mass_spring_damper", {law: values}), make_system("mass_spring_damper")
    steps = Search(system, data.runs, 1.0, Options()).steps
    found = same_effect(steps, joined(system, law, {**values}), law)
    assert (found and found[0]) == name


@pytest.mark.slow
def test_behind_a_smoother_no_law_is_tried() -> None:
    law = {"force = c1 q q_dot": {"c1": 0.8}}
    made = simulate("mass_spring_damper", effects=[law], durations=(8.0,) * 4, seed=1)
    b, a = butter(2, 0.16)
    runs = [replace(run, x=filtfilt(b, a, run.x, axis=0)) for run in made.runs]
    found = nsde_torch.diagnose(runs, system="mass_spring_damper")
    assert all(run.band for run in found.data.runs)
    assert not [name for name in found.content()["added"] if "=" in name]


def test_no_spring_is_sought_beside_a_spring_and_nothing_beside_what_contains_it() -> None:
    def sought(*effects: str) -> set[str]:
        return {*candidate_names(make_system("mass_spring_damper", effects=effects))}

    assert "linear_spring[cart]" in candidate_names(make_system("cartpole"))
    assert "linear_spring" not in sought()
    assert "coulomb_friction" in sought() - sought("asymmetric_friction") - sought("stribeck_friction")
    assert "asymmetric_friction" in sought("coulomb_friction")


@pytest.mark.parametrize(
    ("law", "said"),
    [
        ("torque[q1] = c1", "a zero that is off: what 0.3 N m more of tau1 would do"),
        ("torque[q1] = c1 q2", None),
    ],
)
def test_a_law_that_does_what_a_constant_in_an_input_does_says_so(law: str, said: str | None) -> None:
    plant = {"inputs": [0.1, 0.1], "noise": [0.01] * 4}
    data, system = recorded(HOME, durations=(4.0,), dt=0.01, plant=plant), make_system(HOME)
    steps = Search(system, data.runs, 1.0, Options()).steps
    assert zero_of_an_input(steps, system, system.make_effect(law, {"c1": 0.3})) == said
