"""Resets of the estimate: PX4 makes one of the heading in every flight, and a flight goes on."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import degrees, radians
from pathlib import Path

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.flight_log import FlightLog
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.flight.options import FlightOptions, Limits
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import Phase
from nsde_torch.px4.flight.safety import step_between
from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.px4.link.vectors import from_rotation_vector, yaw_of
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.estimate import SimulatedEstimator
from nsde_torch.recording import read
from nsde_torch.systems import make_system
from tests.helpers.px4_world import World

HOVER = PathPoints(shapes.hover(duration=2.5, height=1.5))


def _state(stamp: float, *, yaw: float = 0.0, resets: int = 0, **more: tuple[float, ...]) -> VehicleState:
    still = VehicleState(
        stamp, stamp, stamp, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.5)
    )
    return replace(still, q=from_rotation_vector((0.0, 0.0, yaw)), resets=resets, **more)  # type: ignore[arg-type]


def test_the_step_is_what_motion_does_not_explain() -> None:
    first = _state(5.0)
    moved = step_between(first, _state(5.1, yaw=0.05, p=(0.1, 0.0, 1.0), v=(1.3, 0.0, 0.0)))
    assert moved is not None
    assert moved.position == pytest.approx(0.0, abs=1e-9)
    assert moved.velocity == 0.0  # three metres a second squared is flying
    assert moved.heading == pytest.approx(0.0, abs=1e-9)
    assert not moved.announced
    reset = step_between(first, _state(5.01, yaw=0.205, p=(0.31, 0.0, 1.0), v=(4.0, 0.0, 0.0), resets=1))
    assert reset is not None
    assert (reset.position, reset.velocity) == pytest.approx((0.3, 2.7))
    assert reset.heading == pytest.approx(0.2)
    assert reset.announced
    assert step_between(first, _state(6.0)) is None  # too far apart to tell
    assert step_between(first, first) is None


def test_the_simulated_heading_is_wrong_below_a_metre_and_a_half_and_is_reset_there_once_in_each_flight() -> (
    None
):
    body = Body("quadrotor", seed=0, process_noise=0.0)
    estimator = SimulatedEstimator(std=(0.0, 0.0, 0.0, 0.0), seed=3)
    sizes = []
    for _ in range(20):
        body.p = (0.0, 0.0, 1.4)
        wrong = yaw_of(estimator.sense(body)[2])
        count = estimator.resets
        body.p = (0.0, 0.0, 1.6)
        assert yaw_of(estimator.sense(body)[2]) == pytest.approx(0.0, abs=1e-9)
        assert estimator.stepped == pytest.approx(-wrong)
        estimator.sense(body)
        assert estimator.resets == count + 1
        assert estimator.stepped == 0.0
        estimator.new_flight()
        sizes.append(abs(degrees(wrong)))
    assert 1.0 <= min(sizes) < 3.0
    assert 7.0 < max(sizes) <= 9.0


@pytest.mark.parametrize("error", [1.0, -8.9])
def test_a_flight_at_default_height_goes_on_over_the_reset_of_the_heading(error: float) -> None:
    world = World(path=HOVER, options=FlightOptions(), heading_error=radians(error))
    yaws: list[tuple[float, float]] = []
    world.run(lambda w: yaws.append((w.body.p[2], degrees(yaw_of(w.body.q)))))
    assert world.flight.outcome.trouble is None, world.says
    assert world.flight.outcome.tracked
    assert world.safe
    ((_, step),) = world.flight.outcome.steps
    assert degrees(step.heading) == pytest.approx(-error, abs=1.0)
    assert step.announced
    assert any("heading" in line for line in world.says)
    # what was held is held as it is: the vehicle does not turn by the step
    held = [yaw for z, yaw in yaws if z > 1.0]
    before = next(yaw for z, yaw in yaws if z > 1.4)
    assert max(abs(yaw - before) for yaw in held[:300]) < 2.0


def test_the_height_of_the_reset_is_climbed_past_before_the_reference() -> None:
    world = World(path=HOVER, options=FlightOptions()).until(Phase.TRACK)
    assert world.highest > 1.7
    assert len(world.flight.outcome.steps) == 1
    low = World(
        path=PathPoints(shapes.hover(duration=1.0, height=1.0)),
        options=FlightOptions(height=1.0),
        limits=Limits(fence=((-6.0, 6.0), (-6.0, 6.0), (-0.5, 1.6))),
    ).until(Phase.TRACK)
    assert low.highest < 1.6  # there is no room, and the fence was kept
    assert low.flight.outcome.trouble is None


@pytest.mark.parametrize(("kind", "by"), [("position", 0.2), ("velocity", 0.8)])
def test_small_resets_of_position_and_velocity_are_noted_and_flown_through(kind: str, by: float) -> None:
    world = World(path=HOVER).until(Phase.TRACK, 0.5)
    if kind == "position":
        world.body.p = (world.body.p[0] + by, *world.body.p[1:])
    else:
        world.body.v = (world.body.v[0] + by, *world.body.v[1:])
    world.vehicle.estimator.resets += 1
    world.run()
    assert world.flight.outcome.tracked, world.says
    step = world.flight.outcome.steps[-1][1]
    assert getattr(step, kind) == pytest.approx(by if kind == "position" else 0.5, abs=0.1)


def test_a_step_of_the_velocity_holds_and_lands_though_nothing_announced_it() -> None:
    world = World(path=HOVER).until(Phase.TRACK, 0.5)
    world.body.v = (world.body.v[0] + 2.5, *world.body.v[1:])
    world.run()
    assert world.flight.outcome.trouble is not None
    assert world.flight.outcome.trouble.kind == "jump"
    assert "velocity" in world.flight.outcome.trouble.text
    assert "safe hold" in world.phases
    assert world.safe


def test_the_log_is_cut_at_a_reset_so_that_no_model_must_explain_it(tmp_path: Path) -> None:
    world = World(path=HOVER, heading_error=radians(8.0))
    with FlightLog(tmp_path / "flight_0.csv", 4) as log:
        recorder = Recorder(world.flight, log)
        world.run(lambda w: recorder.look(w.now))
    run = read("csv", make_system("quadrotor"), path=tmp_path).runs[0]
    assert len(run.segments) == 2
    for a, b in run.segments:
        q = run.x[a:b, 6:10]
        yaw = np.unwrap(
            np.arctan2(2 * (q[:, 0] * q[:, 3] + q[:, 1] * q[:, 2]), 1 - 2 * (q[:, 2:] ** 2).sum(1))
        )
        assert max(abs(d - c) for c, d in pairwise(np.degrees(yaw))) < 2.0
    (noted,) = recorder.finish().as_dict()["estimate_resets"]
    assert noted["heading_deg"] == pytest.approx(-8.0, abs=1.0)
