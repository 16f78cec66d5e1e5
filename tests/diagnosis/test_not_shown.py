"""What data cannot show, effects by their standard errors; and rows that the likelihood leaves out."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from nsde_torch.diagnosis.evidence import not_shown
from nsde_torch.diagnosis.joint_selection import JointSelection, Round
from nsde_torch.diagnosis.result import outlier_warnings


def _selected(*errors: float, alone: float = np.inf) -> JointSelection:
    """A selection whose looks gave a constant force these standard errors, and `alone` if all else were known."""
    smallest = {"constant_force": {"constant_force.acceleration": (min(errors), alone)}}
    return JointSelection(cast(Any, None), cast(Any, None), {}, (Round((), ""),), smallest)


def test_an_effect_is_listed_when_four_standard_errors_exceed_a_quarter_of_its_usual_size() -> None:
    # the usual size of a constant force is 0.1 m/s2
    assert not_shown(_selected(0.006), found=(), alpha=0.01) == []
    (listed,) = not_shown(_selected(0.007), found=(), alpha=0.01)
    assert (listed.effect, listed.smallest, listed.usual) == ("constant_force", pytest.approx(0.028), 0.1)
    assert listed.experiment
    assert not_shown(_selected(np.inf), found=(), alpha=0.01)[0].smallest is None


def test_what_declared_parameters_do_as_well_is_told_from_what_moves_nothing() -> None:
    (listed,) = not_shown(_selected(np.inf, alone=0.001), found=(), alpha=0.01)
    assert listed.smallest is None
    assert listed.declared
    (listed,) = not_shown(_selected(np.inf, alone=1.0), found=(), alpha=0.01)
    assert not listed.declared


def test_a_stop_that_nothing_reached_is_not_listed_and_one_that_is_hardly_seen_is() -> None:
    def stop(error: float) -> JointSelection:
        errors = {"stop_above": {"stop_above.stiffness": (error, np.inf)}}
        return JointSelection(cast(Any, None), cast(Any, None), {}, (Round((), ""),), errors)

    assert not_shown(stop(np.inf), found=(), alpha=0.01) == []
    assert not_shown(stop(0.5), found=(), alpha=0.01)[0].effect == "stop_above"


def test_what_was_found_and_what_a_later_look_would_show_is_not_listed() -> None:
    assert not_shown(_selected(1.0), found=("constant_force",), alpha=0.01) == []
    assert not_shown(_selected(1.0, 0.001), found=(), alpha=0.01) == []


def _with_outliers(times: dict[int, list[float]]) -> Any:
    joint = SimpleNamespace(final=SimpleNamespace(at=SimpleNamespace(outlier_times=times)))
    return SimpleNamespace(outcome=SimpleNamespace(joint=joint), runs=("first", "second"))


def test_rows_that_were_left_out_are_said_with_their_run_and_time() -> None:
    (warning,) = outlier_warnings(cast(Any, _with_outliers({1: [22.41, 22.42, 22.5]})))
    assert "3 of 'second', from t = 22.41 to 22.5 s" in warning["sentence"]
    assert warning["kind"] == "outliers"


def test_nothing_is_said_of_a_log_without_any() -> None:
    assert outlier_warnings(_with_outliers({})) == []
