"""A plan for the spring's tie, from the question to the files; and what is refused."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import DesignOptions, Experiment, Question, design, obtained, question_of
from nsde_torch.design.designing import CONFIRMED
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation.planned import read_plan
from tests.helpers.ties import BIASED, DT, SIDED, TRUE, Tie

pytestmark = pytest.mark.drawn

SMALL: dict[str, Any] = {"duration": 3.0, "samples": 2, "proposals": 8, "generations": 1, "rehearsals": 2}
OPTIONS = DesignOptions(members=(BIASED, SIDED), hertz=(0.3, 4.0), **SMALL)


@pytest.fixture(scope="module")
def planned(tie: Tie) -> Experiment:
    return design(tie.system, tie.runs, tie.question, OPTIONS, baselines=False)


def test_the_plan_breaks_the_tie_within_the_limits(planned: Experiment, tie: Tie, tmp_path: Path) -> None:
    table = planned.plan.table
    u = np.concatenate([run.u for run in tie.runs])
    assert table.shape == (60, 1)
    assert u.min() - 1e-9 <= table.min() <= table.max() <= u.max() + 1e-9
    assert max(r.use.max() for r in planned.plan.rehearsed) <= 1.0
    assert min(planned.plan.nats(i)["mean"] for i in range(2)) > 3.0
    # what it was chosen by was lucky: others say what is expected
    assert [len(r.evidence) for r in planned.plan.rehearsed] == [CONFIRMED * OPTIONS.rehearsals] * 2
    folder = planned.save(tmp_path / "plan")
    content = json.loads((folder / "design.json").read_text(encoding="utf-8"))
    assert content["question"]["members"] == [list(BIASED), list(SIDED)]
    assert content["expected"][0]["nats"] == pytest.approx(planned.plan.nats(0))
    assert content["limits"]["q"]["unit"] == "m"
    t, read = read_plan(folder, ("force",))
    np.testing.assert_allclose(read[:-1], table, rtol=1e-8)
    assert t[-1] == pytest.approx(3.0)
    assert (folder / "design.png").stat().st_size > 10_000


@pytest.mark.slow
def test_flown_on_the_plant_it_speaks_for_what_is_true(planned: Experiment, tie: Tie, tmp_path: Path) -> None:
    folder = planned.save(tmp_path / "plan")
    made = nsde_torch.simulate("mass_spring_damper", effects=TRUE, seed=9, dt=DT, plan=folder)
    (raw,) = made.runs
    np.testing.assert_allclose(raw.u[:-1], planned.plan.table, rtol=1e-8)
    assert np.abs(raw.x[0] - planned.start).max() < 0.05
    run = Run("flown", raw.t, raw.x, raw.u)
    found = obtained(tie.system, tie.runs, [run], tie.question, expected=planned.content()["expected"])
    assert found.broken
    assert found.question.names[found.best] == "coulomb_friction + constant_force"
    assert "were expected" in found.report
    assert found.surprise is None
    # in one of a hundred flights it is far less: said, and what may be the reason
    low = found.expected_nats["low_99"]
    nats = [min(low, 3.0) - 1.0 if i == found.best else -1e3 for i in range(2)]
    less = replace(found, nats=tuple(nats))
    assert "far less than what was expected" in less.report
    assert less.content()["surprise"] == less.surprise
    other = Run("other", raw.t, 3.0 * raw.x + 0.2, raw.u, source="other.csv")
    with pytest.raises(DataError, match=r"explains other\.csv.*not of this machine"):
        obtained(tie.system, tie.runs, [other], tie.question)
    doubted = obtained(tie.system, tie.runs, [other], tie.question, trusted=True).content()
    assert "no member explains other.csv" in doubted["doubt"]


def test_where_evidence_lies_holds_one_more_rehearsal_as_often_as_it_says(planned: Experiment) -> None:
    rng = np.random.default_rng(0)
    held = np.zeros(2)
    for _ in range(2000):
        *first, last = rng.normal(50.0, 20.0, 17)
        rehearsed = replace(planned.plan.rehearsed[0], evidence=np.array(first))
        nats = replace(planned.plan, rehearsed=(rehearsed,)).nats(0)
        held += [nats[f"low_{level}"] <= last <= nats[f"high_{level}"] for level in (90, 99)]
    assert held / 2000 == pytest.approx([0.90, 0.99], abs=0.02)


def test_a_plan_that_leaves_its_limits_whatever_it_does_says_which(tie: Tie) -> None:
    with pytest.raises(ConfigError, match=r"what limits it is limits\.q=\[0\.1,0\.2\]"):
        design(tie.system, tie.runs, tie.question, replace(OPTIONS, generations=0, limits={"q": [0.1, 0.2]}))


def test_members_that_are_one_equation_are_refused_and_not_planned_for(tie: Tie) -> None:
    same = Question((BIASED, BIASED[::-1]))
    with pytest.raises(ConfigError, match=r"no experiment tells .* one equation in this physics"):
        design(tie.system, tie.runs, same, replace(OPTIONS, generations=0), baselines=False)


def test_limits_within_which_nothing_tells_are_named(tie: Tie) -> None:
    apart = Question((("quadratic_damping",), ("cubic_stiffness",)))
    still = {"force": [-0.1, 0.1], "q": [-0.15, 0.15], "q_dot": [-0.15, 0.15]}
    small = replace(OPTIONS, generations=0, limits=still, start={"q": 0.0})
    with pytest.raises(ConfigError, match=r"In ranges 10 times as wide .* widen limits\.q"):
        design(tie.system, tie.runs, apart, small, baselines=False)


@pytest.mark.parametrize(
    ("limits", "message"),
    [({"speed": [0, 1]}, "names 'speed'"), ({"q": [1, 0]}, "must be"), ({"q": 3}, "must be")],
)
def test_limits_of_nothing_are_refused(tie: Tie, limits: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        design(tie.system, tie.runs, tie.question, replace(OPTIONS, limits=limits))


@pytest.mark.slow
def test_parameters_of_an_effect_that_is_not_there_are_planned_for(tie: Tie, tmp_path: Path) -> None:
    asked = DesignOptions(parameters=("quadratic_damping.damping",), **SMALL)
    question = question_of({}, tie.system, asked)
    assert question.members == (("quadratic_damping",),)
    made = design(tie.system, tie.runs, question, asked, baselines=False)
    (expected,) = made.content()["expected"]
    one = expected["parameters"]["quadratic_damping.damping"]
    assert one["expected_standard_error"] < one["standard_error"]
    assert "quadratic_damping.damping [1/m]" in made.report
    # flown, it tells of the parameter what was expected
    plan = made.save(tmp_path / "plan")
    again = nsde_torch.simulate("mass_spring_damper", effects=TRUE, seed=9, dt=DT, plan=plan)
    flown = [Run("flown", r.t, r.x, r.u) for r in again.runs]
    told = obtained(tie.system, tie.runs, flown, question, expected=[expected], trusted=True)
    better = told.parameters["quadratic_damping.damping"]
    assert better.before == pytest.approx(one["standard_error"])
    assert 0.5 < better.after / one["expected_standard_error"] < 2.0
    content = told.content()
    assert content["nats"] == pytest.approx(np.log(better.before / better.after))
    assert content["expected_nats"] > 0
    assert "expected" in told.report


def test_the_question_is_the_first_tie_of_effects(tie: Tie) -> None:
    def asked(found: list[str], *ties: list[str], **more: Any) -> Question:
        findings = [{"name": name, "kind": "effect"} for name in found]
        told = [{"effects": names, "experiment": ""} for names in ties]
        return question_of({"findings": findings, "ties": told, **more}, tie.system, DesignOptions())

    ties = ["constant_force", "sensor_bias"], ["coulomb_friction", "stribeck_friction"]
    question = asked(["coulomb_friction", "constant_force"], *ties)
    assert question.members == (BIASED, ("stribeck_friction", "constant_force"))
    assert question.names == ("coulomb_friction", "stribeck_friction")
    assert "sensor_bias is a fault of the recording chain" in question.notes[0]
    pair = ["asymmetric_friction", "coulomb_friction + constant_force"]
    assert asked(["asymmetric_friction"], pair).members == (SIDED, BIASED)
    law = "force = c1 q_dot^3"
    assert asked(["quadratic_damping"], ["quadratic_damping", law]).members == (
        ("quadratic_damping",),
        (law,),
    )
    question = asked([], not_shown=[{"parameter": "hysteresis.size"}])
    assert (question.members, question.parameters) == ((("hysteresis",),), ("hysteresis.size",))
    assert "holds no tie that an input may break" in question.notes[0]
    with pytest.raises(ConfigError, match="nothing to plan"):
        asked([], not_shown=[])


@pytest.mark.parametrize(
    "wrong",
    [
        {"members": (("a",),)},
        {"members": (BIASED, BIASED)},
        {"members": (BIASED, SIDED), "parameters": ("a.b",)},
    ],
)
def test_questions_that_are_none_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        DesignOptions(**wrong)  # type: ignore[arg-type]


def test_an_effect_that_no_one_knows_is_refused(tie: Tie) -> None:
    with pytest.raises(ConfigError, match="no effect that 'mass_spring_damper' can have"):
        question_of({}, tie.system, DesignOptions(members=(("frictoin",), SIDED)))


def test_a_plan_without_its_column_is_refused(tmp_path: Path) -> None:
    (tmp_path / "plan.csv").write_text("t,torque\n0,1\n1,1\n", encoding="utf-8")
    with pytest.raises(DataError, match="no column force"):
        nsde_torch.simulate("mass_spring_damper", seed=0, plan=tmp_path / "plan.csv")
    with pytest.raises(DataError, match="no column p_x"):
        nsde_torch.simulate("hexacopter", seed=0, plan=tmp_path / "plan.csv")
