"""Runs and data sets refuse what does not fit, and equal content has equal hashes."""

from __future__ import annotations

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import DataError, ShapeError


def make(name: str = "a", n: int = 20, **changes: object) -> Run:
    parts = {"t": 0.1 * np.arange(n), "x": np.arange(2.0 * n).reshape(n, 2), "u": np.ones((n, 1))} | changes
    return Run(name, **parts)  # type: ignore[arg-type]


def test_arrays_are_float64_and_read_only_without_freezing_the_callers() -> None:
    x = np.zeros((20, 2))
    run = make(x=x, u=np.ones((20, 1), dtype=np.float32))
    assert run.u.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        run.x[0] = 1
    x[0] = 1


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"x": np.zeros(20)}, ShapeError, r"`x` must be \(n, columns\); got shape \(20,\)"),
        ({"u": np.zeros((19, 1))}, ShapeError, "`u` must have one row for each of the 20 times; got 19"),
        ({"t": np.zeros(20)}, DataError, "`t` must increase"),
        ({"x": np.full((20, 2), np.nan)}, DataError, "`x` is not finite in row 0"),
        ({"segments": ((0, 5), (4, 9))}, DataError, "segments must be increasing"),
        ({"segments": ((0, 21),)}, DataError, "segments must be increasing"),
        ({"segments": ((0, 1),)}, DataError, "segments must be increasing"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(change: dict, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make(**change)


def test_one_row_is_no_run() -> None:
    with pytest.raises(DataError, match="needs at least two"):
        make(n=1)


def test_duration_and_step_leave_gaps_out() -> None:
    t = np.concatenate([0.1 * np.arange(10), 5 + 0.1 * np.arange(10)])
    run = make(t=t, segments=((0, 10), (10, 20)))
    assert run.dt == pytest.approx(0.1)
    assert run.duration == pytest.approx(1.8)


def test_slice_cuts_segments_to_fit_and_drops_single_rows() -> None:
    run = make(segments=((0, 10), (10, 20)))
    part = run.slice(9, 15)
    assert part.segments == ((1, 6),)
    np.testing.assert_array_equal(part.x, run.x[9:15])
    assert run.slice(-5, 20).segments == ((0, 5),)
    with pytest.raises(DataError, match="no segment of two rows"):
        run.slice(9, 11)


def test_content_hash_sees_values_and_shape_but_not_name_or_clock() -> None:
    assert make("a").content_hash == make("b", t=7 + 0.2 * np.arange(20)).content_hash
    changed = np.arange(40.0).reshape(20, 2)
    changed[3, 1] += 1e-12
    assert make(x=changed).content_hash != make().content_hash
