"""What feedback may hide is set aside one by one; what is left is then asked whether that would do better."""

from __future__ import annotations

from typing import Any, cast

import pytest

from nsde_torch.diagnosis import decision
from nsde_torch.diagnosis.decisions import BUDGETS
from nsde_torch.diagnosis.elimination import Retained
from nsde_torch.diagnosis.hidden import Feedback, Hidden
from nsde_torch.diagnosis.outcome import Found
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection

NOTHING = cast(Any, None)


class _Search:
    budgets = BUDGETS


def kept(*names: str, hidden: tuple[str, ...] = ()) -> Retained:
    return Retained(
        [Found(n, NOTHING, ()) for n in names], NOTHING, tuple(Hidden(n, ("q_dot",)) for n in hidden)
    )


def run(monkeypatch: pytest.MonkeyPatch, exchanged: str) -> tuple[Retained, list[Any]]:
    asked: list[Any] = []

    def weakest(search: Search, chosen: Selection, now: Retained, feedback: Feedback) -> Retained:
        names = [f.name for f in now.found]
        return now if len(names) < 2 else kept(names[1], hidden=(names[0],))

    def eliminate(search: Search, chosen: Selection, *, also: list[str]) -> Retained:
        asked.append((list(chosen.names), list(also)))
        return kept(exchanged)

    monkeypatch.setattr(decision, "_beyond_feedback", weakest)
    monkeypatch.setattr(decision, "eliminate", eliminate)
    base = cast(Base, None)
    first = kept("asymmetric_friction", "position_dependent_friction")
    chosen = Selection(base, base, ["asymmetric_friction", "position_dependent_friction"], [], ())
    return decision.set_aside(cast(Search, _Search()), chosen, first, NOTHING), asked


def test_of_two_that_stand_in_for_each_other_the_better_one_comes_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, asked = run(monkeypatch, "asymmetric_friction")
    assert asked[0] == (["position_dependent_friction"], ["asymmetric_friction"])
    assert [f.name for f in now.found] == ["asymmetric_friction"]
    assert now.hidden == ()


def test_what_does_no_better_stays_aside(monkeypatch: pytest.MonkeyPatch) -> None:
    now, asked = run(monkeypatch, "position_dependent_friction")
    assert len(asked) == 1
    assert [f.name for f in now.found] == ["position_dependent_friction"]
    assert [h.name for h in now.hidden] == ["asymmetric_friction"]
