"""A diagnosis rehearsed: what was found is simulated and found again, and all of it is told."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nsde_torch.design import diagnosis_rehearsal
from nsde_torch.design.diagnosis_rehearsal import Rehearsal, following, rehearse
from nsde_torch.design.members import Rollouts, open_loop
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.report import page
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.text import rehearsal_lines, sentences
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import diagnosed
from tests.helpers.encoders import encoder_runs


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    options = Options(candidates=("coulomb_friction", "quadratic_damping"))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options, dt=0.04)[0]


@pytest.fixture(scope="module")
def rehearsal(found: Diagnosis) -> Rehearsal:
    return rehearse(found, logs=2, seed=1)


@pytest.mark.slow
def test_progress_is_printed_unless_it_is_turned_off(
    found: Diagnosis, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*args: object) -> None:
        raise DataError("no log")

    monkeypatch.setattr(diagnosis_rehearsal, "_simulated", refused)
    capsys.readouterr()
    assert rehearse(found).why_not == "no log"
    assert "simulating what was found" in capsys.readouterr().err
    stages: list[str] = []
    rehearse(found, say=lambda stage, done, total: stages.append(stage))
    rehearse(found, say=False)
    assert capsys.readouterr() == ("", "")
    assert stages == ["simulating what was found"]


@pytest.mark.slow
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


@pytest.mark.slow
def test_it_is_told_in_the_terminal_and_on_the_page(found: Diagnosis, rehearsal: Rehearsal) -> None:
    content = {**found.content(), "rehearsal": rehearsal.content()}
    told = "\n".join(rehearsal_lines(content))
    assert "2 logs were simulated of what was found (inputs as logged) and diagnosed again." in told
    assert "coulomb_friction: found again, surely, in 2 of 2." in told
    assert "Of the declared physics alone nothing is named." in told
    assert "coulomb_friction.size" in told
    section = page(content, {}, width=0.25).partition("<h2>Rehearsed</h2>")[2].partition("<details>")[0]
    assert "<td>coulomb_friction.size</td>" in section
    assert rehearsal_lines({}) == []
    assert "Rehearsed" not in page(found.content(), {}, width=0.25)


@pytest.mark.slow
def test_what_is_named_wrongly_and_what_could_not_be_made_is_told(rehearsal: Rehearsal) -> None:
    none: dict[str, Any] = {"verdict": "no_effect", "findings": [], "added": [], "ties": []}
    none |= {"parameters": {}, "not_shown": []}
    wrong = {**none, "added": ["b"], "findings": [{"name": "b", "kind": "effect", "lead": False}]}
    tied = {**wrong, "ties": [{"effects": ["b", "a + c"]}]}
    own = Rehearsal({"a.size": 1.0}, ("a",), False, (none, tied), wrong).content()
    assert own["effects"] == {"a": {"sure": 0, "lead": 0, "tied": 1}}
    text = " ".join(sentences(own))
    assert "a: found again, surely, in 0 of 2, indistinguishable from another in 1." in text
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
    system, dt, moving = make_system("cartpole"), 0.02, np.array([[0.1, 0.2, 0.1, 0.5]])
    states = [np.zeros((300, 4)), np.concatenate((moving, -moving))]  # the second says what matters
    inputs = [np.zeros((300, 1)), np.array([[1.0], [-1.0]])]
    rollouts = Rollouts(system, dt=dt)
    theta, start = np.tile(rollouts.vector.start, (2, 1)), np.array([[0.0, 0.0, 0.05, 0.0], [0.0] * 4])
    ways = following(system, states, inputs, dt=dt, copies=1), open_loop(np.zeros((2, 299, 1)))
    follow, replay = (abs(rollouts.run(theta, start, drive, 299)[0][0, -1, 2]) for drive in ways)
    assert follow < 0.01
    assert replay > 0.5


@pytest.mark.slow
def test_positions_alone_are_simulated_without_a_rate() -> None:
    system = make_system("mass_spring_damper")
    options = Options(candidates=("coulomb_friction", "quadratic_damping"))
    data = assemble(encoder_runs("none", runs=3, seconds=6.0), system, kind="test")
    spec = SysidSpec("mass_spring_damper", dt=data.dt, horizon=10)
    found = diagnose(system, spec, data, data.runs, options)
    own = rehearse(found, logs=1)
    assert own.why_not == ""
    assert own.content()["effects"] == {"coulomb_friction": {"sure": 1, "lead": 0, "tied": 0}}
    assert own.again[0]["data"]["system"] == "mass_spring_damper"


def test_no_log_is_no_rehearsal(found: Diagnosis) -> None:
    with pytest.raises(ConfigError, match="`logs` must be at least 1; got 0"):
        rehearse(found, logs=0)
