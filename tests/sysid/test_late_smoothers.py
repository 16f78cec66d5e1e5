"""Smoothers that kinematics speaks against: an attitude on time is behind no filter that makes it late."""

from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.signal import bilinear, lfilter

from nsde_torch.data import Run
from nsde_torch.recording.smoothers import FAMILIES, Smoother
from nsde_torch.rotation import turned
from nsde_torch.sysid.smoothed_states import Smoothed, SmoothedSensor, on_time, sensors_of
from nsde_torch.systems import make_system

Array = NDArray[np.float64]
DT = 0.004
QUADROTOR = make_system("quadrotor")
CAUSAL = next(family for family in FAMILIES if family.delays)
RATES, ATTITUDE = Smoother(CAUSAL, 2, 39.8, DT), Smoother(CAUSAL, 1, 11.8, DT)


def _behind(smoother: Smoother | None, x: Array) -> Array:
    """What a filter of first order that is as late makes of rows."""
    if smoother is None:
        return x
    b, a = bilinear([1.0], [smoother.delay, 1.0], fs=1 / DT)
    return np.asarray(lfilter(b, a, x, axis=0))


def _run(attitude: Smoother | None, rates: Smoother | None) -> Run:
    """Half a minute of small turns, the integral of rates, each behind its filter."""
    rng = np.random.default_rng(3)
    n, fine = 8000, 4
    slow = lfilter([0.002], [1.0, -0.998], rng.standard_normal((n * fine, 3)), axis=0)
    w = 30.0 * np.asarray(slow)
    turns = np.cumsum(w, 0) * DT / fine  # one axis alone turns far: the others stay small about it
    turns[:, :2], w[:, :2] = 0.0, 0.0
    turns, w = turns[::fine], w[::fine]
    identity = torch.zeros(n, 4, dtype=torch.float64)
    identity[:, 0] = 1.0
    x = np.zeros((n, 13))
    x[:, 6:10] = turned(identity, torch.from_numpy(_behind(attitude, turns))).numpy()
    x[:, 10:13] = _behind(rates, w) + 0.002 * rng.standard_normal((n, 3))
    x[:, 3:6] = 0.1 * rng.standard_normal((n, 3))
    return Run("a", np.arange(n) * DT, x, np.zeros((n, 4)), ((50, n),))


def _found(smoother: Smoother, name: str) -> Smoothed:
    sensor = next(s for s in sensors_of(QUADROTOR) if name in s.names)
    nothing = cast(Any, None)
    return Smoothed(smoother, (SmoothedSensor(sensor, 100.0, True, nothing, nothing),))


@pytest.mark.parametrize(
    ("attitude", "rates", "kept"),
    [
        (None, RATES, ["w_x"]),
        (ATTITUDE, None, ["q_w"]),
        (ATTITUDE, RATES, ["w_x", "q_w"]),
        (Smoother(CAUSAL, 1, 5.0, DT), RATES, ["w_x", "q_w"]),
    ],
    ids=["the attitude is on time", "the rates are", "both are late", "no filter explains the lateness"],
)
def test_a_filter_goes_that_would_make_late_what_is_on_time(
    attitude: Smoother | None, rates: Smoother | None, kept: list[str]
) -> None:
    found = [_found(RATES, "w_x"), _found(ATTITUDE, "q_w")]
    left = on_time(found, [_run(attitude, rates)], QUADROTOR, 1.0)
    assert [one.behind[0].sensor.names[0] for one in left] == kept


def test_a_filter_is_as_late_as_its_frequency_says() -> None:
    assert RATES.delay == pytest.approx(2**0.5 / (2.0 * np.pi * 39.8), rel=0.2)
