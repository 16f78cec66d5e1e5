"""What a regression shows, and what it does not, in words."""

from __future__ import annotations

import numpy as np

from nsde_torch.sysid.regression import sentences, shown

LABELS, UNITS = ["a", "b", "c"], ["1/s", "m", "1"]
SCALE = np.array([1.0, 2.0, 0.5])


def columns(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(400, 3))


def test_of_independent_columns_everything_is_shown() -> None:
    found = shown(columns(), SCALE)
    assert (found.rank, found.lost.shape) == (3, (3, 0))
    assert found.known.all()
    assert 1.0 <= found.condition < 1.5
    assert sentences(found, LABELS, UNITS, SCALE) == []


def test_a_column_of_zeros_is_named_alone() -> None:
    slopes = columns()
    slopes[:, 1] = 0.0
    found = shown(slopes, SCALE)
    assert found.known.tolist() == [True, False, True]
    assert sentences(found, LABELS, UNITS, SCALE) == ["b: nothing in the data depends on it"]


def test_proportional_columns_are_named_together_with_the_change_that_nothing_shows() -> None:
    slopes = columns()
    slopes[:, 2] = -4.0 * slopes[:, 0]
    found = shown(slopes, SCALE)
    assert found.known.tolist() == [False, True, False]
    np.testing.assert_allclose(slopes @ found.lost, 0.0, atol=1e-9)
    (said,) = sentences(found, LABELS, UNITS, SCALE)
    assert said.startswith("a and c: only together; the data look the same with a by ")
    assert "1/s, c by " in said


def test_nothing_at_all_is_shown_by_zeros() -> None:
    found = shown(np.zeros((50, 3)), SCALE)
    assert found.rank == 0
    assert not found.known.any()
    assert len(sentences(found, LABELS, UNITS, SCALE)) == 3
