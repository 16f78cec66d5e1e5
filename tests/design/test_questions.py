"""What a diagnosis leaves open, and what the next experiment is asked."""

from typing import Any

from nsde_torch.design import open_questions, standing_of
from nsde_torch.systems.options import system_options

HEXA = system_options("hexacopter").make()


def _value(value: float, half: float | None) -> dict[str, Any]:
    interval = None if half is None else [value - half, value + half]
    return {"value": value, "interval_90": interval, "unit": "1"}


def _content(**changed: Any) -> dict[str, Any]:
    names = changed.pop("found", ["linear_drag"])
    findings = [{"name": n, "kind": "effect", "lead": False} for n in names]
    none = {"ties": [], "not_shown": [], "ranking": [], "parameters": {}}
    return {"findings": findings, **none, **changed}


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


def test_a_tie_with_a_fault_of_the_recording_is_no_question() -> None:
    content = _content(ties=[{"effects": ["linear_drag", "sensor_bias"]}])
    now = standing_of(content)
    assert now.settled
    assert now.beyond == (("linear_drag", "sensor_bias"),)
    assert "indistinguishable whatever the input: linear_drag or sensor_bias" in now.words


def test_a_lead_is_asked_with_all_its_parameters() -> None:
    content = _content(parameters={"linear_drag.drag[0]": _value(0.6, 0.1)})
    content["findings"][0]["lead"] = True
    (asked,) = open_questions(content, HEXA)
    assert asked.parameters == ("linear_drag.drag[0]",)
