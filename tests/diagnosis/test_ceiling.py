"""What functions could still explain: nothing where nothing is missing, else a share beside what the effects do."""

from dataclasses import replace
from html import unescape
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.effect_importance import BY_STEPS
from nsde_torch.diagnosis.report import WITH, WITHOUT, effect_panels, page, pictures
from nsde_torch.diagnosis.result import content
from nsde_torch.diagnosis.text import in_order, lines, small, without_it
from tests.helpers.diagnosed import Diagnosed, diagnosed, sound_spring


@pytest.fixture(scope="module")
def missed() -> Diagnosed:
    """Dry friction, of which no candidate knows."""
    options = Options(candidates=("cubic_stiffness",))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options)


@pytest.mark.slow
def test_where_nothing_is_missing_functions_explain_nothing() -> None:
    nothing = sound_spring()
    own = nothing[1]["flexible"]
    assert (own["left"], own["explained"], own["left_nats"], own["why_not"]) == (False, None, 0.0, None)
    assert own["sentence"] == "Functions of what was measured explain nothing of blocks of time left out."
    assert f"ceiling: {own['sentence']}" in lines(nothing[1])
    assert "flexible" not in pictures(*nothing)


def test_what_is_left_far_above_white_noise_is_said_beside_that_nothing_is_missing() -> None:
    diagnosis, said = sound_spring()
    assert "times white noise" not in said["summary"]
    channels = [replace(c, after=50.0 * c.floor) for c in diagnosis.explanation.channels]
    much = replace(diagnosis, explanation=replace(diagnosis.explanation, channels=channels))
    summary_of = content(much)["summary"]
    start = "Nothing is missing that a test or a function of what was measured shows, but"
    assert summary_of.startswith(start)
    assert "of q_dot is 50 times white noise" in summary_of


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


@pytest.fixture(scope="module")
def found() -> Diagnosed:
    """A spring with much dry friction and a weak steady push."""
    friction, push = {"coulomb_friction": {"size": 0.3}}, {"constant_force": {"acceleration": 0.05}}
    options = Options(candidates=("coulomb_friction", "constant_force"))
    return diagnosed("mass_spring_damper", friction, push, options=options)


@pytest.mark.slow
def test_what_returns_is_said_where_the_effect_is(found: Diagnosed) -> None:
    diagnosis, content = found
    assert content["told"]["by"] == BY_STEPS
    assert content["told"]["few"][0] == "coulomb_friction"
    (friction,) = (f for f in content["findings"] if f["name"] == "coulomb_friction")
    buys = friction["buys"]
    assert buys["nats"] == friction["held_out"]["nats"]
    assert buys["error_with"] < 0.5 * buys["error_without"]
    words = without_it(friction, content)
    assert words.startswith("without it, on runs left out: the residual of q_dot goes from")
    assert any(words in line for line in lines(content))
    pictures = diagnosis.importance
    assert list(pictures) == sorted(pictures, key=lambda n: -pictures[n].gain)


@pytest.mark.slow
def test_small_effects_are_gathered_in_one_line(found: Diagnosed) -> None:
    _, content = found
    few, rest = content["told"]["few"][:1], [n for n in content["added"] if n != "coulomb_friction"]
    sizes = [{"effect": name, "size": "0.05 m/s2"} for name in rest]
    gathered = {**content, "told": {**content["told"], "few": few, "rest": sizes, "rest_share": 0.04}}
    assert [f["name"] for f in in_order(gathered)] == few
    line = f"and {small(len(rest))}, together 4.0% of what all effects improve on runs left out: {rest[0]} (0.05 m/s2)"
    assert any(told_line.startswith(line) for told_line in lines(gathered))
    text = page(gathered, {}, width=0.25)
    assert f"<summary>And {line[4:]}" in text
    assert text.index("<code>coulomb_friction</code>") < text.index(f"<code>{rest[0]}</code>")


def test_each_effect_that_matters_has_a_picture(found: Diagnosed) -> None:
    diagnosis, _ = found
    panels = effect_panels(diagnosis.outcome, diagnosis.shown, diagnosis.importance, diagnosis.runs)
    assert set(panels) == set(diagnosis.shown.few)
    panel = panels["coulomb_friction"]
    assert (panel.channel, panel.variable) == ("q_dot", "q_dot")
    without, left = panel.clouds[WITHOUT], panel.clouds[WITH]
    slow = np.sign(without.centre) * without.mean
    assert slow.mean() < -0.2  # it brakes, whichever way the mass moves
    assert np.abs(left.mean).mean() < 0.1
