"""What functions could still explain: nothing where nothing is missing, else a share beside what the effects do."""

from dataclasses import replace
from html import unescape
from itertools import takewhile
from pathlib import Path

import pytest

from nsde_torch.diagnosis.decisions import BUDGETS, Options
from nsde_torch.diagnosis.report import page, pictures
from nsde_torch.diagnosis.result import content
from nsde_torch.diagnosis.text import lines
from tests.helpers.diagnosed import Diagnosed, diagnosed, sound_spring


@pytest.fixture(scope="module")
def nothing() -> Diagnosed:
    return sound_spring()


@pytest.fixture(scope="module")
def missed() -> Diagnosed:
    """Dry friction, of which no candidate knows."""
    options = Options(candidates=("cubic_stiffness",))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options)


@pytest.mark.slow
def test_where_nothing_is_missing_functions_explain_nothing(nothing: Diagnosed) -> None:
    own = nothing[1]["flexible"]
    assert (own["left"], own["explained"], own["left_nats"], own["why_not"]) == (False, None, 0.0, None)
    assert own["sentence"] == "Functions of what was measured explain nothing of blocks of time left out."
    assert f"ceiling: {own['sentence']}" in lines(nothing[1])
    assert "flexible" not in pictures(*nothing)


def test_what_is_left_far_above_white_noise_is_said_beside_that_nothing_is_missing(
    nothing: Diagnosed,
) -> None:
    diagnosis, said = nothing
    assert "times white noise" not in said["summary"]
    channels = [replace(c, after=50.0 * c.floor) for c in diagnosis.explanation.channels]
    much = replace(diagnosis, explanation=replace(diagnosis.explanation, channels=channels))
    summary_of = content(much)["summary"]
    assert summary_of.startswith(
        "Nothing is missing that a test or a function of what was measured shows, but"
    )
    assert "of q_dot is 50 times white noise" in summary_of


@pytest.fixture(scope="module")
def friction() -> Diagnosed:
    options = Options(candidates=("coulomb_friction",))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options)


@pytest.mark.slow
def test_an_effect_that_is_named_explains_all_that_functions_can(friction: Diagnosed) -> None:
    content = friction[1]
    own = content["flexible"]
    assert content["added"] == ["coulomb_friction"]
    assert own["left"] is False
    assert own["explained"] > 0.9
    outcome = friction[0].outcome
    evidence = outcome.found[0].evidence.nats
    assert evidence > 20.0
    assert own["effects_nats"] == pytest.approx(evidence, rel=0.3)
    assert "all that functions of what was measured can" in own["sentence"]


def test_what_no_candidate_names_is_explained_by_functions(missed: Diagnosed) -> None:
    _, content = missed
    own = content["flexible"]
    assert own["left"] is True
    (row,) = own["rows"]
    assert (row["row"], row["unit"], row["variables"][0]) == ("force", "m/s2", "q_dot")
    # what is left of a sign of 0.5 beside a damping, which takes a line in the speed
    assert row["rms"] == pytest.approx(0.24, rel=0.4)
    assert 0.0 < 3.0 * row["standard_error"] < row["nats"]
    low, high = own["left_90"]
    assert 0.0 < low < own["left_nats"] < high
    assert "q_dot" in own["sentence"]
    told = lines(content)
    assert f"ceiling: {own['sentence']}" in told
    assert f"  provisional: {own['remedy']}" in told
    table = told[next(i for i, line in enumerate(told) if line.startswith("functions on")) + 2 :]
    assert [line.split()[0] for line in takewhile(bool, table)] == ["force"]
    html = page(content, {}, width=0.25)
    assert own["remedy"] in unescape(html)
    assert "<td>force</td>" in html


def test_it_is_drawn_with_where_it_may_be_trusted(missed: Diagnosed, tmp_path: Path) -> None:
    figure = pictures(*missed)["flexible"]
    axis = figure.axes[0]
    assert axis.get_xlabel().startswith("q_dot")
    labels = axis.get_legend_handles_labels()[1]
    assert {"no data near: not to be trusted", "data"} <= set(labels)
    assert axis.get_ylabel().startswith("force")
    page = missed[0].save(tmp_path).read_text(encoding="utf-8")
    assert "What functions could still explain" in page
    assert (tmp_path / "plots" / "flexible.png").is_file()


@pytest.mark.slow
def test_it_can_be_left_out() -> None:
    none, options = replace(BUDGETS, function_groups=0), Options(max_effects=0)
    _, content = diagnosed("mass_spring_damper", budgets=none, options=options)
    assert content["flexible"]["why_not"] == "not asked for"
    assert "was not measured: not asked for" in content["flexible"]["sentence"]
