"""Runs refuse what does not fit; splits are by whole run and never let training data into the test."""

import numpy as np
import pytest

from nsde_torch.data import DataSet, RawRun, Run, split
from nsde_torch.errors import DataError, ShapeError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import MSD


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
        ({"n": 1}, DataError, "needs at least two"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(change: dict, error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        make(**change)


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


def data(count: int, twins: bool = False) -> DataSet:
    raw, t = [], 0.01 * np.arange(100)
    for k in range(count):
        at = t if twins else t + k
        raw.append(RawRun(f"run_{k}", t, np.stack([np.sin(at), np.cos(at)], 1), np.ones((100, 1))))
    return assemble(raw, MSD, kind="test")


def test_runs_are_chosen_by_index_negative_index_digits_or_name() -> None:
    d = data(4)
    for key in (1, -3, "1", "run_1"):
        parts = split(d, [key])
        assert [r.name for r in parts.test] == ["run_1"]
        assert [r.name for r in parts.train] == ["run_0", "run_2", "run_3"]
    assert [r.name for r in split(d).test] == ["run_3"]
    assert split(d, []).test == ()
    assert [r.name for r in split(d, [0], train=["run_2"]).train] == ["run_2"]


@pytest.mark.parametrize(
    ("test", "train", "text"),
    [
        ([7], None, "no run 7; choose by index or name among the 3 runs: 0: run_0"),
        (["flight"], None, "no run 'flight'"), ([0, 1, 2], None, "no run is left for training"),
        ([1], ["run_1", 2], r"\['run_1'\] are in both"), ([1, "run_1"], None, r"\['run_1'\] more than once"),
        (1, None, "must be a list"), ([True], None, "no run True"),
    ],
)  # fmt: skip
def test_faulty_splits_are_refused(test: list, train: list | None, text: str) -> None:
    with pytest.raises(DataError, match=text):
        split(data(3), test, train=train)


def test_equal_content_on_both_sides_is_refused_under_any_name() -> None:
    with pytest.raises(DataError, match="'run_1' has the same content as the training run 'run_0'"):
        split(data(2, twins=True), [1])


def test_a_single_run_cannot_be_on_both_sides() -> None:
    with pytest.raises(DataError, match=r"holds one run .* set `test` to \[\]"):
        split(data(1))
    assert len(split(data(1), []).train) == 1
