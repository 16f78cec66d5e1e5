"""A stage whose numbers fail costs itself and not the run."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.data import DataSet
from nsde_torch.diagnosis import pipeline
from nsde_torch.diagnosis.cross_validation import HeldOut
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.stages import NotDone, OptionalStages, needed
from nsde_torch.diagnosis.text import lines
from nsde_torch.errors import DataError

OPTIONAL = ("undone", "without_standstill", "guard_of", "cross_validated", "ceiling")


def _fails(*_: object, **__: object) -> None:
    raise np.linalg.LinAlgError("Singular matrix")


@cache
def rubbing() -> DataSet:
    """Runs of a spring with dry friction."""
    dry = [{"coulomb_friction": {"size": 0.3}}]
    made = nsde_torch.simulate("mass_spring_damper", effects=dry, durations=[3.0] * 3, dt=0.02, seed=1)
    return nsde_torch.read(made, system="mass_spring_damper")


def diagnosed_without(monkeypatch: pytest.MonkeyPatch, *stages: str) -> Diagnosis:
    """Of a spring with dry friction, where these stages fail."""
    for name in stages:
        monkeypatch.setattr(pipeline, name, _fails)
    return nsde_torch.diagnose(rubbing(), system="mass_spring_damper", candidates=["coulomb_friction"])


@pytest.mark.slow
def test_stages_that_fail_are_told_and_cost_themselves(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = diagnosed_without(monkeypatch, *OPTIONAL)
    assert found.added == ["coulomb_friction"]
    content = found.content()
    assert len(content["not_done"]) == len(OPTIONAL)
    ceiling = content["not_done"][-1]
    assert ceiling == {
        "stage": "what functions could still explain",
        "why": "it could not be computed (LinAlgError: Singular matrix)",
    }
    said = f"{ceiling['stage']}: {ceiling['why']}."
    assert f"not done: {said}" in lines(content)
    assert said in found.save(tmp_path).read_text(encoding="utf-8")


def test_a_selection_that_fails_leaves_the_tests_of_the_declared_physics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = diagnosed_without(monkeypatch, "JointSearch")
    assert (found.added, found.verdict) == ([], "unexplained")
    assert pipeline.SELECTION in [n["stage"] for n in found.content()["not_done"]]


@pytest.mark.slow
def test_laws_that_fail_leave_what_the_catalogue_found(monkeypatch: pytest.MonkeyPatch) -> None:
    found = diagnosed_without(monkeypatch, "with_laws")
    assert found.added == ["coulomb_friction"]
    assert [n["stage"] for n in found.content()["not_done"]] == ["laws beyond the catalogue"]


def raising(error: Exception) -> Callable[[], Any]:
    def fails() -> None:
        raise error

    return fails


def refuting(monkeypatch: pytest.MonkeyPatch, **interval: float) -> None:
    """Runs left out are 20 nats likelier without each effect."""
    measured = pipeline.cross_validated

    def errors(*given: Any, **more: Any) -> HeldOut:
        found = measured(*given, **more)
        worse = {name: replace(one, nats=-20.0, **interval) for name, one in found.own.items()}
        return replace(found, own=worse)

    monkeypatch.setattr(pipeline, "cross_validated", errors)


def test_what_runs_left_out_surely_refute_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    refuting(monkeypatch, low=-30.0, high=-10.0, rest=-5.0)
    found = diagnosed_without(monkeypatch)
    assert (found.added, found.verdict) == ([], "unexplained")
    assert "coulomb_friction" not in str(found)
    (aside,) = found.content()["aside"]
    assert aside["effect"] == "coulomb_friction"
    assert aside["reason"] == "runs that it was not fitted to are likelier without it, by 20 nats"


@pytest.mark.slow
def test_one_run_alone_refutes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    refuting(monkeypatch, low=-30.0, high=-10.0, rest=1.0)
    found = diagnosed_without(monkeypatch)
    assert found.added == ["coulomb_friction"]
    assert (
        found.outcome.found[0].provisional == "it does not raise the log-likelihood of q_dot on runs left out"
    )


@pytest.mark.parametrize(
    "error",
    [
        np.linalg.LinAlgError("Singular matrix"),
        torch.linalg.LinAlgError("Singular matrix"),
        FloatingPointError("overflow"),
        ValueError("array must not contain infs or NaNs"),
    ],
)
def test_what_fails_numerically_is_noted_once(error: Exception) -> None:
    stages = OptionalStages()
    for _ in range(2):
        assert stages.attempt("a stage", raising(error), 7) == 7
    assert stages.attempt("another stage", lambda: 3, 7) == 3
    why = f"it could not be computed ({type(error).__name__}: {error})"
    assert stages.not_done == [NotDone("a stage", why)]


def test_a_search_that_fails_numerically_is_an_error_with_a_remedy() -> None:
    words = r"the search .* \(LinAlgError: SVD did not converge\)\. Look at .* inspect"
    with pytest.raises(DataError, match=words):
        needed("the search for effects", raising(np.linalg.LinAlgError("SVD did not converge")))
