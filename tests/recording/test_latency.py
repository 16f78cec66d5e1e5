"""Which of two channels comes late, and by how much, shows in kinematics alone; what is late can be put right."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from nsde_torch.data import DataSet, RawRun, Run
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import Recording, assemble
from nsde_torch.recording.latency import filtered, late_channels, latencies, on_one_clock, on_time
from nsde_torch.systems import make_system
from tests.helpers.data_systems import HEXACOPTER
from tests.helpers.flights import flight
from tests.helpers.two_joints import HOME

SPRING = make_system("mass_spring_damper")
DT = 0.01


def waves(t: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A position and its velocity, many frequencies up to 2 Hz."""
    rng = np.random.default_rng(seed)
    f, a, p = rng.uniform(0.1, 2.0, 12), rng.normal(size=12), rng.uniform(0, 6.28, 12)
    w = 2 * np.pi * f
    q = (a / w * np.sin(np.outer(t, w) + p)).sum(1)
    return q, (a * np.cos(np.outer(t, w) + p)).sum(1)


def run(seed: int, *, position: float = 0.0, velocity: float = 0.0, noise: float = 0.01) -> Run:
    t = DT * np.arange(3000)
    rng = np.random.default_rng(100 + seed)
    x = np.stack([waves(t - position, seed)[0], waves(t - velocity, seed)[1]], 1)
    x = x + noise * np.array([0.1, 1.0]) * rng.normal(size=x.shape)
    return Run(f"run_{seed}", t, x, np.zeros((3000, 1)))


@pytest.mark.parametrize("seconds", [0.013, 0.04, 0.1])
@pytest.mark.parametrize("channel", ["q", "q_dot"])
def test_the_late_channel_is_named_with_its_delay(channel: str, seconds: float) -> None:
    delays = {"position" if channel == "q" else "velocity": seconds}
    (late,) = late_channels(SPRING, [run(k, **delays, noise=0.1) for k in range(4)])
    assert (late.channel, late.other) == ((channel, "q_dot") if channel == "q" else (channel, "q"))
    assert late.seconds == pytest.approx(seconds, rel=0.1)
    assert late.low < seconds < late.high
    assert late.p < 1e-6


def test_of_two_joints_the_rate_that_is_late_is_named_by_its_own_name() -> None:
    runs = []
    for k in range(4):
        first, second = run(k), run(20 + k, velocity=0.03)
        columns = (second.x[:, 1], first.x[:, 1], second.x[:, 0], first.x[:, 0])  # w2, w1, q2, q1
        runs.append(Run(first.name, first.t, np.stack(columns, 1), np.zeros((3000, 2))))
    late = [one for one in late_channels(make_system(HOME), runs) if one.p < 1e-6]
    assert [(one.channel, one.other) for one in late] == [("w2", "q2")]
    assert late[0].seconds == pytest.approx(0.03, rel=0.1)


@pytest.mark.parametrize("seconds", [0.04, 0.1])
@pytest.mark.parametrize("column", [0, 1])
@pytest.mark.parametrize("filtered", [False, True])
def test_a_filter_is_told_from_a_delay(seconds: float, column: int, filtered: bool) -> None:
    chain = Recording(**{"sensor_lag" if filtered else "sensor_delay": {("q", "q_dot")[column]: seconds}})
    rng = np.random.default_rng(0)
    runs = []
    for k in range(4):
        clean = run(k, noise=0.0)
        made = chain.apply(RawRun("run", clean.t, clean.x, clean.u), SPRING, dt=DT, rng=rng)
        noise = 0.03 * np.array([0.1, 1.0]) * rng.normal(size=made.x.shape)
        runs.append(Run(f"run_{k}", made.t, made.x + noise, made.u))
    (late,) = late_channels(SPRING, runs)
    assert late.channel == ("q", "q_dot")[column]
    assert late.seconds == pytest.approx(seconds, rel=0.05)
    assert late.filtered == filtered
    assert not late.either
    times = {late.channel: seconds}
    back = on_time(runs[0], SPRING, *([{}, times] if filtered else [times]))
    assert late_channels(SPRING, [back])[0].seconds < 0.2 * seconds


def test_motion_that_is_too_slow_to_tell_a_filter_from_a_delay_is_said_to_be() -> None:
    chain, rng, runs = Recording(sensor_lag={"q_dot": 0.012}), np.random.default_rng(0), []
    for k in range(4):
        clean = run(k, noise=0.0)
        made = chain.apply(RawRun("run", clean.t, clean.x, clean.u), SPRING, dt=DT, rng=rng)
        runs.append(Run(f"run_{k}", made.t, made.x + 0.03 * rng.normal(size=made.x.shape), made.u))
    (late,) = late_channels(SPRING, runs)
    assert late.seconds == pytest.approx(0.012, rel=0.2)
    assert late.either


def test_sensors_that_are_on_time_are_hardly_ever_called_late() -> None:
    found = [late_channels(SPRING, [run(k, noise=0.1)])[0] for k in range(60)]
    assert sum(late.p < 0.05 for late in found) <= 8
    assert all(late.low < 0.5 * DT for late in found)


def test_an_attitude_is_compared_with_body_rates() -> None:
    hexacopter = make_system("hexacopter")
    t = DT * np.arange(4000)
    x = np.zeros((len(t), 13))
    angle, _ = waves(t, 3)
    x[:, 6], x[:, 8] = np.cos(0.1 * angle), np.sin(0.1 * angle)  # about y, by 0.2 angle
    x[:, 11] = 0.2 * waves(t - 0.02, 3)[1]
    x += 1e-4 * np.random.default_rng(0).normal(size=x.shape)
    x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
    late = {d.channel: d for d in late_channels(hexacopter, [Run("run", t, x, np.zeros((len(t), 6)))])}
    assert late["w"].seconds == pytest.approx(0.02, rel=0.1)
    assert late["w"].other == "q"


def test_a_channel_that_was_moved_back_is_on_time_and_the_ends_are_gone() -> None:
    late = run(1, velocity=0.025, noise=0.0)
    back = on_time(late, SPRING, {"q_dot": 0.025})
    assert back.segments == ((0, 2997),)
    inside = slice(2, 2990)
    assert np.abs(back.x - run(1, noise=0.0).x)[inside].max() < 1e-4
    there = on_time(back, SPRING, {"q_dot": -0.025})
    assert there.segments == ((3, 2997),)
    assert np.abs(there.x - late.x)[10:2980].max() < 1e-4
    with pytest.raises(DataError, match=r"no stretch that is long enough to take delays out of it \(.* ms"):
        on_time(late.slice(0, 5), SPRING, {"q_dot": 0.1})


@pytest.mark.parametrize("rows", [0.1, 0.5, 2.5, 4.0])
@pytest.mark.parametrize("filtered", [False, True])
def test_noise_of_an_undone_channel_is_white_again_over_the_rows_that_the_run_says(
    rows: float, filtered: bool
) -> None:
    seen = np.random.default_rng(3).normal(size=(60_000, 2))
    log = Run("run", DT * np.arange(len(seen)), seen, np.zeros((len(seen), 1)))
    times = {"q_dot": rows * DT}
    back = on_time(log, SPRING, *([{}, times] if filtered else [times]))
    e = back.x[100:-100, 1]

    def correlation(lag: int) -> float:
        return float((e[lag:] * e[:-lag]).mean() / np.square(e).mean())

    assert set(back.apart) == ({"q_dot"} if rows != 0.1 and (filtered or rows % 1.0) else set())
    apart = back.apart.get("q_dot", 1)
    assert all(abs(correlation(apart * k)) < 0.12 for k in (1, 2, 3))
    if apart > 1:
        assert max(abs(correlation(k)) for k in (1, 2, 3)) > 0.09


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
