"""Injected faults: each ends in its safe action, none in a crash, a hang or a stale stream."""

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any

import pytest

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from nsde_torch.px4.flight.controller import Asked, Demand, DemandPlan, Inline, Runner
from nsde_torch.px4.flight.flying import Recorder
from nsde_torch.px4.flight.safety import Limits, Phase
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.dialect import mavlink
from nsde_torch.px4.options import FlightOptions
from tests.helpers.fuzzed import hostile
from tests.helpers.px4_world import (
    TICK,
    Line,
    World,
    corrupted,
    delayed,
    doubled,
    false_mode,
    false_state,
    lossy,
    straight,
    stranger,
    under_way,
)

SHORT = PathPoints(shapes.hover(duration=2.5, height=1.0))
LONG = PathPoints(shapes.hover(duration=5.0, height=1.0))
KEY = bytes(range(32))


def _cut(world: World) -> None:
    world.down = world.up = lambda data, now: []


def _slow(*phases: Phase) -> list[Any]:
    return [pytest.param(phase, marks=pytest.mark.slow) for phase in phases]


@pytest.mark.parametrize(
    "phase", [Phase.STREAM, Phase.TAKEOFF, Phase.TRACK, Phase.LAND, *_slow(Phase.ARM, Phase.RETURN)]
)
def test_a_link_cut_in_any_phase_ends_on_the_ground_by_the_autopilots_own_failsafe(phase: Phase) -> None:
    world = under_way(phase, 0.0 if phase is Phase.ARM else 0.3, path=SHORT)
    cut = world.now
    _cut(world)
    world.run()
    assert world.safe, world.says
    assert max(world.setpoints, default=0.0) < cut + 2.5
    assert not world.flight.outcome.tracked or phase in (Phase.RETURN, Phase.LAND)


@pytest.mark.parametrize(("seconds", "flown"), [(0.12, True), (3.0, False)])
def test_a_short_gap_of_the_link_is_flown_through_and_a_long_one_does_not_bring_the_stream_back(
    seconds: float, flown: bool
) -> None:
    world = under_way(Phase.TRACK, 1.0, path=SHORT)
    cut = world.now
    _cut(world)

    def mend(world: World) -> None:
        if world.now > cut + seconds:
            world.down = world.up = straight

    world.run(mend)
    assert world.safe
    assert world.flight.outcome.tracked == flown, world.says
    if not flown:
        assert max(world.setpoints) < cut + 2.0
        assert world.vehicle.mode == d.LAND


HARM: dict[str, tuple[Callable[[World], None], str, str]] = {
    "nothing arrives": (lambda w: setattr(w, "up", lambda data, now: []), "mode", ""),
    "nothing comes": (lambda w: setattr(w, "down", lambda data, now: []), "estimate", ""),
    "no estimate": (lambda w: setattr(w.vehicle, "blind", True), "estimate", "the newest state is"),
    "disarmed": (lambda w: setattr(w.vehicle, "armed", False), "disarmed", "it is disarmed"),
    "a leap": (
        lambda w: setattr(w.body, "p", (w.body.p[0] + 1.5, *w.body.p[1:])),
        "jump",
        "the position jumped",
    ),
    "a push": (
        lambda w: setattr(w.body, "v", (w.body.v[0] + 2.5, *w.body.v[1:])),
        "jump",
        "the velocity jumped",
    ),
}


@pytest.mark.parametrize("what", HARM)
def test_a_cut_way_a_lost_or_leaping_estimate_and_a_disarmed_vehicle_end_the_flight(what: str) -> None:
    harm, kind, said = HARM[what]
    world = under_way(Phase.TRACK, 1.0, path=SHORT)
    harm(world)
    world.run()
    assert world.trouble.kind == kind
    assert said in world.trouble.text
    assert ("safe hold" in world.phases) == (kind == "jump")
    assert world.safe
    if what.startswith("nothing"):
        assert world.vehicle.mode == d.LAND  # PX4's failsafe, which is not fought


@pytest.mark.parametrize("mode", [d.POSITION, d.RETURN, d.LAND])
def test_the_operators_mode_is_never_fought(mode: d.Mode) -> None:
    world = under_way(Phase.TRACK, 1.0, path=SHORT)
    chosen = world.now
    world.vehicle.set_mode(mode)
    for _ in range(200):
        world.tick()
    assert world.phase in (Phase.WATCH, Phase.DONE)
    assert max(world.setpoints) < chosen + 0.3  # a heartbeat that is asked for later at most
    assert world.vehicle.mode == mode


_OTHERS = {
    "position": mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0x0DF8, 1.5, 0, -1, *[0] * 8
    ),
    "rates": mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 128, [1, 0, 0, 0], 0.4, 0.0, 0.0, 0.5),
}
"""Setpoints of a ground station that does not know of us."""


@pytest.mark.parametrize(("by", "said"), [("position", "a position"), ("rates", "rates of (0.40,")])
def test_setpoints_of_another_client_are_noticed_and_landed_on(by: str, said: str) -> None:
    """PX4 obeys both in turn: it went 77 cm beside the reference, and the flight ended as a good one."""
    other = stranger(system=255)
    begun = inf

    def speak(world: World) -> None:
        nonlocal begun
        if world.phase is Phase.TRACK and world.flight._elapsed > 1.0:
            begun = min(begun, world.now)
        if begun < world.now < begun + 6.0 and round(100 * world.now) % 5 == 0:
            # behind ours in the same tick: it is obeyed until the next
            world._queue(world._to_vehicle, [(world.now, other.pack(_OTHERS[by]))])

    def rates_are_not_told(data: bytes, now: float) -> list[tuple[float, bytes]]:
        told = int.from_bytes(data[7:10], "little") == mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET
        return [] if told else [(now, data)]

    path = PathPoints(shapes.hover(duration=4.0, height=1.0))
    world = World(path=path, down=rates_are_not_told if by == "position" else straight).run(speak)
    world.ended("setpoints", f"PX4 follows {said}")
    assert max(world.setpoints) < begun + 1.5
    assert max(world.errors) < 0.3
    assert world.vehicle.mode == d.LAND
    assert world.safe


@pytest.mark.parametrize(
    ("kind", "limits"),
    [
        ("fence", Limits(fence=((-6.0, 6.0), (-0.2, 0.2), (-0.5, 6.0)))),
        ("speed", Limits(speed=2.0)),
        ("tilt", Limits(tilt=20.0)),
        ("battery", Limits(battery=0.5)),
    ],
)
def test_limits_hold_and_land(kind: str, limits: Limits) -> None:
    path = PathPoints(
        shapes.hover(duration=3.0, height=1.0)
        if kind in ("fence", "battery")
        else shapes.circle(duration=8.0, ramp=3.0)
    )

    def harm(world: World) -> None:
        if world.phase is Phase.TRACK and kind == "battery":
            world.body.used = 0.6
        if world.phase is Phase.TRACK and kind == "fence" and world.flight._elapsed > 0.5:
            world.body._push = (0.0, 4.0, 0.0)

    world = World(path=path, limits=limits).run(harm)
    assert world.trouble.kind == kind
    assert ("safe hold" in world.phases) == (kind != "battery")
    assert world.safe


def _changed(path: PathPoints, how: Callable[[DemandPlan, float], DemandPlan]) -> Inline:
    """A good controller of a path whose plans are changed, by the time in the reference."""
    good = CascadeController(path)
    return Inline(lambda row, time, t, asked=(): how(good(row, time, t), t))


def _crash(plan: DemandPlan) -> DemandPlan:
    raise ZeroDivisionError("no plan")


NAN = float("nan")
BROKEN: dict[str, Callable[[DemandPlan], DemandPlan]] = {
    "raises": _crash,
    "not finite thrust": lambda p: DemandPlan(p.time, p.dt, (Demand((0.0, 0.0, 0.0), NAN),)),
    "says that it failed": lambda p: DemandPlan(p.time, p.dt, p.demands, "failed"),
    "old plans": lambda p: DemandPlan(p.time - 1.0, p.dt, p.demands),
    "empty plans": lambda p: DemandPlan(p.time, p.dt, ()),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_controller_that_breaks_is_replaced_by_holding_and_landing(how: str) -> None:
    breaks = BROKEN[how]
    world = World(path=LONG, runner=_changed(LONG, lambda plan, t: breaks(plan) if t > 1.0 else plan)).run()
    assert world.trouble.kind == "solver"
    assert "safe hold" in world.phases
    assert world.safe
    assert world.highest < 2.2


TIPS: dict[str, tuple[Callable[[float], bool], bool]] = {
    "once, for as long as three plans": (lambda t: 1.0 <= t < 1.03, True),
    "again and again": (lambda t: t % 0.2 < 0.01, False),
}
"""Plans that are made anew because they tilted too far, by the time in the reference, and whether that is flown on."""


@pytest.mark.parametrize("when", TIPS)
def test_plans_that_tip_again_and_again_end_the_flight_and_a_few_do_not(when: str) -> None:
    tips, flown_on = TIPS[when]
    runner = _changed(SHORT, lambda p, t: replace(p, status="converged:tipped" if tips(t) else "converged"))
    world = World(path=SHORT, runner=runner).run()
    assert world.safe
    assert world.flight.outcome.landed
    assert world.flight.outcome.tracked == flown_on
    if not flown_on:
        world.ended("tipped", "4 plans within 5 s tilted beyond 65 deg")
        assert "safe hold" in world.phases


@pytest.mark.parametrize(
    ("off", "lasts", "flown_on"), [(0.4, 9.0, True), (1.2, 0.4, True), (0.9, 9.0, False)]
)
def test_a_reference_that_is_not_followed_ends_the_flight_if_that_lasts(
    off: float, lasts: float, flown_on: bool
) -> None:
    """A controller that flies beside the reference, as one with another machine's model does."""
    path = PathPoints(shapes.hover(duration=4.0, height=1.0))
    good = CascadeController(path)

    def beside(row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> DemandPlan:
        return good((row[0] - (off if 1.0 < t < 1.0 + lasts else 0.0), *row[1:]), time, t)

    world = World(path=path, runner=Inline(beside)).run()
    assert world.safe
    assert world.flight.outcome.landed
    assert world.flight.outcome.tracked == flown_on, world.says
    if not flown_on:
        world.ended("tracking", "more than 0.6 m from the reference for 0.5 s")
        assert "safe hold" in world.phases
        assert max(world.errors) < 1.0


class _Dead(Runner):
    """A process that is killed, or hangs for a while."""

    def __init__(self, path: PathPoints, *, killed: bool, after: float = 1.0, hangs: float = 99.0) -> None:
        self._inner, self._killed = Inline(CascadeController(path)), killed
        self._after, self._back = after, after + hangs
        self.ready = True

    def offer(self, row: tuple[float, ...], time: float, t: float, asked: Asked = ()) -> None:
        if t < self._after or (not self._killed and t > self._back):
            self._inner.offer(row, time, t)
            self.plan = self._inner.plan
        elif self._killed:
            self.fault = "the controller's process is gone"


@pytest.mark.parametrize("killed", [True, False])
def test_a_solver_that_is_killed_or_hangs_ends_in_a_landing(killed: bool) -> None:
    world = World(path=LONG, runner=_Dead(LONG, killed=killed)).run()
    assert world.trouble.kind == "solver"
    said = "process is gone" if killed else "plans were older than 0.3 s for 3.0 s in all"
    assert said in world.trouble.text
    assert not world.flight.outcome.tracked
    assert world.safe
    assert world.highest < 2.3


def test_while_plans_are_late_the_built_in_cascade_flies_the_reference() -> None:
    """On a lemniscate at up to 2 m/s: the last plan alone, or holding, would leave it far behind."""
    path = PathPoints(shapes.lemniscate(duration=12.0, speed=2.0))
    world = World(path=path, runner=_Dead(path, killed=False, after=5.0, hangs=2.5)).run()
    assert world.flown, world.says
    assert max(world.errors) < 0.35
    assert sum("plans are late" in line for line in world.says) == 1
    assert world.flight.outcome.without_plans == pytest.approx(2.2, abs=0.05)


@pytest.mark.parametrize(
    ("phase", "times"),
    [
        *((Phase.PREFLIGHT, 1), (Phase.STREAM, 1), (Phase.ARM, 1), (Phase.TAKEOFF, 1)),
        *((Phase.HOLD, 1), (Phase.TRACK, 1), (Phase.TRACK, 2)),
    ],
)
def test_asked_to_stop_it_lands_whenever_that_is(phase: Phase, times: int) -> None:
    world = under_way(phase, 0.2 if phase is not Phase.ARM else 0.0, path=SHORT)
    for _ in range(times):
        world.flight.stop()
    world.run()
    assert world.safe
    assert not world.flight.outcome.tracked
    assert ("safe hold" in world.phases) == (times == 1 and phase in (Phase.HOLD, Phase.TRACK))


@pytest.mark.parametrize("by", [100.0, -5.0, pytest.param(0.3, marks=pytest.mark.slow)])
def test_a_jump_of_the_autopilots_clock_ends_well(by: float) -> None:
    world = under_way(Phase.TRACK, 1.0, path=SHORT)
    world.vehicle.clock_error = by
    world.run()
    assert world.safe, world.says
    assert world.highest < 2.2


@pytest.mark.parametrize(
    ("line", "flown"),
    [
        (doubled(0.05), True), (delayed(0.0, 0.015, seed=1), True), (corrupted(0.1, seed=2), True),
        (lossy(0.2, seed=3), True), (delayed(0.4, 0.45), False),
    ],
)  # fmt: skip
def test_a_bad_line_is_flown_through_or_landed_on(line: Line, flown: bool) -> None:
    world = World(path=SHORT, down=line, up=line) if flown else under_way(Phase.TRACK, 1.0, path=SHORT)
    world.down = world.up = line
    world.run()
    assert world.safe, world.says
    assert world.flight.outcome.tracked == flown, world.says


@pytest.mark.parametrize(
    ("line", "said"),
    [(delayed(0.5, 0.51), "TIMESYNC is answered after 1."), (lossy(0.7, seed=3), "Hz, less than 70")],
)
def test_a_line_that_is_too_slow_or_loses_too_much_is_refused_before_arming(line: Line, said: str) -> None:
    world = World(path=SHORT, down=line, up=line, options=FlightOptions(checks=2.0)).run()
    assert said in world.trouble.text
    assert not world.setpoints


def test_with_signing_on_unsigned_and_wrongly_signed_messages_are_dropped() -> None:
    others = [stranger(system=1, key=key) for key in (None, bytes(32))]

    def attack(world: World) -> None:
        for other in others:
            world.inject(false_mode(other) + false_state(other, world.now - 990.0))

    world = World(path=SHORT, key=KEY, vehicle_key=KEY).run(attack)
    assert world.flown, world.says


def test_a_vehicle_without_our_key_is_not_flown() -> None:
    world = World(path=SHORT, key=KEY, vehicle_key=None).run()
    assert "not signed with our key" in world.trouble.text
    assert not world.setpoints


def _stopped(world: World, seconds: float) -> None:
    """The vehicle goes on, and nothing of ours does, as after SIGSTOP."""
    for _ in range(round(seconds / TICK)):
        world.vehicle_alone()
        world.now += TICK


def test_a_dead_link_is_called_dead_after_ten_seconds_and_no_longer_waited_on() -> None:
    world = under_way(Phase.TRACK, 1.0, path=LONG)
    cut = world.now
    _cut(world)
    while not world.flight.done:
        world.tick()
    assert world.now - cut < 12.0
    assert not world.flight.outcome.landed
    assert "the link is dead" in world.flight.outcome.actions[-1][2]
    world.run()
    assert world.safe


def test_a_stop_of_four_seconds_is_a_gap_and_does_not_bring_px4_back_to_our_setpoints() -> None:
    world = under_way(Phase.TRACK, 1.0, path=LONG)
    recorder = Recorder(world.flight, None)
    recorder.look(world.now)
    _stopped(world, 4.0)
    assert world.vehicle.mode == d.LAND  # its failsafe
    resumed, before = world.now, len(world.setpoints)
    world.run(lambda w: recorder.look(w.now))
    recorder.look(world.now)
    report = recorder.finish()
    assert len(world.setpoints) == before
    assert max(report.gaps) == pytest.approx(4.0, abs=0.05)
    world.ended("late", "stood still for 4.0")
    assert world.safe
    assert world.now > resumed


@pytest.mark.parametrize(("seconds", "flown"), [(0.45, True), (0.7, False)])
def test_a_stop_shorter_than_px4_waits_is_flown_through_and_a_longer_one_ends_in_silence(
    seconds: float, flown: bool
) -> None:
    """What came meanwhile is heard first, and our own limit is longer than PX4 waits here."""
    world = under_way(Phase.TRACK, 1.0, path=LONG, parameters={"COM_OF_LOSS_T": 0.5})
    _stopped(world, seconds)
    before = len(world.setpoints)
    world.run()
    assert world.safe
    assert world.flown == flown, world.says
    if not flown:
        assert len(world.setpoints) == before
        assert world.trouble.kind == "late"


def test_a_flight_goes_on_through_hostile_bytes_as_if_there_were_none() -> None:
    calm, world = under_way(Phase.TRACK, path=SHORT).run(), under_way(Phase.TRACK, path=SHORT)
    source = hostile(seed=1)

    def attack(w: World) -> None:
        if w.phase is Phase.TRACK and w.flight._elapsed < 1.0:
            for _ in range(10):  # 1000 datagrams a second
                w.inject(next(source))

    world.run(attack)
    assert world.flown, world.says
    assert world.setpoints == calm.setpoints
    assert world.rmse == calm.rmse
    counts = world.endpoint.codec.counts
    assert min(counts[k] for k in ("rubbish", "cut", "foreign", "unwanted")) > 0
