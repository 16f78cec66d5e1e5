"""Runs refuse what does not fit; splits are by whole run, and windows cross no gap and share no row."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from nsde_torch.data import DataSet, RawRun, Run, Windows, split
from nsde_torch.data.denoise import denoised
from nsde_torch.errors import ConfigError, DataError, ShapeError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import MSD


def run(n: int, segments: tuple[tuple[int, int], ...] = (), offset: float = 0.0, name: str = "a") -> Run:
    """Row k holds x = (offset + k, -k) and u = k."""
    k = np.arange(n, dtype=float)
    return Run(name, 100 + 0.01 * k, np.stack([offset + k, -k], 1), k[:, None], segments=segments)


def test_rows_inputs_and_times_are_those_of_the_definition() -> None:
    windows = Windows([run(50), run(40, offset=1000, name="b")], 0.05, 4)
    assert len(windows) == 50 - 20 + 40 - 20
    x, u, t0 = windows.batch([3, 30])
    assert x.tolist()[0] == [[3 + 5 * j, -(3 + 5 * j)] for j in range(5)]
    assert u[0, :, 0].tolist() == [5 + 5 * j for j in range(4)]
    assert x[1, 0].tolist() == [1000, 0]
    assert (t0.dtype, t0.tolist()) == (torch.float64, [100.03, 100.0])
    assert windows.locate([3, 30]) == [("a", 3), ("b", 0)]
    with pytest.raises(IndexError, match=r"0\.\.49"):
        windows.batch([50])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_every_window_lies_in_one_segment_and_all_that_fit_are_there(data: st.DataObject) -> None:
    runs, expected = [], []
    span = data.draw(st.integers(1, 3)) * (stride := data.draw(st.integers(1, 4)))
    for r in range(data.draw(st.integers(1, 3))):
        cuts = sorted(data.draw(st.sets(st.integers(2, 58), max_size=4)))
        edges = [0, *cuts, 60]
        segments = tuple((a, b) for a, b in pairwise(edges) if b - a >= 2)
        runs.append(run(60, segments, name=str(r)))
        expected += [(str(r), s) for a, b in segments for s in range(a, b - span)]
    try:
        windows = Windows(runs, 0.01 * stride, span // stride)
    except DataError:
        assert not expected
        return
    assert windows.locate(range(len(windows))) == expected


def test_the_model_step_must_be_a_multiple_of_the_data_step() -> None:
    assert Windows([run(50)], 0.0499, 4).stride == 5
    for dt, horizon, error, words in (
        (0.025, 4, ConfigError, "whole multiple .* Take 0.02 or 0.03 s"),
        (0.004, 4, ConfigError, "whole multiple"),
        (0.05, 0, ConfigError, "`horizon`"),
        (0.05, 10, DataError, r"no segment is as long as a window .* \(51 rows\); the longest has 50"),
    ):
        with pytest.raises(error, match=words):
            Windows([run(50)], dt, horizon)
    with pytest.raises(DataError, match="at least one run"):
        Windows([], 0.05, 4)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 0.5), st.floats(0.1, 2.0))
def test_held_out_blocks_share_no_row_with_training(seed: int, fraction: float, block: float) -> None:
    windows = Windows([run(700, ((0, 300), (300, 700))), run(400, name="b")], 0.02, 5)
    train, held = windows.held_out(fraction, block, torch.Generator().manual_seed(seed))
    assert len(train) > 0
    assert len(held) > 0

    def rows(part: Windows) -> np.ndarray:
        return np.unique(part.rows(range(len(part)))[:, None] + np.arange(part.span + 1))

    a, b = rows(train), rows(held)
    assert not np.intersect1d(a, b).size
    every = set(windows.locate(range(len(windows))))
    assert set(train.locate(range(len(train)))) | set(held.locate(range(len(held)))) <= every
    again = windows.held_out(fraction, block, torch.Generator().manual_seed(seed))
    assert again[1].locate(range(len(held))) == held.locate(range(len(held)))
    assert train.batch([0])[0].shape == (1, 6, 2)


def test_a_single_short_run_still_gives_validation_and_a_shorter_one_says_why_not() -> None:
    train, held = Windows([run(51)], 0.01, 20).held_out(0.15, 5.0, torch.Generator().manual_seed(0))
    assert (len(train), len(held)) == (10, 1)
    with pytest.raises(DataError, match=r"not fit\. Shorten `horizon`"):
        Windows([run(41)], 0.01, 20).held_out(0.15, 5.0, torch.Generator().manual_seed(0))
    with pytest.raises(ConfigError, match="`fraction`"):
        Windows([run(51)], 0.01, 20).held_out(0.0, 5.0, torch.Generator().manual_seed(0))


def test_inputs_before_are_means_over_model_steps_of_the_same_segment() -> None:
    windows = Windows([run(60, ((0, 30), (30, 60))), run(40, offset=1000, name="b")], 0.05, 4)
    places = windows.locate(range(len(windows)))
    at = [places.index(p) for p in (("a", 9), ("a", 32), ("a", 30), ("b", 10))]
    before = windows.before(at, 2)
    assert before.shape == (4, 2, 1)
    #   the mean of 0..3 with the first repeated once, then of 4..8
    assert before[0, :, 0].tolist() == [pytest.approx((0 + 0 + 1 + 2 + 3) / 5), 6]
    assert before[1, :, 0].tolist() == [30, pytest.approx((3 * 30 + 30 + 31) / 5)]
    assert before[2, :, 0].tolist() == [30, 30]
    assert before[3, :, 0].tolist() == [2, 7]
    torch.testing.assert_close(windows.before(at, 1), before[:, 1:])


def make(name: str = "a", n: int = 20, **changes: object) -> Run:
    parts = {"t": 0.1 * np.arange(n), "x": np.arange(2.0 * n).reshape(n, 2), "u": np.ones((n, 1))} | changes
    return Run(name, **parts)  # type: ignore[arg-type]


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


Array = NDArray[np.float64]
DT = 0.01


def swing(seed: int, n: int, noise: float, *, gap: bool = False) -> tuple[Run, Array]:
    """A decaying swing (position, velocity), measured with white noise, and the swing itself."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    phase = rng.uniform(0, 2 * np.pi)
    q = np.exp(-0.2 * t) * np.cos(2.0 * t + phase)
    truth = np.stack([q, np.gradient(q, DT)], 1)
    x = truth + noise * rng.standard_normal(truth.shape)
    segments = ((0, n // 2), (n // 2, n)) if gap else ((0, n),)
    return Run(f"swing_{seed}", t, x, np.zeros((n, 1)), segments=segments), truth


@pytest.mark.parametrize("noise", [0.003, 0.03, 0.2])
def test_what_is_left_of_the_noise_is_as_small_as_it_says(noise: float) -> None:
    runs, truths = zip(*(swing(seed, 800, noise) for seed in range(4)), strict=True)
    smooth, share = denoised(runs)
    left = np.sqrt(np.mean([np.square(s - t).mean(0) for s, t in zip(smooth, truths, strict=True)], 0))
    assert (share < 0.4).all()
    assert (left < 1.5 * share * noise).all()
    assert (left > 0.6 * share * noise).all()


def test_a_jump_between_segments_is_not_smoothed_over() -> None:
    run, _ = swing(0, 600, 0.01, gap=True)
    x = np.array(run.x)
    x[300:] += 5.0
    jumped = Run("jumped", run.t, x, run.u, segments=run.segments)
    (smooth,), _ = denoised([jumped])
    assert abs(np.diff(smooth[:, 0])[299] - 5.0) < 0.1


def test_windows_start_from_denoised_states_and_compare_with_measured_ones() -> None:
    run, truth = swing(2, 600, 0.05)
    plain = Windows([run], DT, 20, dtype=torch.float64)
    clean = Windows([run], DT, 20, dtype=torch.float64, denoise=True)
    pick = torch.arange(50, 500)
    assert torch.equal(plain.initial_states(pick), plain.batch(pick)[0][:, 0])
    assert torch.equal(clean.batch(pick)[0], plain.batch(pick)[0])
    error = clean.initial_states(pick) - torch.from_numpy(truth[50:500])
    assert float(error.square().mean().sqrt()) < 0.02
    assert (clean.start_share < 0.4).all()
    assert torch.equal(plain.start_share, torch.ones(2, dtype=torch.float64))
