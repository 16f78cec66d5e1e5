"""Laws that no catalogue has: found, verified and written, or unexplained; silence where there are none."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.diagnosis.decisions import Budgets, Decisions, Options
from nsde_torch.diagnosis.laws import Term, terms_of
from nsde_torch.diagnosis.result import looks_like
from nsde_torch.effects.expression_grammar import parse
from nsde_torch.sysid.feedback_test import FeedbackTest
from nsde_torch.systems import make_system
from nsde_torch.systems.options import system_options
from tests.helpers.diagnosed import assert_interval, diagnosed
from tests.helpers.two_joints import TwoJoints

OUTSIDE = Path(__file__).parents[2] / "benchmarks" / "blind"
LAW = "force = c1 q q_dot"
HALF = "force = c1 max(q_dot, 0)^2"
SHORT: dict[str, Any] = {"durations": (8.0,) * 4, "dt": 0.02}


def test_a_friction_that_goes_with_the_place_is_a_law_and_a_wide_one_no_doubt_of_a_product() -> None:
    rng = np.random.default_rng(0)
    values = {"q": rng.normal(size=500), "v": rng.normal(size=500)}
    parts = {term.parts for term in terms_of(["q", "v"], values, ["q"], ["v"])}
    dry = "sign(v, k1)"
    assert {(f"q^2 {dry}",), (f"cos(2 q) {dry}",), (dry, f"cos(2 q) {dry}")} <= parts
    assert not any("sign(q" in part and "v" in part.replace(dry, "") for term in parts for part in term)
    wide, product, other = (
        Term(text, (text,), {"k1": 1.0} if "k1" in text else {}, 0) for text in (f"q^2 {dry}", "q^2 v", "q v")
    )
    assert wide.contains(product)
    assert not product.contains(wide)
    assert not wide.contains(other)


def finding(content: dict[str, Any], name: str) -> dict[str, Any]:
    return next(f for f in content["findings"] if f["name"] == name)


def held(content: dict[str, Any], label: str, value: float, slack: float = 0.0) -> bool:
    low, high = content["parameters"][label]["interval_90"]
    wider = slack * (high - low)
    return bool(low - wider <= value <= high + wider)


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
    assert held(content, f"{LAW}.c1", 0.8, slack=0.5)
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
def test_a_law_that_explains_a_part_of_what_functions_do_is_not_named() -> None:
    most = Decisions(law_share=5.0)  # no law explains five times what functions do
    _, content = diagnosed("mass_spring_damper", {HALF: {"c1": -6.0}}, decisions=most, **SHORT)
    assert (content["verdict"], content["added"]) == ("unexplained", [])
    _, content = diagnosed("mass_spring_damper", {HALF: {"c1": -6.0}}, **SHORT)
    assert content["added"] == [HALF]


@pytest.mark.slow
def test_a_law_that_leaves_what_inputs_predict_as_it_was_is_not_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # the same data as above, where it is named
    monkeypatch.setattr(FeedbackTest, "predicted", property(lambda test: 0.2))
    _, content = diagnosed("mass_spring_damper", {HALF: {"c1": -6.0}}, options=Options(seed=1), **SHORT)
    assert (content["verdict"], content["added"]) == ("unexplained", [])


@pytest.mark.slow
def test_a_hinge_is_found_with_its_place() -> None:
    stop = "force = c1 max(q - k1, 0)"
    _, content = diagnosed("mass_spring_damper", {stop: {"c1": -6.0, "k1": 0.2}}, **SHORT)
    assert (content["verdict"], content["added"]) == ("effect_found", [stop])
    assert content["parameters"][f"{stop}.k1"]["value"] == pytest.approx(0.2, abs=0.02)
    assert content["parameters"][f"{stop}.c1"]["value"] == pytest.approx(-6.0, rel=0.1)
    assert "a stop or a spring" in finding(content, stop)["looks_like"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "law", "size"),
    [
        # the noise model has learned the first two, and no test of one variable shows them: functions say what to try
        ("mass_spring_damper", "force = c1 q q_dot^2", -10.0),
        ("mass_spring_damper", "force = c1 q^2 q_dot", -10.0),
        ("mass_spring_damper", "force = c1 q_dot^3", -0.6),  # told as a quadratic damping and a friction
        ("mass_spring_damper", "force = c1 q_dot^3", -0.2),  # a quadratic damping leaves no structure of it
        ("cartpole", "torque = c1 x_dot theta_dot", -0.15),
    ],
)
def test_a_law_is_named_with_its_size_and_what_imitates_it_gives_way(
    system: str, law: str, size: float
) -> None:
    making = SHORT if system == "mass_spring_damper" else {"durations": (4.0,) * 6}
    _, content = diagnosed(system, {law: {"c1": size}}, **making)
    assert (content["verdict"], content["added"]) == ("effect_found", [law])
    assert not finding(content, law)["lead"]
    assert held(content, f"{law}.c1", size, slack=0.5)


@pytest.mark.slow
def test_two_effects_of_one_speed_that_are_there_stay() -> None:
    both = ({"coulomb_friction": {"size": 0.15}}, {"quadratic_damping": {"damping": 0.4}})
    _, content = diagnosed("mass_spring_damper", *both, durations=(8.0,) * 4)
    assert sorted(content["added"]) == ["coulomb_friction", "quadratic_damping"]


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


@pytest.mark.skipif(not OUTSIDE.is_dir(), reason="the benchmarks are not part of a wheel")
@pytest.mark.slow
def test_what_one_run_alone_has_is_no_law(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(OUTSIDE)
    burst = {"outside:Burst": {"size": 1.0, "moment": 4.0, "width": 0.3}}
    _, content = diagnosed("mass_spring_damper", burst, **SHORT)
    assert not [name for name in content["added"] if "=" in name]


def test_what_has_one_sign_has_no_size_and_no_side() -> None:
    rng = np.random.default_rng(0)
    values = {"u": 1.0 + rng.normal(size=2000).clip(-3.0) / 2.9, "v": rng.normal(size=2000)}
    parts = [part for term in terms_of(["u", "v"], values, []) for part in term.parts]
    assert "u v" in parts
    assert "u abs(v)" in parts
    assert "abs(v) v" in parts
    assert not [part for part in parts if "abs(u)" in part or "max(u, 0)" in part or "min(u, 0)" in part]


def test_every_term_of_the_library_is_of_the_grammar_and_has_one_spelling() -> None:
    rng = np.random.default_rng(0)
    names = ["theta", "theta_dot", "x_dot"]
    terms = terms_of(names, {n: rng.normal(size=200) for n in names}, ["theta"])
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
    } <= set(texts)


@pytest.mark.parametrize(
    ("system", "law", "c1", "words"),
    [
        ("mass_spring_damper", "force = c1 q^2", 1.0, "a spring that is not straight"),
        ("mass_spring_damper", "force = c1 expm1(k1 q)", -1.0, "rubber"),
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
    ],
)
def test_what_a_law_looks_like_is_said_where_something_can_be_said(
    system: str, law: str, c1: float, words: str | None
) -> None:
    found = looks_like(parse(law), {"c1": c1}, make_system(system))
    assert found is None if words is None else words in str(found)


FOLDER = Path(__file__).parents[2] / "benchmarks" / "blind"
needs_outside = pytest.mark.skipif(not FOLDER.is_dir(), reason="the benchmarks are not part of a wheel")


@pytest.fixture
def _outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(FOLDER)


@needs_outside
@pytest.mark.usefixtures("_outside")
@pytest.mark.slow
def test_a_magnet_on_the_pole_is_a_ripple_of_the_catalogue_and_unexplained_without_it() -> None:
    magnet = {"outside:PoleMagnet": {"size": 1.5}}
    _, content = diagnosed("cartpole", magnet, durations=(4.0,) * 16)
    assert content["added"] == ["ripple[pole]"]
    found = content["parameters"]
    assert found["ripple[pole].order"]["value"] == pytest.approx(2.0, abs=0.02)
    assert_interval(found, "ripple[pole].sine", -1.5)
    few = Options(candidates=("coulomb_friction[pole]", "quadratic_damping[pole]"))
    _, content = diagnosed("cartpole", magnet, options=few, durations=(4.0,) * 16)
    assert content["verdict"] == "unexplained"
    assert "no effect of the catalogue" in content["summary"]
    first = next(s for s in content["unexplained"] if s["variable"] == "theta")
    assert first["channel"] == "theta_dot"
    assert first["period"] == pytest.approx(np.pi, rel=0.1)
    assert "periodically" in first["sentence"]


@needs_outside
@pytest.mark.usefixtures("_outside")
@pytest.mark.slow
def test_a_spring_that_hardens_faster_than_the_catalogue_knows_is_a_law_with_its_power() -> None:
    case = ("mass_spring_damper", {"outside:QuinticStiffness": {"size": 8.0}})
    _, content = diagnosed(*case, durations=(10.0,) * 6)
    law = "force = c1 q^5"
    assert (content["verdict"], content["added"]) == ("effect_found", [law])
    assert content["parameters"][f"{law}.c1"]["value"] == pytest.approx(-8.0, rel=0.15)
    _, content = diagnosed(*case, durations=(10.0,) * 6, budgets=Budgets(laws=0))
    assert content["verdict"] == "unexplained" or all(f["lead"] for f in content["findings"])
    assert content["added"] in ([], ["cubic_stiffness"])
    first = content["unexplained"][0]
    assert (first["channel"], first["variable"], first["symmetry"]) == ("q_dot", "q", "odd")


@pytest.fixture(scope="module")
def runs() -> list[RawRun]:
    """A spring that is damped where it is stretched: -0.7 q q_dot above zero, by an integrator of its own."""
    rng, out = np.random.default_rng(5), []
    t = np.arange(0.0, 20.0, 0.01)
    for number in range(4):
        waves = np.sin(np.outer(t, rng.uniform(0.2, 2.5, 6)) + rng.uniform(0, 6.28, 6))
        force, gusts = waves @ rng.uniform(0.2, 0.6, 6), 0.3 * rng.standard_normal(len(t))
        x = [np.array([0.3 * rng.standard_normal(), 0.0])]
        for u, w in zip(force[:-1], gusts[:-1], strict=True):

            def rate(_: float, y: np.ndarray, push: float = 1.1 * u + w) -> list[float]:
                return [y[1], push - 1.3 * y[0] - (0.6 + 0.7 * max(y[0], 0.0)) * y[1]]

            x.append(solve_ivp(rate, (0.0, 0.01), x[-1], rtol=1e-6, atol=1e-9).y[:, -1])
        seen = np.array(x) + rng.standard_normal((len(t), 2)) * [0.001, 0.01]
        out.append(RawRun(f"run_{number}", t, seen, force[:, None]))
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


def test_a_coupling_of_two_speeds_and_an_angle_is_found() -> None:
    runs = []
    for seed in range(3):
        rng, n, dt = np.random.default_rng(seed), 750, 0.02
        aim = np.repeat(rng.uniform(-1.5, 1.5, (n // 25, 2)), 25, axis=0)
        x, u, z = np.zeros((n, 4)), np.zeros((n, 2)), np.zeros(4)
        for k in range(n):
            x[k] = z + rng.normal(size=4) * [0.02, 0.02, 0.001, 0.001]
            u[k] = 2.0 * (aim[k] - x[k, [3, 2]]) - 0.6 * x[k, [1, 0]]

            def rate(z: Any, tau: Any = u[k]) -> Any:
                w2, w1, q2, _ = z
                return np.array([tau[1] / 0.2, (tau[0] + 0.3 * np.sin(q2) * w1 * w2) / 0.5, w2, w1])

            z = solve_ivp(lambda _, z, f=rate: f(z), (0.0, dt), z, rtol=1e-7, atol=1e-9).y[:, -1]
        runs.append(RawRun(f"run_{seed}", dt * np.arange(n), x, u))
    found = nsde_torch.diagnose(runs, system=TwoJoints, say=False)
    law = "torque[q1] = c1 sin(q2) w2 w1"
    assert found.added == [law]
    assert_interval(found.parameters, f"{law}.c1", 0.3, slack=0.005, width=0.1)
