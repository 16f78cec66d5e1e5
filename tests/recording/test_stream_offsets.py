"""Streams whose offsets differ between runs are put on one clock; others are left alone."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from nsde_torch.data import DataSet, RawRun
from nsde_torch.data.kinematics import Uncertain
from nsde_torch.errors import ConfigError
from nsde_torch.recording import assemble
from nsde_torch.recording.latency import differing, filtered, latencies, on_one_clock
from tests.helpers.data_systems import HEXACOPTER
from tests.helpers.flights import flight

NOISE = np.array([0.002] * 3 + [0.015] * 3 + [0.001] * 4 + [0.015] * 3)


def data_set(
    late: NDArray[np.float64],
    *,
    columns: slice = slice(10, 13),
    change: Callable[[NDArray[np.float64]], NDArray[np.float64]] = np.copy,
) -> DataSet:
    """Flights of which some columns are late by a time of each run [s], and changed."""
    runs = []
    for k, d in enumerate(late):
        t, x, u = flight(40.0, seed=k)
        there = CubicSpline(t, x)(np.clip(t - d, 0, t[-1]))
        x[:, columns] = change(there[:, columns])
        x += NOISE * np.random.default_rng(100 + k).standard_normal(x.shape)
        x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
        runs.append(RawRun(f"run_{k}", t[50:-10], x[50:-10], u[50:-10]))
    return assemble(runs, HEXACOPTER, kind="test")


@pytest.mark.parametrize(("columns", "channel"), [(slice(10, 13), "w"), (slice(3, 6), "v")])
def test_offsets_of_each_run_are_found_and_taken_out(columns: slice, channel: str) -> None:
    late = np.array([-0.008, 0.002, 0.016, 0.007])
    data = on_one_clock(before := data_set(late, columns=columns), HEXACOPTER)
    (finding,) = [f for f in data.summary.findings if f.kind == "stream_offset"]
    assert finding.message.startswith(f"{channel} is late against {'q' if channel == 'w' else 'p'}")
    found = np.array([finding.values[f"run_{k}_s"] for k in range(4)])
    np.testing.assert_allclose(found, late, atol=0.001)
    assert data.fingerprint != before.fingerprint
    for run in data.runs:
        own = next(lag for lag in latencies(HEXACOPTER, [run]) if lag.other == channel)
        assert abs(own.seconds) < 0.001
    assert on_one_clock(data, HEXACOPTER) is data


@pytest.mark.parametrize(("late", "runs"), [(0.0, 4), (0.012, 4), (0.016, 1)])
def test_runs_that_share_an_offset_are_left_alone(late: float, runs: int) -> None:
    data = data_set(np.full(runs, late))
    assert on_one_clock(data, HEXACOPTER) is data


@pytest.mark.parametrize("rows", [2.0, 5.0])
def test_a_filter_that_is_the_same_in_all_runs_is_no_offset(rows: float) -> None:
    data = data_set(np.zeros(4), change=lambda rates: filtered(rates, rows))
    assert on_one_clock(data, HEXACOPTER) is data


def test_a_user_may_keep_them() -> None:
    data = data_set(np.array([-0.008, 0.016]))
    assert on_one_clock(data, HEXACOPTER, policy="keep") is data
    with pytest.raises(ConfigError, match="`stream_offsets` must be one of undo, keep; got 'no'"):
        on_one_clock(data, HEXACOPTER, policy="no")


def test_an_unsure_run_is_drawn_to_the_others() -> None:
    sure = {f"run_{k}": Uncertain(d, 0.0005, 40) for k, d in enumerate((0.0, 0.010, 0.004, 0.012))}
    found = differing({**sure, "unsure": Uncertain(0.060, 0.050, 10)}, step=0.01)
    assert found["run_1"] == pytest.approx(0.010, abs=1e-4)
    assert found["unsure"] == pytest.approx(0.007, abs=0.003)


def test_one_run_that_is_far_surer_than_the_others_does_not_hide_what_differs() -> None:
    late = ((0.0188, 7e-5), (0.0036, 2e-4), (0.0019, 8e-4), (0.0111, 5e-5))
    offsets = {str(k): Uncertain(d, e, 19) for k, (d, e) in enumerate(late)}
    found = differing(offsets, step=0.01)
    assert found["0"] == pytest.approx(0.0188, abs=1e-4)
    assert found["2"] == pytest.approx(0.0019, abs=3e-4)


def test_chance_differences_are_told_once_in_ten_thousand() -> None:
    rng = np.random.default_rng(0)
    told = 0
    for _ in range(2000):
        errors = rng.uniform(0.0005, 0.004, 6)
        drawn = zip(errors, rng.standard_t(19, 6), strict=True)
        offsets = {str(k): Uncertain(e * t, e, 19) for k, (e, t) in enumerate(drawn)}
        told += differing(offsets, step=0.01) is not None
    assert told <= 2
