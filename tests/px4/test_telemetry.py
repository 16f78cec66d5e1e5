"""One consistent state out of messages in any order, the time that it is valid for, and the autopilot's clock."""

import random
from math import nan, sqrt
from typing import Any

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.link.telemetry import PERIOD, Telemetry, TimeSync
from tests.helpers.px4_world import START, World, delayed

S = sqrt(0.5)
NOTHING = [nan] * 21
NORTH_UP = (1.0, 0.0, 0.0, 0.0)


def _odometry(
    stamp: float, p: Any = (1.0, 2.0, -3.0), v: Any = (0.5, 0.0, 0.0), q: Any = NORTH_UP, **more: Any
) -> Any:
    return mavlink.MAVLink_odometry_message(
        int(stamp * 1e6), 1, 1, *p, list(q), *v, 0.1, 0.2, 0.3, NOTHING, NOTHING, **more
    )


def test_odometry_becomes_enu_and_flu_with_its_velocity_in_the_local_frame() -> None:
    telemetry = Telemetry()
    # nose east, moving north: were the velocity in the body, it would come out as east
    telemetry.take(_odometry(5.0, q=(S, 0.0, 0.0, S)), 100.0)
    state = telemetry.state
    assert state.p == (2.0, 1.0, 3.0)
    assert state.v == pytest.approx((0.0, 0.5, 0.0))
    assert state.q == pytest.approx((1.0, 0.0, 0.0, 0.0))
    assert state.w == pytest.approx((0.1, -0.2, -0.3))
    assert state.stamp == 5.0


def test_velocity_of_odometry_in_the_body_is_found_out_by_local_position() -> None:
    telemetry = Telemetry()
    for k in range(40):
        t = 5.0 + 0.01 * k
        telemetry.take(
            mavlink.MAVLink_local_position_ned_message(int(t * 1e3), 0, 0, 0, 0, 2.0, 0), 100 + 0.01 * k
        )
        telemetry.take(_odometry(t, v=(2.0, 0.0, 0.0), q=(S, 0.0, 0.0, S)), 100 + 0.01 * k)
    assert telemetry.state.v == pytest.approx((2.0, 0.0, 0.0))  # east, as LOCAL_POSITION_NED says


def test_without_odometry_the_position_is_carried_forward_to_the_attitudes_time_unless_it_is_old() -> None:
    telemetry = Telemetry()
    telemetry.take(mavlink.MAVLink_local_position_ned_message(5000, 1.0, 0.0, -1.0, 2.0, 0.0, 0.0), 100.0)
    telemetry.take(mavlink.MAVLink_attitude_quaternion_message(5050, *NORTH_UP, 0.1, 0.0, 0.0), 100.05)
    assert telemetry.state.p == pytest.approx((0.0, 1.1, 1.0))
    assert telemetry.state.stamp == pytest.approx(5.05)
    telemetry.take(mavlink.MAVLink_attitude_quaternion_message(5300, *NORTH_UP, 0.1, 0.0, 0.0), 100.3)
    assert telemetry.state.stamp == pytest.approx(5.05)


@pytest.mark.parametrize(
    "bad",
    [
        {"p": (nan, 0.0, 0.0)},
        {"v": (0.0, float("inf"), 0.0)},
        {"q": (nan, 0.0, 0.0, 0.0)},
        {"q": (2.0, 0.0, 0.0, 0.0)},
    ],
)
def test_a_state_that_cannot_be_is_not_taken(bad: dict[str, Any]) -> None:
    telemetry = Telemetry()
    telemetry.take(_odometry(5.0), 100.0)
    telemetry.take(_odometry(5.01, **bad), 100.01)
    assert telemetry.state.stamp == 5.0


@pytest.mark.parametrize("stamps", [(5.0, 5.02, 5.01, 5.02), (5.0, 9000.0, 5.02)])
def test_late_and_repeated_states_and_those_of_the_future_are_not_taken(stamps: tuple[float, ...]) -> None:
    telemetry = Telemetry()
    for k, stamp in enumerate(stamps):
        telemetry.take(_odometry(stamp, p=(stamp, 0.0, 0.0)), 100.0 + 0.01 * k)
    assert [state.stamp for state in telemetry.history] == [5.0, 5.02]


def test_a_clock_that_starts_again_is_believed_after_it_said_so_five_times() -> None:
    telemetry = Telemetry()
    telemetry.take(_odometry(500.0), 100.0)
    for k in range(8):
        telemetry.take(_odometry(1.0 + 0.01 * k), 100.01 + 0.01 * k)
        assert (telemetry.state.stamp < 2.0) == (k >= 4)
    assert telemetry.state.time == pytest.approx(100.08, abs=0.02)


def test_motor_commands_come_from_pulse_widths_or_shares() -> None:
    telemetry = Telemetry()
    telemetry.take(mavlink.MAVLink_servo_output_raw_message(0, 0, 1500, 2000, 1000, 900, 0, 0, 0, 0), 1.0)
    assert telemetry.status.motors[:4] == pytest.approx((0.5, 1.0, 0.0, 0.0))
    telemetry.take(mavlink.MAVLink_actuator_output_status_message(0, 4, [0.25, 0.5] + [0.0] * 30), 1.0)
    assert telemetry.status.motors[:2] == (0.25, 0.5)


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


def test_a_flight_on_a_clock_that_drifts_reads_the_true_age_and_goes_to_its_end() -> None:
    speed = 0.98
    world = World(
        path=PathPoints(shapes.hover(duration=3.0)), speed=speed, down=delayed(0.002, 0.006, seed=1)
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
