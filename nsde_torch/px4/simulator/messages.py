"""What the simulated autopilot tells of itself, by the name of the message."""

from __future__ import annotations

from collections.abc import Callable
from math import nan
from typing import TYPE_CHECKING

from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link import frames
from nsde_torch.px4.link.codec import Message
from nsde_torch.px4.link.dialect import mavlink

if TYPE_CHECKING:
    from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot


def _heartbeat(a: SimulatedAutopilot, now: float) -> Message:
    flags = 1 | (d.ARMED_FLAG if a.armed else 0)
    state = 4 if a.armed else 3
    return mavlink.MAVLink_heartbeat_message(13, d.AUTOPILOT_PX4, flags, a.mode.custom, state, 3)


def _sys_status(a: SimulatedAutopilot, now: float) -> Message:
    left = round(100 * (1.0 - a.body.used))
    return mavlink.MAVLink_sys_status_message(
        0, 0, 0, 0, round(1000 * a.body.voltage), -1, left, 0, 0, 0, 0, 0, 0
    )


def _extended_sys_state(a: SimulatedAutopilot, now: float) -> Message:
    return mavlink.MAVLink_extended_sys_state_message(0, d.ON_GROUND if a.landed else d.IN_AIR)


def _odometry(a: SimulatedAutopilot, now: float) -> Message:
    p, v, q, w = a.estimate
    unknown = [nan] * 21
    return mavlink.MAVLink_odometry_message(
        int(now * 1e6),
        1,
        1,
        *frames.world(p),
        frames.attitude(q),
        *frames.world(v),
        *frames.body(w),
        unknown,
        unknown,
        reset_counter=a.estimator.resets % 256,
    )


def _attitude_quaternion(a: SimulatedAutopilot, now: float) -> Message:
    _, _, q, w = a.estimate
    return mavlink.MAVLink_attitude_quaternion_message(int(now * 1e3), *frames.attitude(q), *frames.body(w))


def _local_position_ned(a: SimulatedAutopilot, now: float) -> Message:
    p, v, _, _ = a.estimate
    return mavlink.MAVLink_local_position_ned_message(int(now * 1e3), *frames.world(p), *frames.world(v))


def _attitude_target(a: SimulatedAutopilot, now: float) -> Message:
    unturned = (1.0, 0.0, 0.0, 0.0)
    return mavlink.MAVLink_attitude_target_message(int(now * 1e3), 0, unturned, *frames.body(a.rates), 0.0)


def _position_target_local_ned(a: SimulatedAutopilot, now: float) -> Message | None:
    """Only where a position was followed since it was told last."""
    to, a.position = a.position, None
    if to is None:
        return None
    still = [0.0] * 6
    return mavlink.MAVLink_position_target_local_ned_message(
        int(now * 1e3), 1, 0, *frames.world(to), *still, 0.0, 0.0
    )


def _estimator_status(a: SimulatedAutopilot, now: float) -> Message:
    e = a.estimator
    ratios = (e.velocity_ratio, e.contradicted, e.contradicted, 0.02, nan, nan)
    return mavlink.MAVLink_estimator_status_message(int(now * 1e6), 0x33F, *ratios, 0.2, 0.2)


def _home_position(a: SimulatedAutopilot, now: float) -> Message | None:
    """Known from the first arming on."""
    if a.home is None:
        return None
    return mavlink.MAVLink_home_position_message(
        0, 0, 0, *frames.world(a.home), [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
    )


def _servo_output_raw(a: SimulatedAutopilot, now: float) -> Message:
    pulses = [round(1000 + 1000 * u) for u in a.commands]
    pulses += [0] * (8 - len(pulses))
    return mavlink.MAVLink_servo_output_raw_message(int(now * 1e6) & 0xFFFFFFFF, 0, *pulses)


def _actuator_output_status(a: SimulatedAutopilot, now: float) -> Message:
    row = [*a.commands, *([0.0] * (32 - len(a.commands)))]
    return mavlink.MAVLink_actuator_output_status_message(int(now * 1e6), a.body.nu, row)


MESSAGES: dict[str, Callable[[SimulatedAutopilot, float], Message | None]] = {
    "HEARTBEAT": _heartbeat,
    "HOME_POSITION": _home_position,
    "SYS_STATUS": _sys_status,
    "ESTIMATOR_STATUS": _estimator_status,
    "EXTENDED_SYS_STATE": _extended_sys_state,
    "ODOMETRY": _odometry,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "ATTITUDE_TARGET": _attitude_target,
    "LOCAL_POSITION_NED": _local_position_ned,
    "POSITION_TARGET_LOCAL_NED": _position_target_local_ned,
    "SERVO_OUTPUT_RAW": _servo_output_raw,
    "ACTUATOR_OUTPUT_STATUS": _actuator_output_status,
}
"""Name -> function of the autopilot and the time that it stamps [s]."""


ESTIMATOR = 0.008
"""Step at which the estimator publishes [s]."""
_ESTIMATED = frozenset(("ODOMETRY", "LOCAL_POSITION_NED"))


def is_due(name: str, due: float, now: float) -> bool:
    """Whether a message goes out now; one of the estimate waits for a new one."""
    late = now % ESTIMATOR
    new = name not in _ESTIMATED or min(late, ESTIMATOR - late) < 1e-6
    return new and now >= due - 1e-6


def due_next(name: str, due: float, interval: float, now: float) -> float:
    """When a message that goes out now is due again [s].

    An estimate is sent as often as it was asked for, at 100 Hz three after 8 ms each and one after 16. Of the others
    100 Hz come as 99.
    """
    if name in _ESTIMATED:
        return max(due + interval, now - interval)
    return max(due + interval * 100.0 / 99.0, now)


def texts(severity: int, text: str, number: int) -> list[Message]:
    """A text in pieces of fifty characters; one that has several bears its number."""
    data = text.encode()
    pieces = [data[k : k + 50] for k in range(0, len(data), 50)]
    return [
        mavlink.MAVLink_statustext_message(severity, piece, id=number if len(pieces) > 1 else 0, chunk_seq=k)
        for k, piece in enumerate(pieces)
    ]
