"""The autopilot's clock: one that drifts, one that is set, and the age of states on it."""

from __future__ import annotations

import random

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.link.timesync import PERIOD, TimeSync
from tests.helpers.px4_world import START, World, delayed


def _answer(sync: TimeSync, at: float, theirs: float, rng: random.Random, late: float) -> None:
    """One question at a time of ours; both ways take their time."""
    there, back = (rng.expovariate(1.0 / late) + 0.0005 for _ in range(2))
    sync.answered(theirs, at - there, at + back)


@pytest.mark.parametrize("drift", [-0.02, -0.007, 0.0, 0.01, 0.05])
@pytest.mark.parametrize("late", [0.001, 0.01])
def test_a_clock_that_drifts_is_known_at_every_time(drift: float, late: float) -> None:
    rng, sync = random.Random(7), TimeSync()
    worst = []
    for k in range(300):
        t = 1000.0 + PERIOD * k
        _answer(sync, t, 5.0 + (1.0 + drift) * (t - 1000.0), rng, late)
        soon = t + 0.09
        if k > 20:
            worst.append(abs(sync.ours(5.0 + (1.0 + drift) * (soon - 1000.0)) - soon))
    assert np.percentile(worst, 95) < 0.001 + 0.4 * late
    assert sync.drift == pytest.approx(drift, abs=0.002 + 0.2 * late)


def test_a_clock_that_is_set_is_followed_at_once_and_makes_no_drift() -> None:
    rng, sync = random.Random(3), TimeSync()
    for k in range(100):
        t = 1000.0 + PERIOD * k
        _answer(sync, t, t + (0.3 if k >= 60 else 0.0), rng, 0.001)
        if k > 62:
            assert abs(sync.offset(t) - 0.3) < 0.005
            assert abs(sync.drift) < 0.02


@pytest.mark.parametrize("speed", [0.98, 0.99, 1.01])
def test_a_flight_on_a_clock_that_drifts_reads_the_true_age_and_goes_to_its_end(speed: float) -> None:
    world = World(
        path=PathPoints(shapes.circle(duration=12.0)), speed=speed, down=delayed(0.002, 0.006, seed=1)
    )
    recorder, wrong = Recorder(world.flight, None), []

    def look(w: World) -> None:
        recorder.look(w.now)
        state = w.endpoint.state
        if state is not None and w.now > START + 2.0:
            wrong.append(1e3 * (state.time - START - state.stamp / speed))

    world.run(look)
    assert world.flight.outcome.tracked, world.says
    assert world.flight.outcome.trouble is None
    ages = recorder.finish().as_dict()["state_age_ms"]
    # [ms]; half of what the two ways differ by stays, as answers wait for the next tick of 10 ms and questions do not
    assert np.abs(wrong).max() < 10.0
    assert np.std(wrong) < 1.0
    assert ages["p99"] < 25.0
    assert world.endpoint.telemetry.sync.drift == pytest.approx(speed - 1.0, abs=0.003)
