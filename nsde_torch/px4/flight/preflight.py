"""What must be right before anything is armed; each fault with its reason and remedy."""

from __future__ import annotations

from math import hypot, isfinite

from nsde_torch.px4.flight import failsafe
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.options import FlightOptions
from nsde_torch.px4.flight.safety import MARGIN, Limits, contradicted
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.telemetry import Status, VehicleState
from nsde_torch.px4.link.vectors import length, tilt_of

PARAMETERS = ("MPC_THR_HOVER", *failsafe.PARAMETERS)  # parameters that are asked for
FEWEST = 70.0  # states in a second with which a flight may begin; more are asked for, and some get lost
CLIMB_TIME = 0.55
"""How far a climb rises past its end, as a time at its speed [s]; simulated: 0.2 m at 0.8 m/s, 0.6 at 1.5, 1.5 at 3."""
ROUNDED = 1e-3  # what is said of heights is rounded to this, and what follows it is not refused [m]
SETTLED = 0.5
"""Share of `limits.innovation` above which a flight does not begin; PX4 arms up to ratios of 0.5 (COM_ARM_EKF_*)."""
MOVES = 0.5  # speed from which on a vehicle does not stand [m/s]; an estimate that settles is slower
_LANDED = {
    d.ON_GROUND: "says that it is on the ground, but moves",
    d.IN_AIR: "says that it is in the air",
    d.TAKING_OFF: "says that it takes off",
    d.LANDING: "says that it is landing",
}
"""What EXTENDED_SYS_STATE says of a vehicle that may be flying."""


def faults(
    endpoint: Endpoint,
    status: Status,
    state: VehicleState | None,
    path: PathPoints,
    limits: Limits,
    *,
    options: FlightOptions,
    now: float,
) -> list[str]:
    """Reasons not to fly a path from the place of take-off, at a time of our clock [s]; empty: none."""
    out = []
    if state is None:
        return ["no state: neither ODOMETRY nor ATTITUDE_QUATERNION with LOCAL_POSITION_NED"]
    age, late, rate = now - state.time, endpoint.telemetry.sync.late, endpoint.telemetry.rate
    if age > limits.estimate:
        out.append(f"the newest state is {age:.2f} s old")
    # the age of states is then a guess from below, and a late line looks like a quick one
    if late is not None:
        out.append(f"TIMESYNC is answered after {late:.1f} s: a faster link is needed")
    if rate < FEWEST:
        out.append(f"states come at {rate:.0f} Hz, less than {FEWEST:.0f}: a faster link is needed")
    out += _not_to_take_over(status, state, limits) if options.takeover else _not_at_rest(status, state)
    if tilt_of(state.q) > 12.0:
        out.append(f"it stands tilted by {tilt_of(state.q):.0f} deg")
    if length(state.v) > MOVES or length(state.w) > 0.5:
        out.append(f"it moves: {length(state.v):.1f} m/s, {length(state.w):.1f} rad/s")
    if isfinite(status.remaining) and status.remaining < limits.battery + 0.1:
        out.append(f"battery at {100 * status.remaining:.0f} %: charge it")
    if limits.voltage > 0 and isfinite(status.voltage) and status.voltage < limits.voltage:
        out.append(f"battery at {status.voltage:.1f} V: charge it")
    if against := contradicted(status.quality, limits, now, part=SETTLED):
        out.append(f"{against}: wait until it has settled, with a clear view of the sky")
    out += failsafe.faults(status.parameters)
    out += _outside(path, limits, options)
    return out


def _not_at_rest(status: Status, state: VehicleState) -> list[str]:
    """Armed or in the air; only what says that it stands, and does not move, may be disarmed by hand."""
    stands = status.landed == d.ON_GROUND and length(state.v) <= MOVES
    if status.armed and stands:
        return ["the vehicle is armed already, on the ground: disarm it"]
    where = _LANDED.get(status.landed, "does not say whether it is on the ground")
    if status.armed:
        return [
            f"the vehicle is armed already and {where}: it may be flying, so do not disarm it. Take it over with the "
            "sticks, land it (nsde land), or fly it from HOLD (takeover=true)"
        ]
    if status.landed in _LANDED and status.landed != d.ON_GROUND:
        return [f"the vehicle is disarmed and {where}: wait until it says that it is on the ground"]
    return []


def _not_to_take_over(status: Status, state: VehicleState, limits: Limits) -> list[str]:
    """Why a vehicle may not be taken over: it must fly, belong to nobody, and be inside the fence."""
    if not status.armed or status.landed == d.ON_GROUND:
        return ["takeover=true is for a vehicle in the air, and this one is not: fly without it"]
    out = []
    if status.mode != d.HOLD:
        out.append(
            f"the mode is {status.mode}, in which somebody may fly it: choose HOLD, or land it (nsde land)"
        )
    if status.home is None:
        out.append(
            "PX4 does not tell where it took off (HOME_POSITION), and fence and reference count from there: land it "
            "(nsde land)"
        )
    elif limits.outside(state.p, status.home):
        out.append("it is outside the fence: a larger one (limits.fence), or land it (nsde land)")
    return out


def climb_room(options: FlightOptions) -> float:
    """Height below the fence's top at which a climb must end, because it rises past its end [m]."""
    return max(CLIMB_TIME * options.climb, MARGIN)


def _outside(path: PathPoints, limits: Limits, options: FlightOptions) -> list[str]:
    out = []
    for axis, low, high, (from_, to) in zip("xyz", path.low, path.high, limits.fence, strict=True):
        if low < from_ or high > to:
            out.append(
                f"the reference leaves the fence: {axis} from {low:.1f} to {high:.1f} m, fence {from_:g} to {to:g}"
            )
    floor, top = limits.fence[2]
    high, room = path.high[2], climb_room(options)
    if top - MARGIN + ROUNDED < high <= top:
        out.append(
            f"the reference goes up to {high:.4g} m, and the fence's top is at {top:g} m: no flight is that exact. "
            f"Keep {MARGIN:g} m: a reference up to {top - MARGIN:.4g} m, or a fence (limits.fence) up to "
            f"{high + MARGIN:.4g} m"
        )
    if options.takeover:
        return out
    if options.height < floor:
        out.append(f"the height of take-off, {options.height:g} m, is below the fence")
    if options.height > top - room + ROUNDED:
        out.append(
            f"the height of take-off is {options.height:g} m, and the fence's top is at {top:g} m: a climb at "
            f"{options.climb:g} m/s rises past its end. Keep {room:.2g} m: a take-off (height) to {top - room:.4g} m "
            f"at most, a slower climb, or a fence (limits.fence) up to {options.height + room:.4g} m"
        )
    return out


def warnings(endpoint: Endpoint, status: Status, path: PathPoints, limits: Limits) -> list[str]:
    """What is not right and does not forbid to fly."""
    out = [f"{name} was not answered" for name in PARAMETERS if name not in status.parameters]
    top = limits.fence[2][1]
    reach = hypot(*(max(-low, high) for low, high in limits.fence[:2]))
    out += failsafe.warnings(status.parameters, path.speed, top=top, reach=reach, receiver=status.receiver)
    if not isfinite(status.remaining):
        out.append("the battery's charge is unknown: nothing will end the flight when it is empty")
    if endpoint.telemetry.sync.round_trip is None:
        out.append("TIMESYNC is not answered: the age of states is a guess from below")
    if status.quality is None:
        out.append("ESTIMATOR_STATUS is not sent: an estimate that its sensors contradict goes unnoticed")
    if not status.motors:
        out.append("the motors' commands are not sent: the log has no inputs")
    return out
