"""Gains that have gone to nothing: effects are selected from their first values, and taken where that holds."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import pytest

import nsde_torch
from nsde_torch.diagnosis import gone
from nsde_torch.diagnosis.gone import select
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.search import Search, search_in
from nsde_torch.diagnosis.selection import Selection, forward_selection
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System, make_system

LAG, FLAPPING = 0.04, 15.0
CANDIDATES = ("motor_lag", "flapping_moment")


@pytest.fixture(scope="module")
def search() -> tuple[Search, System]:
    """Flights whose inputs cancel a moment of the blades, with a lag: gains come out half as large alone."""
    made = nsde_torch.simulate(
        "quadrotor",
        durations=[15.0] * 3,
        seed=5,
        declared_only=True,
        effects={
            "flapping_moment": {"gain": [FLAPPING, FLAPPING]},
            "motor_lag": {"time_constant": LAG},
        },
    )
    data = nsde_torch.read(made, system="quadrotor")
    system = make_system("quadrotor")
    return search_in(system, data.runs, data.clock_scale, Options(candidates=CANDIDATES)), system


@pytest.mark.slow
def test_effects_are_selected_from_first_values_where_gains_have_gone(
    search: tuple[Search, System], monkeypatch: pytest.MonkeyPatch
) -> None:
    where, system = copy.copy(search[0]), search[1]
    monkeypatch.setattr(gone, "GONE", 1.2)  # gains of 36 and 29 rad/s2 of a first value of 50 have gone then
    went_on: list[Selection] = []

    def selection(*args: Any, after: Selection | None = None) -> Selection:
        went_on.extend([] if after is None else [after])
        return forward_selection(*args, after=after)

    monkeypatch.setattr(gone, "forward_selection", selection)
    chosen = select(where, system)
    (freed,) = went_on  # once gains are free, other effects may be needed
    assert freed.names
    assert set(freed.names) <= set(chosen.names)
    assert set(chosen.names) == set(CANDIDATES)
    assert not where.held & {"roll_gain", "pitch_gain"}  # what comes back is free again
    now = dict(zip(chosen.final.regression.vector.labels, chosen.final.regression.theta, strict=True))
    before = dict(
        zip(chosen.declared.regression.vector.labels, chosen.declared.regression.theta, strict=True)
    )
    assert before["roll_gain"] < 45.0 < now["roll_gain"]
    assert now["roll_gain"] == pytest.approx(58.0, rel=0.05)
    assert now["pitch_gain"] == pytest.approx(58.0, rel=0.05)
    assert now["motor_lag.time_constant"] == pytest.approx(LAG, rel=0.1)
    assert now["flapping_moment.gain[0]"] == pytest.approx(FLAPPING, rel=0.1)


@pytest.mark.slow
def test_a_gain_that_goes_again_where_another_stays_is_held_and_not_shown(
    search: tuple[Search, System], monkeypatch: pytest.MonkeyPatch
) -> None:
    where, system = search
    first = {"roll_gain": 50.0, "yaw_gain": 8.0}

    def gone_at_first(regression: Regression, _: Mapping[str, float]) -> set[str]:
        declared = not any("." in label for label in regression.vector.labels)
        return {"roll_gain", "yaw_gain"} if declared else {"yaw_gain"}

    monkeypatch.setattr(gone, "_gone", gone_at_first)
    declared = where.base(system)
    only = copy.copy(where)
    chosen = gone._from_first_values(only, declared, system, first, {"roll_gain", "yaw_gain"})
    assert chosen is not None
    assert only.held == {"yaw_gain"}
    final = chosen.final.regression
    now = dict(zip(final.vector.labels, final.theta, strict=True))
    shown = dict(zip(final.vector.labels, final.shown.known, strict=True))
    assert now["yaw_gain"] == pytest.approx(8.0)
    assert not shown["yaw_gain"]  # no interval is given for what was held
    assert now["roll_gain"] == pytest.approx(58.0, rel=0.05)
    assert shown["roll_gain"]


@pytest.mark.slow
def test_ordinary_selection_stands_where_no_gain_has_gone_or_none_comes_back(
    search: tuple[Search, System], monkeypatch: pytest.MonkeyPatch
) -> None:
    where, system = search

    def untouched(*_: object) -> None:
        raise AssertionError("no parameter has gone")

    monkeypatch.setattr(gone, "_from_first_values", untouched)
    ordinary = select(where, system)
    assert set(ordinary.names) == set(CANDIDATES)
    monkeypatch.undo()
    monkeypatch.setattr(gone, "_gone", lambda regression, first: {"roll_gain"})  # whatever is found
    stuck = select(where, system)
    assert stuck.names == ordinary.names
    assert where.held == set()
