"""What a flexible model could win is told: silent where nothing is missing, else as a share that effects explain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.ceiling_text import ceiling_content, ceiling_html, ceiling_rows
from nsde_torch.diagnosis.decision import judged_by_the_ceiling
from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS
from nsde_torch.diagnosis.evidence import folds, nats_by_channel, score
from nsde_torch.diagnosis.fitted import fitted_system, nonlinear
from nsde_torch.diagnosis.flexible import Flexible, flexible
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.pictures import pictures
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.search import Base
from nsde_torch.diagnosis.smooth_functions import first_groups, scales
from nsde_torch.diagnosis.summary import summary
from nsde_torch.diagnosis.text import lines
from nsde_torch.inference.smooth import functions
from tests.diagnosis.test_shape import Push, pushed
from tests.helpers.diagnosed import diagnosed


def fitted(push: Push, times: str = "") -> tuple[Flexible, Base]:
    """A flexible model of a spring with a push, which the physics knows nothing of."""
    r, variables = pushed(push, times)
    fold, block = folds(r), r.whitened_rows(r.blocks)
    base = Base(
        fitted_system(r), r, score(r, fold, block, still=nonlinear(r.vector, smooth=False)), fold, block
    )
    return flexible(base, variables, BUDGETS), base


@pytest.fixture(scope="module")
def noise() -> Flexible:
    return fitted(lambda q, t, run: 0.0 * q)[0]


@pytest.mark.slow
def test_a_force_in_one_place_is_won_on_runs_that_were_not_seen(noise: Flexible) -> None:
    found, base = fitted(lambda q, t, run: 0.8 * np.exp(-(((q - 0.1) / 0.15) ** 2)))
    floor = noise.plain_squares.mean()
    plain, left = found.plain_squares.mean() - floor, found.flexible_squares.mean() - floor
    assert left < 0.15 * plain
    ((part, foretold),) = found.parts
    assert {part.terms[k].group.variables for fold in foretold.chosen for k in fold} == {("q",)}
    gain = np.bincount(base.fold, weights=(found.flexible - found.plain)[:, 0])
    assert (gain > 10.0).all()


def test_a_gain_that_is_another_in_one_place_is_won(noise: Flexible) -> None:
    found, _ = fitted(lambda q, t, run: 1.2 * np.exp(-(((q - 0.1) / 0.1) ** 2)), "force")
    floor = noise.plain_squares.mean()
    plain, left = found.plain_squares.mean() - floor, found.flexible_squares.mean() - floor
    assert left < 0.2 * plain
    ((part, foretold),) = found.parts
    kinds = {(part.terms[k].group.variables, part.terms[k].group.kind) for k in foretold.used}
    assert (("q", "force"), "varying") in kinds


def test_of_noise_nothing_is_chosen_and_nothing_is_won(noise: Flexible) -> None:
    np.testing.assert_array_equal(noise.flexible, noise.plain)
    np.testing.assert_array_equal(noise.flexible_squares, noise.plain_squares)
    ((_, foretold),) = noise.parts
    assert foretold.used == []


def test_what_is_in_one_run_alone_lowers_the_error_of_no_other() -> None:
    found, base = fitted(lambda q, t, run: 3.0 * q * (run == 2))
    gain = np.bincount(base.fold, weights=(found.flexible - found.plain)[:, 0])
    assert (gain[:3] == 0.0).all()  # of the other two runs together nothing holds
    assert found.flexible_squares.mean() >= found.plain_squares.mean()


def test_functions_are_taken_at_the_scale_of_the_data() -> None:
    _, variables = pushed(lambda q, t, run: 0.0 * q)
    scaled = scales(variables)
    for group in first_groups(variables, scaled, pairs=True):
        assert np.isfinite(group.columns).all()
        if group.kind in ("polynomial", "smooth", "varying"):
            again = functions(group.variables, group.kind, variables.columns, scaled)
            np.testing.assert_array_equal(again, group.columns)
    names = [g.variables for g in first_groups(variables, scaled, pairs=False)]
    assert max(map(len, names)) == 1


@pytest.fixture(scope="module")
def nothing() -> tuple[Diagnosis, dict[str, Any]]:
    return diagnosed("mass_spring_damper")


@pytest.fixture(scope="module")
def missed() -> tuple[Diagnosis, dict[str, Any]]:
    """Dry friction, of which no candidate knows."""
    options = Options(candidates=("cubic_stiffness",))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options)


def test_where_nothing_is_missing_a_flexible_model_finds_nothing(
    nothing: tuple[Diagnosis, dict[str, Any]],
) -> None:
    own = nothing[1]["flexible"]
    assert (own["left"], own["explained"], own["left_nats"], own["why_not"]) == (False, None, 0.0, None)
    assert own["sentence"] == "A flexible model finds nothing to explain on runs left out."
    assert "ceiling: A flexible model finds nothing to explain on runs left out." in lines(nothing[1])
    assert "flexible" not in pictures(*nothing)


@pytest.fixture(scope="module")
def friction() -> tuple[Diagnosis, dict[str, Any]]:
    options = Options(candidates=("coulomb_friction",))
    return diagnosed("mass_spring_damper", {"coulomb_friction": {"size": 0.5}}, options=options)


@pytest.mark.slow
def test_an_effect_beside_which_more_is_left_than_it_explains_is_a_lead(
    friction: tuple[Diagnosis, dict[str, Any]],
) -> None:
    outcome = friction[0].outcome
    assert not outcome.found[0].provisional
    (channel,) = outcome.found[0].moves
    brought = nats_by_channel(outcome.declared.regression, outcome.final.regression)[channel]

    def with_more(share: float, *, more: bool = True) -> Outcome:
        left_by = {channel: share * brought}
        return judged_by_the_ceiling(outcome, Ceiling(more=more, effects=brought, left_by=left_by))

    assert with_more(2.0, more=False) is outcome
    beside = with_more(0.9 * DECISIONS.provisional_share)
    assert not beside.found[0].provisional
    half = with_more(0.5)
    assert "nats more: it may stand in for another law" in half.found[0].provisional
    assert half.verdict == "effect_found"
    elsewhere = judged_by_the_ceiling(
        outcome, Ceiling(more=True, effects=brought, left_by={"q": 0.5 * brought})
    )
    assert not elsewhere.found[0].provisional
    doubtful = with_more(1.5)
    (lead,) = doubtful.found
    assert lead.provisional
    assert doubtful.verdict == "unexplained"
    told = summary(doubtful.verdict, [], friction[0].told, doubtful, (), "q and q_dot on force")
    assert "a flexible model finds more (q and q_dot on force) than coulomb_friction can explain" in told
    assert told.endswith("which is a lead.")


def test_an_effect_that_is_named_explains_all_that_a_flexible_model_can(
    friction: tuple[Diagnosis, dict[str, Any]],
) -> None:
    content = friction[1]
    own = content["flexible"]
    assert content["added"] == ["coulomb_friction"]
    assert own["left"] is False
    assert own["explained"] > 0.9
    outcome = friction[0].outcome
    evidence = outcome.final.score.blocks.sum() - outcome.declared.score.blocks.sum()
    assert evidence > 20.0
    assert own["effects_nats"] == pytest.approx(
        evidence, rel=0.3
    )  # shapes stay: a step in a width is no linear one
    assert (
        "all that a flexible model can" in own["sentence"]
        or "% of what a flexible model can" in own["sentence"]
    )


def test_effects_that_win_nothing_on_runs_left_out_are_no_share_of_what_can_be_won(
    friction: tuple[Diagnosis, dict[str, Any]],
) -> None:
    lost = Ceiling(effects=-4.0, alone=3.0, explained=0.0, explained_interval=(0.0, 0.0))
    sentence = ceiling_content(lost, friction[0].outcome, 3)["sentence"]
    assert "The effects win no log-likelihood on runs left out (-4.0 nats" in sentence
    assert "a flexible model in their place wins 3.0" in sentence
    assert "%" not in sentence


def test_what_no_candidate_names_is_won_by_a_flexible_model_and_told(
    missed: tuple[Diagnosis, dict[str, Any]],
) -> None:
    _, content = missed
    own = content["flexible"]
    assert own["left"] is True
    assert own["p"] < DECISIONS.flexible_alpha
    assert own["variables"][0]["variable"] == "q_dot"
    assert (own["variables"][0]["row"], own["variables"][0]["unit"]) == ("force", "m/s2")
    channel = own["channels"]["q_dot"]
    assert channel["flexible"] < 0.8 * channel["effects"]
    assert content["residual"]["q_dot"]["floor"] <= channel["flexible"]
    low, high = own["left_90"]
    assert 0.0 < low < own["left_nats"] < high
    assert "q_dot" in own["sentence"]
    told = "\n".join(lines(content))
    assert own["sentence"] in told
    assert own["remedy"] in told
    head, rows = ceiling_rows(content)
    assert [row[0] for row in rows] == ["q_dot"]
    assert len(head) == len(rows[0])
    assert own["remedy"].replace("'", "&#x27;") in ceiling_html(content, "", lambda h, r: "")


def test_it_is_drawn_with_where_it_may_be_trusted(
    missed: tuple[Diagnosis, dict[str, Any]], tmp_path: Path
) -> None:
    figure = pictures(*missed)["flexible"]
    axis = figure.axes[0]
    assert axis.get_xlabel().startswith("q_dot")
    labels = axis.get_legend_handles_labels()[1]
    assert {"no data near: not to be trusted", "data"} <= set(labels)
    assert axis.get_ylabel().startswith("force")
    page = missed[0].save(tmp_path).read_text(encoding="utf-8")
    assert "What a flexible model could win" in page
    assert (tmp_path / "plots" / "flexible.png").is_file()


def test_it_can_be_left_out() -> None:
    none, options = replace(BUDGETS, flexible_turns=0), Options(max_effects=0)
    _, content = diagnosed("mass_spring_damper", budgets=none, options=options)
    assert content["flexible"]["why_not"] == "not asked for"
    assert "was not measured: not asked for" in content["flexible"]["sentence"]
