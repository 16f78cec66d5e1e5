"""A plan for the spring's tie, from the question to the files; and what is refused."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import (
    DesignOptions,
    Experiment,
    Question,
    design,
    obtained,
    open_questions,
    question_of,
    standing_of,
)
from nsde_torch.design.designing import CONFIRMED
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation.planned import read_plan
from nsde_torch.systems.options import system_options
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


def test_where_evidence_lies_holds_one_more_rehearsal_as_often_as_it_says(planned: Experiment) -> None:
    rng = np.random.default_rng(0)
    held = np.zeros(2)
    for _ in range(2000):
        *first, last = rng.normal(50.0, 20.0, 17)
        rehearsed = replace(planned.plan.rehearsed[0], evidence=np.array(first))
        nats = replace(planned.plan, rehearsed=(rehearsed,)).nats(0)
        held += [nats[f"low_{level}"] <= last <= nats[f"high_{level}"] for level in (90, 99)]
    assert held / 2000 == pytest.approx([0.90, 0.99], abs=0.02)


STILL = {"force": [-0.1, 0.1], "q": [-0.15, 0.15], "q_dot": [-0.15, 0.15]}


@pytest.mark.parametrize(
    ("members", "changed", "message"),
    [
        (
            (("quadratic_damping",), ("cubic_stiffness",)),
            {"limits": STILL, "start": {"q": 0.0}},
            r"In ranges 10 times as wide .* widen limits\.q",
        ),
        ((BIASED, SIDED), {"limits": {"q": [0.1, 0.2]}}, r"what limits it is limits\.q=\[0\.1,0\.2\]"),
        ((BIASED, BIASED[::-1]), {}, r"no experiment tells .* one equation in this physics"),
        ((BIASED, SIDED), {"limits": {"speed": [0, 1]}}, "names 'speed'"),
        ((BIASED, SIDED), {"limits": {"q": [1, 0]}}, "must be"),
        ((BIASED, SIDED), {"limits": {"q": 3}}, "must be"),
    ],
)
def test_what_cannot_be_planned_is_refused_with_its_cause(
    tie: Tie, members: tuple[tuple[str, ...], ...], changed: dict[str, Any], message: str
) -> None:
    options = replace(OPTIONS, generations=0, **changed)
    with pytest.raises(ConfigError, match=message):
        design(tie.system, tie.runs, Question(members), options, baselines=False)


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
    of_law = asked(["quadratic_damping"], ["quadratic_damping", law])
    assert of_law.members == (("quadratic_damping",), (law,))
    question = asked([], not_shown=[{"parameter": "hysteresis.size"}])
    assert (question.members, question.parameters) == ((("hysteresis",),), ("hysteresis.size",))
    assert "holds no tie that an input may break" in question.notes[0]
    with pytest.raises(ConfigError, match="nothing to plan"):
        asked([], not_shown=[])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"members": (("a",),)}, "two or more different lists"),
        ({"members": (BIASED, BIASED)}, "two or more different lists"),
        ({"members": (BIASED, SIDED), "parameters": ("a.b",)}, "are two questions"),
        ({"members": (("frictoin",), SIDED)}, "no effect that 'mass_spring_damper' can have"),
    ],
)
def test_questions_that_are_none_are_refused(tie: Tie, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        question_of({}, tie.system, DesignOptions(**wrong))


def test_a_plan_without_its_column_is_refused(tmp_path: Path) -> None:
    (tmp_path / "plan.csv").write_text("t,torque\n0,1\n1,1\n", encoding="utf-8")
    with pytest.raises(DataError, match="no column force"):
        nsde_torch.simulate("mass_spring_damper", seed=0, plan=tmp_path / "plan.csv")
    with pytest.raises(DataError, match="no column p_x"):
        nsde_torch.simulate("hexacopter", seed=0, plan=tmp_path / "plan.csv")


HEXA = system_options("hexacopter").make()


def _value(value: float, half: float) -> dict[str, Any]:
    return {"value": value, "interval_90": [value - half, value + half], "unit": "1"}


def _content(**changed: Any) -> dict[str, Any]:
    findings = [{"name": "linear_drag", "kind": "effect", "lead": False}]
    return {"findings": findings, "ties": [], "not_shown": [], "ranking": [], "parameters": {}, **changed}


def test_nothing_is_open_where_what_was_found_is_sure_and_untied() -> None:
    parameters = {"linear_drag.drag[0]": _value(0.6, 0.02), "linear_drag.drag[2]": _value(0.02, 0.03)}
    content = _content(parameters=parameters)
    assert standing_of(content).settled
    assert open_questions(content, HEXA) == []
    # a small component of a vector is known as well as the large one needs it; a small vector is not
    parameters = {"linear_drag.drag[2]": _value(0.02, 0.03)}
    assert standing_of(_content(parameters=parameters)).wide == ("linear_drag.drag[2]",)


def test_what_feedback_may_hide_is_told_and_not_asked() -> None:
    of_chance, of_feedback = _value(0.6, 0.5), {**_value(0.6, 0.5), "widened_by": 0.4}
    now = standing_of(_content(parameters={"linear_drag.drag[0]": of_feedback}))
    assert now.settled
    assert now.confounded == ("linear_drag.drag[0]",)
    assert "wide by what feedback may hide: linear_drag.drag[0]" in now.words
    # chance alone is more than half of the value still
    both = {**_value(0.6, 0.5), "widened_by": 0.1}
    for asked in (of_chance, both):
        now = standing_of(_content(parameters={"linear_drag.drag[0]": asked}))
        assert (now.wide, now.confounded) == (("linear_drag.drag[0]",), ())
    # an end at the bound of the search is no nearer for what widens the other one
    clipped = {"value": 0.02, "interval_90": [0.0, 0.12], "widened_by": 0.05, "unit": "1"}
    assert standing_of(_content(parameters={"linear_drag.drag[2]": clipped})).wide == ("linear_drag.drag[2]",)


def test_a_tie_is_asked_before_what_is_wide_and_that_before_what_is_suspected() -> None:
    content = _content(
        ties=[{"effects": ["linear_drag", "quadratic_drag"]}],
        parameters={"linear_drag.drag[0]": _value(0.6, 0.5)},
        not_shown=[{"effect": "thrust_curve", "parameter": "thrust_curve.curvature"}],
        ranking=[
            {"round": 0, "effect": "com_offset", "evidence_nats": 50.0, "chosen": False},
            {"round": 1, "effect": "thrust_curve", "evidence_nats": 4.0, "chosen": False},
            {"round": 1, "effect": "flapping_moment", "evidence_nats": 9.0, "chosen": False},
        ],
    )
    tie, wide, suspected = open_questions(content, HEXA)
    assert tie.members == (("linear_drag",), ("quadratic_drag",))
    assert wide.parameters == ("linear_drag.drag[0]",)
    # of flapping the runs have said what they say: it would have shown at its usual size
    assert standing_of(content).suspected == ("thrust_curve",)
    assert suspected.parameters == ("thrust_curve.curvature",)
    assert suspected.members == (("linear_drag", "thrust_curve"),)
    content = _content(ties=[{"effects": ["linear_drag", "sensor_bias"]}])
    now = standing_of(content)
    assert now.settled, "a fault of the recording is no question"
    assert "indistinguishable whatever the input: linear_drag or sensor_bias" in now.words
    content = _content(parameters={"linear_drag.drag[0]": _value(0.6, 0.1)})
    content["findings"][0]["lead"] = True
    (lead,) = open_questions(content, HEXA)
    assert lead.parameters == ("linear_drag.drag[0]",)
