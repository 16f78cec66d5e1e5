"""What data cannot show: standard errors of candidates, and which effects are listed."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from nsde_torch.diagnosis.detectability import not_shown
from nsde_torch.diagnosis.rounds import Round
from nsde_torch.diagnosis.screening import standard_errors
from nsde_torch.diagnosis.search import Base


def test_standard_errors_are_those_of_least_squares_beside_the_other_columns() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(400, 3)) * [1.0, 20.0, 0.1]
    x[:, 2] += 0.05 * x[:, 0]
    size = np.linalg.norm(x, axis=0)
    expected = np.sqrt(np.diag(np.linalg.inv(x[:, [0, 2]].T @ x[:, [0, 2]])))
    assert standard_errors(x / size, size, [0, 2]) == pytest.approx(expected.tolist())


def test_a_column_of_nothing_or_one_that_others_make_has_no_finite_error() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=100)
    columns = np.stack((a, 0 * a, a), 1)
    size = np.array([10.0, 0.0, 10.0])
    errors = standard_errors(columns / np.maximum(size, 1e-300), size, [0, 1, 2])
    assert errors == [np.inf, np.inf, np.inf]


def _looks(error: float) -> list[Round]:
    base = cast(Base, None)  # not looked at
    return [
        Round(base, [], {"constant_force": 0.0}, {"constant_force": {"constant_force.acceleration": error}})
    ]


def test_an_effect_is_listed_when_four_standard_errors_exceed_a_quarter_of_its_usual_size() -> None:
    # the usual size of a constant force is 0.1 m/s2
    assert not_shown(_looks(0.006), found=(), alpha=0.01) == []
    (listed,) = not_shown(_looks(0.007), found=(), alpha=0.01)
    assert (listed.effect, listed.smallest, listed.usual) == ("constant_force", pytest.approx(0.028), 0.1)
    assert listed.experiment
    assert not_shown(_looks(np.inf), found=(), alpha=0.01)[0].smallest is None


def test_what_was_found_and_what_a_later_look_would_show_is_not_listed() -> None:
    assert not_shown(_looks(1.0), found=("constant_force",), alpha=0.01) == []
    assert not_shown(_looks(1.0) + _looks(0.001), found=(), alpha=0.01) == []
