"""A diagnosis rehearsed: what was found is simulated and found again, and all of it is told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nsde_torch.design.diagnosis_rehearsal import Rehearsal, rehearse
from nsde_torch.design.following import following, replayed
from nsde_torch.design.rollout import Rollouts
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.rehearsal_text import rehearsal_html, rehearsal_lines, sentences
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import diagnosed

UP = 0.0  # angle of a pole that stands


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    options = Options(candidates=("coulomb_friction", "quadratic_damping"))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options)[0]


@pytest.fixture(scope="module")
def rehearsal(found: Diagnosis) -> Rehearsal:
    return rehearse(found, logs=2, seed=1)


def test_what_was_found_is_found_again_with_values_and_nothing_of_nothing(
    found: Diagnosis, rehearsal: Rehearsal
) -> None:
    own = rehearsal.content()
    assert (own["why_not"], own["logs"], own["inputs"], own["others"]) == (None, 2, "as logged", [])
    assert own["effects"] == {"coulomb_friction": {"sure": 2, "lead": 0, "tied": 0}}
    assert own["of_nothing"] == []
    size = own["parameters"]["coulomb_friction.size"]
    assert size["value"] == pytest.approx(found.parameters["coulomb_friction.size"]["value"], rel=1e-6)
    np.testing.assert_allclose(size["again"], size["value"], rtol=0.15)
    assert len(set(size["again"])) == 2  # noise of its own in each
    assert (size["intervals"], size["unit"]) == (2, "m/s2")


def test_it_is_told_in_the_terminal_and_on_the_page(rehearsal: Rehearsal) -> None:
    content = {"rehearsal": rehearsal.content()}
    told = "\n".join(rehearsal_lines(content))
    assert "2 logs were simulated of what was found (inputs as logged) and diagnosed again." in told
    assert "coulomb_friction: found again, surely, in 2 of 2." in told
    assert "Of the declared physics alone, simulated once, nothing is named." in told
    assert "coulomb_friction.size" in told
    page = rehearsal_html(content, lambda head, rows: f"<table>{next(iter(rows))[0]}</table>")
    assert page.startswith("<h2>Rehearsed</h2>")
    assert "<table>coulomb_friction.size</table>" in page
    assert rehearsal_lines({}) == []
    assert rehearsal_html({}, lambda head, rows: "") == ""


def test_what_is_named_wrongly_and_what_could_not_be_made_is_told(rehearsal: Rehearsal) -> None:
    none: dict[str, Any] = {"findings": [], "added": [], "ties": [], "parameters": {}, "not_shown": []}
    wrong = {**none, "added": ["b"], "findings": [{"name": "b", "kind": "effect", "lead": False}]}
    tied = {**wrong, "ties": [{"effects": ["b", "a + c"]}]}
    own = Rehearsal({"a.size": 1.0}, ("a",), False, (none, tied), wrong).content()
    assert own["effects"] == {"a": {"sure": 0, "lead": 0, "tied": 1}}
    text = " ".join(sentences(own))
    assert "a: found again, surely, in 0 of 2, tied with another in 1." in text
    assert "Named there, surely, and not simulated: b." in text
    assert "these data would name b: be careful with that name" in text
    failed = replace(rehearsal, again=(), nothing=None, why_not="it leaves")
    assert sentences(failed.content()) == ["rehearsed: not possible: it leaves."]


def test_where_a_fit_is_not_to_be_simulated_it_says_so(
    found: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nsde_torch.design.diagnosis_rehearsal._stays", lambda seen, states, logs: False)
    own = rehearse(found, logs=1)
    assert own.again == ()
    assert "leaves the range of the log" in own.why_not


def test_inputs_that_follow_keep_a_pole_up_which_replayed_ones_lose() -> None:
    system, dt = make_system("cartpole"), 0.02
    rest = np.zeros((300, 4))
    states = [
        rest,
        np.array([[0.1, 0.2, 0.1, 0.5], [-0.1, -0.2, -0.1, -0.5]]),
    ]  # the second says what matters
    inputs = [np.zeros((300, 1)), np.array([[1.0], [-1.0]])]
    rollouts = Rollouts(system, dt=dt)
    theta, start = (
        np.tile(rollouts.vector.start, (2, 1)),
        np.array([[0.0, 0.0, UP + 0.05, 0.0], [0.0, 0.0, UP, 0.0]]),
    )
    states = [x + np.array([0.0, 0.0, UP, 0.0]) for x in states]
    ways = {
        "follow": following(system, states, inputs, dt=dt, copies=1),
        "replay": replayed(inputs, 1),
    }
    left = {name: rollouts.run(theta, start, drive, 299)[0][0, -1, 2] - UP for name, drive in ways.items()}
    assert abs(left["follow"]) < 0.01
    assert abs(left["replay"]) > 0.5
