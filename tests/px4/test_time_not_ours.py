"""Time that is not ours: a dead link, an operator's mode, a process that stood still."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import Point
from nsde_torch.px4.flight.flight_log import FlightLog
from nsde_torch.px4.flight.flying import FlightReport, Recorder
from nsde_torch.px4.flight.path import PathPoints
from nsde_torch.px4.flight.phases import Phase
from nsde_torch.px4.link import dialect as d
from tests.helpers.px4_world import START, World

LONG = PathPoints(shapes.hover(duration=8.0, height=1.0))


def _stopped(world: World, seconds: float) -> None:
    """The vehicle goes on, and nothing of ours does, as after SIGSTOP."""
    for _ in range(round(seconds / 0.01)):
        for data in world._due(world._to_vehicle):
            world.vehicle.receive(data)
        for data in world.vehicle.advance((world.now - START) * world.speed):
            world._queue(world._to_us, world.down(data, world.now))
        world.now += 0.01


def _recorded(world: World, file: Path, until: Phase, then: float) -> tuple[Recorder, FlightLog]:
    log = FlightLog(file, 4)
    recorder = Recorder(world.flight, log)
    while not (world.phase is until and world.flight._elapsed >= then):
        world.tick()
        recorder.look(world.now)
    return recorder, log


def _ended(world: World, recorder: Recorder, log: FlightLog) -> FlightReport:
    world.run(lambda w: recorder.look(w.now))
    recorder.look(world.now)
    with log:
        return recorder.finish()


@pytest.mark.parametrize("phase", [Phase.TRACK, Phase.LAND])
def test_a_dead_link_is_called_dead_after_ten_seconds_and_no_longer_waited_on(phase: Phase) -> None:
    world = World(path=LONG).until(phase, 1.0)
    cut = world.now
    world.down = world.up = lambda data, now: []
    while not world.flight.done:
        world.tick()
    assert world.now - cut < 12.0
    assert not world.flight.outcome.landed
    assert "the link is dead" in world.flight.outcome.actions[-1][2]
    world.run()
    assert world.safe


def test_what_is_flown_in_an_operators_mode_counts_in_no_error_and_is_not_logged(tmp_path: Path) -> None:
    world = World(path=LONG)
    recorder, log = _recorded(world, tmp_path / "flight.csv", Phase.TRACK, 2.0)
    chosen = world.now
    world.vehicle.set_mode(d.HOLD)
    world.vehicle._point = Point((30.0, 0.0, 1.0))  # the operator goes elsewhere
    report = _ended(world, recorder, log)
    assert report.outcome.trouble is not None
    assert report.outcome.trouble.kind == "mode"
    assert max(report.errors) < 0.25
    assert max(world.setpoints) < chosen + 0.25
    rows = np.loadtxt(tmp_path / "flight.csv", delimiter=",", skiprows=1)
    assert np.abs(rows[rows[:, 0] > (chosen - START) * world.speed - 2.0, 4]).max() < 0.3  # v_x
    assert len(report.errors) > 150


def test_a_stop_of_four_seconds_is_a_gap_and_does_not_bring_px4_back_to_our_setpoints(tmp_path: Path) -> None:
    world = World(path=LONG)
    recorder, log = _recorded(world, tmp_path / "flight.csv", Phase.TRACK, 1.0)
    _stopped(world, 4.0)
    assert world.vehicle.mode == d.LAND  # its failsafe
    resumed, before = world.now, len(world.setpoints)
    report = _ended(world, recorder, log)
    assert len(world.setpoints) == before
    assert max(report.gaps) == pytest.approx(4.0, abs=0.05)
    assert report.outcome.trouble is not None
    assert report.outcome.trouble.kind == "late"
    assert "stood still for 4.0" in report.outcome.trouble.text
    assert world.safe
    assert world.now > resumed


@pytest.mark.parametrize("seconds", [0.3, 0.45])
def test_a_short_stop_is_flown_through_once_what_came_meanwhile_is_heard(seconds: float) -> None:
    world = World(path=LONG, parameters={"COM_OF_LOSS_T": 0.5}).until(Phase.TRACK, 1.0)
    _stopped(world, seconds)
    world.run()
    assert world.flight.outcome.trouble is None, world.says
    assert world.flight.outcome.tracked


def test_a_stop_longer_than_px4_waits_ends_in_silence_though_shorter_than_our_own_limit() -> None:
    world = World(path=LONG, parameters={"COM_OF_LOSS_T": 0.5}).until(Phase.TRACK, 1.0)
    _stopped(world, 0.7)
    before = len(world.setpoints)
    world.run()
    assert len(world.setpoints) == before
    assert world.flight.outcome.trouble is not None
    assert world.flight.outcome.trouble.kind == "late"
    assert world.safe
