"""PX4 flight logs (ULog) through pyulog: one log is one run, NED/FRD converted, all topics on one clock.

State from `vehicle_odometry`, or from `vehicle_attitude` + `vehicle_local_position` +
`vehicle_angular_velocity`; inputs from `actuator_motors`, else `actuator_outputs`; `battery_status` becomes
the channel `battery_voltage`; sticks and setpoints become further columns. The rows are
those of the attitude; slower topics are interpolated (motor commands held). Where a topic pauses, is not
finite, the vehicle is on the ground or its estimate was just reset, the row counts as missing and the
checks cut the run there.

Field meanings: PX4 message definitions (`msg/VehicleOdometry.msg` and so on, PX4 1.13 to 1.16). The velocity
frame of `vehicle_odometry` is read from its own field, never assumed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.arrays import Array, Mask
from nsde_torch.data.places import files_of, log_place
from nsde_torch.data.quaternion import attitude_to_enu, euler_zyx, rotate, swap_body, swap_world
from nsde_torch.data.raw import Finding, RawRun, holes
from nsde_torch.data.streams import Stream, StreamLog, attitudes, held, linear, ordered, parsing
from nsde_torch.data.system_info import SystemInfo, rate_columns
from nsde_torch.errors import ConfigError, DataError

# Which rows of a PX4 log are flight, and which steps of its estimate are no motion.
#
# On the ground: `landed`, `ground_contact` or `maybe_landed` of `vehicle_land_detected`, and the rows next to
# them that are less than 10 cm above where it stood then: PX4 says `landed` seconds after it stands, and no
# longer as soon as it is commanded to climb. With such rows in it a log says that thrust lifts nothing.
#
# Resets: where a counter of the estimate grew (`reset_counter` of `vehicle_odometry`, `quat_reset_counter`,
# ...) heading, position or velocity made a step. Field meanings: PX4 message definitions, 1.13 to 1.16.

_FLAGS = ("landed", "maybe_landed", "ground_contact")
_CLEAR = 0.1  # height above where it stood, up to which a row next to time on the ground is on the ground [m]
_NEXT_TO = 4.0  # how long before and after time on the ground such rows are looked for [s]
_SAME_PLACE = 1.0
"""Difference of height up to which it landed where it took off, so that an estimate that sinks is seen [m]."""
_EDGE = 0.3  # time at the edge of time on the ground over which the height is taken [s]
_CUT = 0.05  # time after a reset that is left out, so that the run is cut there [s]
_COUNTERS = ("", "quat_", "xy_", "z_", "vxy_", "vz_", "heading_")  # of resets, before `reset_counter`


def _on_ground(landed: Stream, t: Array, height: Array) -> Mask:
    """Rows, at times `t` [s] and heights [m], that are on the ground by `vehicle_land_detected`."""
    left = np.clip(np.searchsorted(landed.t, t, side="right") - 1, 0, None)
    flags = np.zeros(len(t), dtype=bool)
    for name in _FLAGS:
        if name in landed.fields:
            flags |= landed.fields[name][left] > 0.5
    out = flags.copy()
    first: float | None = None
    for a, b in holes(flags):
        rows = np.arange(a, b)
        near_a, near_b = t[a:b] < t[a] + _EDGE, t[a:b] >= t[b - 1] - _EDGE
        came, went = _level(height[rows[near_a]]), _level(height[rows[near_b]])
        first = went if first is None else first
        if abs(came - first) < _SAME_PLACE:
            came = max(came, first)
        above = np.flatnonzero(~((t >= t[a] - _NEXT_TO) & (height < came + _CLEAR)))
        out[above[above < a].max(initial=-1) + 1 : a] = True
        above = np.flatnonzero(~((t <= t[b - 1] + _NEXT_TO) & (height < went + _CLEAR)))
        out[b : above[above >= b].min(initial=len(t))] = True
    return out


def _level(height: Array) -> float:
    known = height[np.isfinite(height)]
    return float(np.median(known)) if len(known) else float("-inf")


def _after_resets(sources: Sequence[Stream], t: Array) -> tuple[Mask, int]:
    """Rows right after a reset of the estimate, and how many resets there were, by the topics of the state."""
    out, stamps = np.zeros(len(t), dtype=bool), set[float]()
    for topic in sources:
        for name in (f"{what}reset_counter" for what in _COUNTERS):
            if name in topic.fields:
                stamps |= set(topic.t[1:][np.diff(topic.fields[name]) != 0].tolist())
    for stamp in stamps:
        # a slower topic reports it late: what lies between its two messages is either before or after
        out |= (t > stamp - 1e-9) & (t < stamp + _CUT)
    return out, len(stamps)


# Sticks and setpoints of PX4 logs as further columns: signals that a loop may be moved by from outside.
#
# Sticks are outside the loop while a pilot flies by them; setpoints are in the modes in which no outer loop makes
# them (`nsde train` tests it). Values are held from message to message. Fields: PX4 message definitions, 1.13 to 1.16.

_KNOWN = 0.5  # share of the rows that must have a value
_SETPOINTS: dict[str, dict[str, tuple[float, tuple[str, ...]]]] = {
    "manual_control_setpoint": {  # names of PX4 1.14 and later, and before
        "stick_roll": (1.0, ("roll", "y")), "stick_pitch": (1.0, ("pitch", "x")), "stick_yaw": (1.0, ("yaw", "r")),
        "stick_throttle": (1.0, ("throttle", "z")),
    },
    "vehicle_attitude_setpoint": {"setpoint_thrust": (-1.0, ("thrust_body[2]",))},
    "vehicle_rates_setpoint": {  # [rad/s], in FLU
        "setpoint_rate_x": (1.0, ("roll",)), "setpoint_rate_y": (-1.0, ("pitch",)), "setpoint_rate_z": (-1.0, ("yaw",)),
    },
}  # fmt: skip
"""By topic and column: the sign, and what the field is called."""


def _setpoint_columns(topics: Mapping[str, Sequence[Stream]], t: Array) -> dict[str, Array]:
    """Columns at the times `t` (n,) [s], of the topics that a log has."""
    out: dict[str, Array] = {}
    for topic, columns in _SETPOINTS.items():
        for stream in topics.get(topic, ())[:1]:
            given = _angles(stream)
            for name, (sign, fields) in columns.items():
                field = next((field for field in fields if field in stream.fields), None)
                if field is not None:
                    given[name] = sign * stream.fields[field]
            left = np.searchsorted(stream.t, t, side="right") - 1
            for name, values in given.items():
                held_there = np.where(left >= 0, values[np.clip(left, 0, None)], np.nan)
                if np.isfinite(held_there).mean() >= _KNOWN:
                    out[name] = held_there
    return out


def _angles(stream: Stream) -> dict[str, Array]:
    """Roll, pitch and yaw that an attitude is to have, FLU in ENU [rad]."""
    if "q_d[0]" not in stream.fields:
        return {}
    roll, pitch, yaw = euler_zyx(attitude_to_enu(stream.vector("q_d", 4))).T
    good = np.isfinite(yaw)
    yaw[good] = np.unwrap(yaw[good])
    return {"setpoint_roll": roll, "setpoint_pitch": pitch, "setpoint_yaw": yaw}


STATE_NAMES = ("p_x", "p_y", "p_z", "v_x", "v_y", "v_z", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z")
SOURCES = ("auto", "odometry", "attitude")
_PARTS = ("vehicle_attitude", "vehicle_local_position", "vehicle_angular_velocity")
_TOPICS = (
    "vehicle_odometry", *_PARTS, "actuator_motors", "actuator_outputs", "battery_status", "vehicle_land_detected",
    *_SETPOINTS,
)  # fmt: skip
MIN_RATE = 4.0  # slowest rate of a state or motor topic that is interpolated [Hz]
MOTOR_RATE = 50.0
"""Slowest rate of the motor topic that is read by default [Hz].

Motors answer within 50 ms. PX4's default profile logs them at 10 Hz: held for 100 ms, they gave half of the roll gain.
"""
_HIGH_RATE = "Log more: set bit 4 (high rate) of the parameter SDLOG_PROFILE, `param set SDLOG_PROFILE 17`, and restart"
_MISSING = 0.6  # of a step of the attitude, from which on none is near
_FIRST_MOTOR = 101  # PX4 output function of motor 1; motor k is 100 + k


def _parsed(path: Path, topics: Sequence[str] | None = None) -> Any:
    """A log of these topics, or of all."""
    from pyulog import ULog

    with parsing(path, "ULog file"), path.open("rb") as file:
        return ULog(file, topics and list(topics))


def _fields(topic: Any) -> dict[str, Array]:
    return {name: np.asarray(values, dtype=np.float64) for name, values in topic.data.items()}


def open_ulog(path: Path) -> StreamLog:
    """All topics of one log as streams, to look at; `read_ulog` reads what a multirotor needs by itself."""
    streams = []
    for topic in sorted(_parsed(path).data_list, key=lambda one: (one.name, int(one.multi_id))):
        fields = _fields(topic)
        t = fields.pop("timestamp") * 1e-6
        name = topic.name if not topic.multi_id else f"{topic.name}[{topic.multi_id}]"
        if len(t) > 1:
            streams.append(ordered(Stream(name, t, fields)))
    return StreamLog(path.stem, str(path), streams, {}, {"world": "NED", "body": "FRD"})


def _load(path: Path) -> tuple[Any, dict[str, list[Stream]]]:
    """The log, and its topics of interest by name (several where there are several instances)."""
    log = _parsed(path, _TOPICS)
    topics: dict[str, list[Stream]] = {}
    for data in sorted(log.data_list, key=lambda d: int(d.multi_id)):
        fields = _fields(data)
        sample = fields.get("timestamp_sample")
        t = fields["timestamp"] if sample is None or not (sample > 0).all() else sample
        stream = ordered(Stream(data.name, t * 1e-6, fields))
        if len(stream.t) >= 2:
            topics.setdefault(data.name, []).append(stream)
    return log, topics


def _odometry(topic: Stream, path: Path) -> Array:
    """States (n, 13) in ENU/FLU from `vehicle_odometry`, old fields (to PX4 1.13) or new."""
    f = topic.fields
    if "position[0]" in f:
        p, v, w = (topic.vector(name, 3) for name in ("position", "velocity", "angular_velocity"))
        pose, ned = f["pose_frame"], 1
    else:
        p, v = topic.columns("x", "y", "z"), topic.columns("vx", "vy", "vz")
        w = topic.columns("rollspeed", "pitchspeed", "yawspeed")
        pose, ned = f["local_frame"], 0
    frame, frd, body = f["velocity_frame"], ned + 1, 3
    q = topic.vector("q", 4)
    bad = ~np.isin(pose, (ned, frd))
    if bad.any():
        raise DataError(
            f"{path}: `vehicle_odometry` has the pose frame {int(pose[bad][0])}; expected NED ({ned}) or FRD "
            f"({frd}). Read with `state=attitude`."
        )
    in_body = frame == body
    odd = ~in_body & (frame != pose)
    if odd.any():
        raise DataError(
            f"{path}: `vehicle_odometry` has velocities in frame {int(frame[odd][0])} and poses in frame "
            f"{int(pose[odd][0])}; expected the same frame, or the body frame ({body}). Read with "
            "`state=attitude`."
        )
    v = np.where(in_body[:, None], rotate(q, v), v)
    return np.concatenate([swap_world(p), swap_world(v), attitude_to_enu(q), swap_body(w)], axis=1)


def _state(topics: dict[str, list[Stream]], source: str, path: Path) -> tuple[Array, Array, list[Stream]]:
    """Times, states in ENU/FLU, and the topics that they came from."""
    odometry = topics.get("vehicle_odometry", [None])[0]
    lacking = [name for name in _PARTS if name not in topics]
    parts = [topics[name][0] for name in _PARTS if name in topics]
    if odometry is not None and source != "attitude":
        faster = not lacking and min(part.rate for part in parts) > 1.5 * odometry.rate
        if source == "odometry" or not faster:
            return odometry.t, _odometry(odometry, path), [odometry]
    if source == "odometry" or lacking:
        wanted = ["vehicle_odometry"] if source == "odometry" else lacking
        other = "" if source != "auto" else " (or `vehicle_odometry`)"
        raise DataError(
            f"{path} lacks the topics {wanted}{other}; it has {sorted(topics) or 'none of those needed'}. "
            f"{_HIGH_RATE}, or add them to etc/logging/logger_topics.txt on the SD card."
        )
    attitude, position, rates = parts
    t = _with_missing(attitude, position)
    p = linear(position, position.columns("x", "y", "z"), t)
    v = linear(position, position.columns("vx", "vy", "vz"), t)
    for flag, columns in (("xy_valid", slice(0, 2)), ("z_valid", slice(2, 3))):
        if flag in position.fields:
            p[held(position, position.columns(flag), t)[:, 0] < 0.5, columns] = np.nan
    w = linear(rates, rates.vector("xyz", 3), t)
    q = attitude_to_enu(attitudes(attitude, attitude.vector("q", 4), t))
    return t, np.concatenate([swap_world(p), swap_world(v), q, swap_body(w)], axis=1), parts


def _with_missing(attitude: Stream, position: Stream) -> Array:
    """Times of the attitude, and of positions where an attitude is missing.

    A logger that is late leaves messages out. Without a row at a position's own time, a longer step would have in its
    place the mean of values that are means themselves.
    """
    if not attitude.rate > 0.9 * position.rate:
        return attitude.t
    step, at = 1.0 / attitude.rate, position.t
    after = np.clip(np.searchsorted(attitude.t, at), 1, len(attitude.t) - 1)
    near = np.minimum(np.abs(at - attitude.t[after - 1]), np.abs(attitude.t[after] - at))
    inside = (at > attitude.t[0]) & (at < attitude.t[-1])
    return np.asarray(np.sort(np.concatenate((attitude.t, at[inside & (near > _MISSING * step)]))))


def _output_channels(parameters: dict[str, Any], motors: int) -> tuple[list[int], Array, Array]:
    """Output channels of the motors, and their lowest and highest pulse widths [us], by the parameters."""
    for prefix in ("PWM_MAIN", "PWM_AUX"):
        function = {int(parameters.get(f"{prefix}_FUNC{k + 1}", 0)): k for k in range(16)}
        channels = [function.get(_FIRST_MOTOR + k, -1) for k in range(motors)]
        if min(channels) >= 0:
            low = np.array([float(parameters.get(f"{prefix}_MIN{k + 1}", 1000)) for k in channels])
            high = np.array([float(parameters.get(f"{prefix}_MAX{k + 1}", 2000)) for k in channels])
            return channels, low, high
    ends = [float(parameters.get(name, default)) for name, default in (("PWM_MIN", 1000), ("PWM_MAX", 2000))]
    return list(range(motors)), np.full(motors, ends[0]), np.full(motors, ends[1])


def _motors(log: Any, topics: dict[str, list[Stream]], motors: int, path: Path) -> tuple[Stream, Array]:
    """Motor commands in [0, 1] and the topic that they came from."""
    if "actuator_motors" in topics:
        topic = topics["actuator_motors"][0]
        return topic, topic.vector("control", motors)
    if "actuator_outputs" not in topics:
        raise DataError(
            f"{path} lacks the topics ['actuator_motors'] (or `actuator_outputs`); it has "
            f"{sorted(topics) or 'none of those needed'}. {_HIGH_RATE}."
        )
    channels, low, high = _output_channels(log.initial_parameters, motors)
    # several output drivers may log; the motors are on the one that moves
    outputs = [(t, t.vector("output", max(channels) + 1)[:, channels]) for t in topics["actuator_outputs"]]
    topic, raw = max(outputs, key=lambda pair: float(pair[1].std(axis=0).sum()))
    if raw.max() <= 1.05:
        return topic, raw
    if raw.max() < 800:
        raise DataError(
            f"{path}: `actuator_outputs` of the motors reach {raw.max():.4g}; expected pulse widths in "
            "microseconds or 0 to 1. Log `actuator_motors`."
        )
    share = (raw - low) / (high - low)
    share[raw < 0.95 * low] = np.nan  # disarmed
    return topic, np.clip(share, 0.0, 1.0)


def _read_file(path: Path, system: SystemInfo, *, state: str, in_air: bool, motor_rate: float) -> RawRun:
    if state not in SOURCES:
        raise ConfigError(f"`state` must be one of {', '.join(SOURCES)}; got {state!r}.")
    if tuple(system.state_names) != STATE_NAMES or rate_columns(system) is None:
        raise ConfigError(
            f"PX4 logs hold multirotor states {STATE_NAMES}; the system {system.name!r} has "
            f"{tuple(system.state_names)}. Choose `hexacopter` or `quadrotor`, or write the data as CSV."
        )
    log, topics = _load(path)
    t, x, sources = _state(topics, state, path)
    motor_topic, commands = _motors(log, topics, len(system.input_names), path)
    for topic in sources:
        if topic.rate < MIN_RATE:
            raise DataError(
                f"{path}: the topic `{topic.name}` was logged at {topic.rate:.3g} Hz; at least {MIN_RATE:g} "
                f"Hz are needed. {_HIGH_RATE}."
            )
    if motor_topic.rate < 0.98 * motor_rate:  # stamps are whole microseconds
        raise DataError(
            f"{path}: the motors' topic `{motor_topic.name}` was logged at {motor_topic.rate:.3g} Hz; at least "
            f"{motor_rate:g} Hz are needed, as gains and lags come out wrong of commands that change unseen. "
            f"{_HIGH_RATE}. To read such a log all the same give `motor_rate` to the reader (`nsde_torch.read`)."
        )
    run = RawRun(path.stem, t, x, held(motor_topic, commands, t), source=str(path))
    notes = run.notes.append
    base = sources[0]
    slow = [topic for topic in (*sources[1:], motor_topic) if topic.rate < 0.8 * base.rate]
    if slow:
        rates = ", ".join(f"{topic.name} {topic.rate:.3g} Hz" for topic in slow)
        text = f"topics slower than {base.name} ({base.rate:.3g} Hz): {rates}"
        notes(Finding("slow_topic", run.name, len(slow), text, "interpolated, commands held"))
    run.extra = _setpoint_columns(topics, t)
    if "battery_status" in topics:
        battery = topics["battery_status"][0]
        run.extra = {"battery_voltage": np.interp(t, battery.t, battery.fields["voltage_v"]), **run.extra}
    if in_air and "vehicle_land_detected" in topics:
        ground = _on_ground(topics["vehicle_land_detected"][0], t, x[:, 2])
        if ground.all():
            raise DataError(
                f"{path}: the vehicle is landed throughout. Set `in_air` to false to keep such data."
            )
        if ground.any():
            x[ground] = np.nan
            seconds = float(ground.mean() * (t[-1] - t[0]))
            text = f"{seconds:.3g} s on the ground"
            notes(Finding("on_ground", run.name, int(ground.sum()), text, "dropped"))
    stepped, count = _after_resets(sources, t)
    stepped &= np.isfinite(x).all(axis=1)
    if stepped.any():
        x[stepped] = np.nan
        text = f"the estimate was reset in flight ({count} in all): the run is cut there"
        notes(Finding("estimate_reset", run.name, int(stepped.sum()), text, "dropped"))
    dropouts = log.dropouts
    if dropouts:
        seconds = sum(d.duration for d in dropouts) * 1e-3
        text = f"{len(dropouts)} dropouts of the logger, {seconds:.3g} s in all"
        notes(Finding("logger_dropout", run.name, len(dropouts), text, "reported"))
    if log.file_corruption:
        notes(Finding("damaged_log", run.name, 1, "parts of the log are damaged and were skipped", "dropped"))
    return run


def read_ulog(
    system: SystemInfo,
    *,
    path: str | Path,
    state: str = "auto",
    in_air: bool = True,
    motor_rate: float = MOTOR_RATE,
) -> list[RawRun]:
    """Runs of one PX4 log, or of all `.ulg` files of a folder in the order of their names.

    As many motors are read as the system, a multirotor, has inputs. The `state` is of `odometry`, `attitude` (three
    topics), or `auto`: the odometry unless the others are much faster. `in_air` leaves out the time on the ground,
    where the log has it (`vehicle_land_detected`); `motor_rate` is the slowest of the motors' topic that is read [Hz].
    A DataError where there is nothing to read, a topic is missing or too slow (the message names it and the remedy), or
    frames cannot be converted; a ConfigError where the `state` is unknown, or the system is no multirotor.
    """
    path = log_place(path, "a .ulg file or a folder of them")
    if path.is_dir():
        files = files_of(path, (".ulg",))
        if not files:
            raise DataError(f"`path`: {path} holds no .ulg file.")
    else:
        files = [path]
    return [_read_file(file, system, state=state, in_air=in_air, motor_rate=motor_rate) for file in files]
