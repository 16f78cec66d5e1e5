"""What the columns of a log are likely to mean to a system: by what the format says, by names, and by kinematics.

Names say which columns are a position, a velocity, an attitude, rates, motors; where they leave open how (order of a
quaternion, degrees, axes), the interpretation is proposed that kinematics contradict least. Several sources of one
quantity make a proposal ambiguous: it is shown, and not used unseen.
"""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.mapping import checks
from nsde_torch.data.mapping import names as kinds
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, mapping_of, targets
from nsde_torch.data.mapping.names import Named, bare, is_measured
from nsde_torch.data.quaternion import from_euler_zyx, rotate
from nsde_torch.data.streams import UNNAMED, ClockOf, Stream, StreamLog, attitudes, full, linear, moving
from nsde_torch.data.system_info import SystemInfo

_Columns = dict[str, ColumnEntry]


@dataclass
class Proposal:
    """A mapping, and how sure it is."""

    mapping: LogMapping | None  # what is proposed; None where too little was recognised
    missing: list[str] = field(default_factory=list)  # what was not found, in words
    open: list[str] = field(default_factory=list)
    """What else the columns could be, in words: not empty means that a user should look."""
    notes: list[str] = field(default_factory=list)  # what was assumed, in words


def propose(log: StreamLog, system: SystemInfo, *, kind: str = "") -> Proposal:
    """A mapping of a log for a system; `kind` is the reader, which the mapping names."""
    called = _names_by_content(log, system)
    if called is not None:
        return _nameless(log, system, kind, called)
    said = dict(mapping_of({"columns": dict(log.columns)}).columns) if log.columns else {}
    if system.quaternion is not None:
        return _Vehicle(log, system, kind, said).proposal()
    out = Proposal(None)
    columns = _single(log, system, said, out)
    if columns:
        world, body = log.frames.get("world", "ENU"), log.frames.get("body", "FLU")
        out.mapping = LogMapping(columns, system.name, kind, log.clock or ClockOf(), world=world, body=body)
    return out


# What the columns of a table without names are: by what must hold between them, else by their order.
#
# Four neighbours of unit length are a quaternion, the three that turn it its rates, and of positions and
# velocities the pair whose movement agrees; as many neighbours as there are motors, never negative and of one
# size, are the motors.

_ROWS = 6000  # that are looked at
_UNIT = 0.01  # by which a quaternion's length is off
_ALIKE = 1.5  # times that the usual commands of motors differ


def _nameless(log: StreamLog, system: SystemInfo, kind: str, called: Mapping[str, str]) -> Proposal:
    """A table without names as if its columns had those of the system, for checks to judge."""
    stream = log.streams[0]
    fields = {name: stream.fields[column] for column, name in called.items()}
    found = propose(replace(log, streams=[replace(stream, fields=fields)]), system, kind=kind)
    if found.mapping is not None:
        own = {name: column for column, name in called.items()}
        entries = found.mapping.columns.items()
        taken = {n: replace(e, source=tuple(own.get(s, s) for s in e.source)) for n, e in entries}
        found.mapping = replace(found.mapping, columns=taken)
        found.open.append(
            "the table has no names: what its columns are is a guess by what holds between them"
        )
    return found


def _names_by_content(log: StreamLog, system: SystemInfo) -> dict[str, str] | None:
    """Names of the system for the columns of a table without names; None of any other log."""
    columns = [column for stream in log.streams for column in stream.fields]
    names = (*system.state_names, *system.input_names)
    if len(log.streams) != 1 or len(columns) < len(names) or not columns[0].startswith(UNNAMED):
        return None
    found = None if system.quaternion is None else _by_what_holds(log.streams[0], len(system.input_names))
    return found or dict(zip(columns, names, strict=False))


def _by_what_holds(stream: Stream, motors: int) -> dict[str, str]:
    names = list(stream.fields)
    table = stream.columns(*names)[:_ROWS]
    t, moves = stream.t[:_ROWS], moving(table)
    out: dict[str, str] = {}

    def free(size: int) -> Iterator[list[int]]:
        for k in range(len(names) - size + 1):
            places = list(range(k, k + size))
            if moves[places].all() and not out.keys() & {names[p] for p in places}:
                yield places

    def take(places: Iterable[int], *of: str) -> None:
        out.update(zip([names[p] for p in places], of, strict=True))

    length = [(float(np.abs(np.linalg.norm(table[:, p], axis=1) - 1.0).max()), p) for p in free(4)]
    unit, places = min(length, default=(1.0, []))
    if unit > _UNIT or not stream.timed:
        return {}
    q = table[:, places]
    take(places, "q_0", "q_1", "q_2", "q_3")
    ways = checks.attitude_ways(None, None)
    turning = [
        (left[k], p, ways[k])
        for p in free(3)
        for left in [[checks.attitude_left(t, q, table[:, p], way) for way in ways]]
        for k in [checks.best(left)]
        if k is not None
    ]
    left, places, way = min(turning, default=(1.0, [], ways[0]), key=lambda row: row[0])
    if left > checks.SOUND_ATTITUDE:
        return {}
    take(places, "w_x", "w_y", "w_z")
    q = checks.read_attitude(q, way)
    every = max(1, round(checks.INTERVAL_S * stream.rate))
    step = np.diff(t, append=t[-1])[:, None]
    moved = {tuple(p): np.diff(table[::every, p], axis=0) for p in free(3)}
    told = [(p, axes) for p in moved for axes in (table[:, p], rotate(q, table[:, p]))]
    rate = [(v, np.diff(np.cumsum(axes * step, axis=0)[::every], axis=0)) for v, axes in told]
    pairs = [
        (left, p, v)
        for p, change in moved.items()
        for v, movement in rate
        if not set(p) & set(v)
        for left in [np.square(change - movement).sum() / np.square(change - change.mean(axis=0)).sum()]
        if left < checks.SOUND_VELOCITY
    ]
    rates = [v for _, _, v in pairs]
    pairs = [row for row in pairs if row[1] not in rates] or pairs  # what has a rate and is none itself
    if not pairs:
        return {}
    _, position, speeds = min(pairs)
    take(position, "p_x", "p_y", "p_z")
    take(speeds, "v_x", "v_y", "v_z")
    usual = np.median(table, axis=0)
    sizes = [(float(usual[p].max() / usual[p].min()), p) for p in free(motors) if (table[:, p] >= 0.0).all()]
    alike, places = min(sizes, default=(np.inf, []))
    if alike < _ALIKE:
        take(places, *(f"u_{k + 1}" for k in range(motors)))
    return out


# Machines without an attitude: states, inputs and channels one by one.

_POSITIONS = {
    "q", "x", "y", "pos", "position", "angle", "theta", "phi", "qm", "displacement", "deflection", "output",
}  # fmt: skip
_RATES = {
    "v", "vel", "velocity", "speed", "dq", "qd", "qdot", "dx", "xd", "xdot", "omega", "dtheta", "thetadot", "angvel",
}  # fmt: skip
_ANGLES = {"angle", "theta", "phi"}
_OF_UNIT = {"rad": _ANGLES, "deg": _ANGLES, "m": {"x", "pos", "position", "displacement"}}
"""Those of `_POSITIONS` that say whether they turn or move along."""
_DOTS = ("d", "dot", "rate", "vel", "velocity", "speed")  # behind the name of a position, that of its rate
_INPUTS = {
    "u", "f", "force", "input", "tau", "torque", "voltage", "current", "command", "cmd", "control", "vir", "motor",
}  # fmt: skip
_FEWEST = 10  # movements that determine a rate
_MEASURED = re.compile(r"_(meas|measured|act|actual|filt|filtered|enc|encoder)(?=\d*$)")
_COMMANDED = re.compile(r"_(cmd|command|commanded)(?=\d*$)")


def _single(log: StreamLog, system: SystemInfo, said: Mapping[str, ColumnEntry], out: Proposal) -> _Columns:
    """Entries for the states and inputs of a machine without an attitude; those that the format gives are taken."""
    wanted_names = (*system.state_names, *system.input_names, *system.exogenous)
    columns: _Columns = {}
    for name, entry in said.items():
        own = targets(system, name)
        if set(own) <= set(wanted_names) and len(own) == len(entry.source):
            columns[name] = entry
    given = {one for name in columns for one in targets(system, name)}
    every = {full(stream, column): (stream, column) for stream in log.streams for column in stream.fields}
    still = {key for key, (stream, column) in every.items() if not moving(stream.columns(column))[0]}
    named = {key: (bare(column), stream.units.get(column)) for key, (stream, column) in every.items()}
    free = {key: (name, logged or unit) for key, ((name, unit), logged) in named.items()}
    names_of = list(free)
    rates = {rate: position for position, rate, _ in system.position_derivatives}
    for wanted in wanted_names:
        if wanted in given:
            continue
        found = _named(wanted, free, still, system)
        if wanted in rates:  # `v` may be a voltage: a rate of another name is one by its position
            place = columns.get(rates[wanted])
            same = [key for key in found if _squeezed(free[key][0]) == _squeezed(wanted)]
            if place is not None and not found:
                of = {_squeezed(place.source[0]) + dot for dot in _DOTS}
                found = [key for key, (name, _) in free.items() if _squeezed(name) in of]
            found = same or [k for k in found if place is not None and _follows(log, place.source[0], k)]
        if found:
            if len(found) > 1:
                out.open.append(f"{wanted} may be {' or '.join(found)}")
            columns[wanted] = ColumnEntry((found[0],), unit=free.pop(found[0])[1])
        elif wanted not in rates and wanted not in system.optional_inputs:
            asked = [key for key, (name, _) in free.items() if not is_measured(name)]
            more = ""
            if asked and wanted in system.state_names:
                more = f" (columns that are called as setpoints are none: {', '.join(asked)})"
            elif wanted in system.input_names and names_of:
                more = f" (where nothing drove it, any column times 0: `{wanted}: {{from: {names_of[0]}, scale: 0}}`)"
            out.missing.append(f"a column for {wanted}{more}")
        elif wanted in system.optional_inputs and (left := [key for key in free if key not in still]):
            out.notes.append(
                f"{wanted} is taken to be 0 throughout: none of {', '.join(left)} has such a name"
            )
    return columns


def _named(
    wanted: str, free: dict[str, tuple[str, str | None]], still: set[str], system: SystemInfo
) -> list[str]:
    """Columns of a name that means `wanted`: the same, else a synonym where the system has one such, else alike."""
    plain = {key: _squeezed(name) for key, (name, _) in free.items()}
    same = [key for key, name in plain.items() if name == _squeezed(wanted)]
    if same:
        return same
    plain = {}
    for key, (name, _) in free.items():
        # a setpoint is no state, however much it is called like one
        if key not in still and (wanted not in system.state_names or is_measured(name)):
            name = _MEASURED.sub("", name.lower())
            plain[key] = _squeezed(_COMMANDED.sub("", name) if wanted in system.input_names else name)
    rates = [rate for _, rate, _ in system.position_derivatives]
    positions = [n for n in system.state_names if n not in rates]
    words = _RATES if wanted in rates else _POSITIONS if wanted in positions else _INPUTS
    several = len(system.input_names if words is _INPUTS else positions) > 1
    number = re.sub(r"\D", "", wanted)
    # of joints without numbers nothing says which is which, but where one alone turns
    if several and not number:
        units = dict(zip(system.state_names, system.state_units, strict=True))
        said = _OF_UNIT.get(units.get(wanted, ""), set())
        alone = [n for n in positions if _OF_UNIT.get(units[n]) is said] == [wanted]
        words = said if alone else set()
    alike = [key for key, name in plain.items() if name in words and not several]
    own = number if several else None
    alike = alike or [key for key, name in plain.items() if _of_joint(name, words, own)]
    if alike:
        return alike
    near = difflib.get_close_matches(_squeezed(wanted), list(plain.values()), n=1, cutoff=0.8)
    return [key for key, name in plain.items() if near and name == near[0]]


def _of_joint(name: str, words: set[str], number: str | None) -> bool:
    """Whether a name is one of some words and a number; None: any number."""
    stem = name.rstrip("0123456789")
    return stem in words and (number is None or name[len(stem) :] == number)


def _follows(log: StreamLog, position: str, rate: str) -> bool:
    """Whether a column is the rate of another, in whatever units, by the movement over 0.25 s; True where none says."""
    (one, p), (other, v) = log.find(position), log.find(rate)
    if one is not other or not one.timed:
        return True
    every = max(1, round(checks.INTERVAL_S * one.rate))
    good = np.isfinite(one.fields[p] + one.fields[v])
    place, speed = one.fields[p][good], one.fields[v][good]
    steps = np.diff(place, prepend=place[:1])
    wraps = np.where(np.abs(steps) > 0.5 * np.ptp(place), steps, 0.0)  # of an angle
    place = place - np.cumsum(wraps)
    moved = np.diff(place[::every])
    told = np.diff(np.cumsum(speed)[::every])
    if len(moved) < _FEWEST or not np.ptp(moved) or not np.ptp(told):
        return True
    return bool(np.corrcoef(moved, told)[0, 1] ** 2 > 0.9)


def _squeezed(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", re.split(r"[./]", name.lower())[-1])


# Machines with an attitude: vectors, motors and the battery's voltage.

_SENSOR = ("gyro", "imu", "gyr")
_MOST = 6  # sources of one quantity that are compared
_BATTERY = re.compile(r"(^|[^a-z])(vbat|v_bat|bat_?volt\w*|battery_?voltage|voltage_v|volt)$")
_CRAZYFLIE = re.compile(r"state_?estimate|pm_?\.?vbat|motor_m[1-4]", re.I)
_TURNS = {"rpm": "rpm", "rad/s": "rad/s", "rad_s": "rad/s", "rads": "rad/s"}
_SPEEDS = re.compile(r"rotor|omega|speed|vel")
_SHORTEST_US = 800.0  # of pulses that turn a motor; of a thousand, one may be shorter
_TURNS_US = 980.0
_NEGATIVE = -0.02  # a motor's command is none
_Tried = list[tuple[float, Named, ColumnEntry, ColumnEntry, Any]]
"""Share that is left, the first vector, its entry and that of the second, and the way in which they are read."""


class _Vehicle:
    """A proposal for a machine with an attitude."""

    def __init__(
        self, log: StreamLog, system: SystemInfo, kind: str, said: Mapping[str, ColumnEntry]
    ) -> None:
        self.log, self.system, self.kind, self.said = log, system, kind, said
        self.found = [one for stream in log.streams for one in kinds.vectors(stream)]
        self.out = Proposal(None)
        self.world, self.body = log.frames.get("world", "ENU"), log.frames.get("body", "FLU")

    def proposal(self) -> Proposal:
        columns = self._attitude()
        if "q" not in columns:
            self.out.missing.append("an attitude (a quaternion, or roll, pitch and yaw)")
        columns |= self._places(columns.get("q"))
        if "p" in columns and "q" in columns and _family(columns["p"]) != _family(columns["q"]):
            columns |= self._attitude(_family(columns["p"]))  # of two estimators, one
        columns |= self._motors() | self._battery()
        if "q" in columns and "p" in columns and not self.log.frames.get("world"):
            self._axes(columns)
        for told in (self.out.missing, self.out.open, self.out.notes):
            told[:] = dict.fromkeys(told)
        if columns:
            order = [*(name for name in ("p", "v", "q", "w", "u") if name in columns), *columns]
            self.out.mapping = LogMapping(
                {name: columns[name] for name in order},
                system=self.system.name,
                kind=self.kind,
                time=self.log.clock or ClockOf(),
                world=self.world,
                body=self.body,
            )
        return self.out

    def _candidates(self, name: str, kind: str) -> list[tuple[Named, ColumnEntry]]:
        """Sources of a quantity: what the format says, else every vector of such a name."""
        if name in self.said:
            entry = self.said[name]
            stream, columns = self._of(entry)
            return [(Named(kind, stream.name, columns, entry.unit, entry.order), entry)]
        found = [one for one in kinds.pick(self.found, kind) if self._moves(one)]
        return [(one, ColumnEntry(one.sources, unit=one.unit, order=one.order)) for one in found[:_MOST]]

    def _of(self, entry: ColumnEntry) -> tuple[Stream, tuple[str, ...]]:
        """The stream of an entry, and its columns."""
        found = [self.log.find(source) for source in entry.source]
        return found[0][0], tuple(column for _, column in found)

    def _moves(self, one: Named) -> bool:
        stream = self.log.stream(one.stream)
        values = stream.columns(*one.columns)
        if not stream.timed or not moving(values).any():
            return False
        if one.kind == kinds.QUATERNION:
            length = np.linalg.norm(values, axis=1)
            return bool(np.median(np.abs(length[np.isfinite(length)] - 1.0)) < 0.05)
        return True

    def _on(self, stream: Stream, one: Named) -> Array:
        """A vector on the rows of a stream."""
        own = self.log.stream(one.stream)
        values = own.columns(*one.columns)
        return values if own is stream else linear(own, values, stream.t)

    def _quaternion(self, one: Named, entry: ColumnEntry) -> tuple[Stream, Array, ColumnEntry]:
        """A candidate as a quaternion on its own rows, and its entry with a unit."""
        stream = self.log.stream(one.stream)
        values = stream.columns(*one.columns)
        if len(one.columns) == 3:  # Euler angles
            unit = entry.unit or ("deg" if np.nanmax(np.abs(values)) > 6.4 else "rad")
            values = from_euler_zyx(values * (np.pi / 180.0 if unit == "deg" else 1.0))
            return stream, values, replace(entry, unit=unit, order=None)
        return stream, values / np.linalg.norm(values, axis=1, keepdims=True).clip(1e-9), entry

    def _missing(self, what: str, kind: str) -> None:
        asked = [", ".join(one.columns) for one in self.found if one.kind == kind and not one.measured]
        self.out.missing.append(
            f"{what} (columns that are called as setpoints are none: {'; '.join(asked)})" if asked else what
        )

    def _open(self, what: str, entries: Iterable[ColumnEntry]) -> None:
        sources = list(dict.fromkeys(", ".join(entry.source) for entry in entries))
        if len(sources) > 1:
            self.out.open.append(f"{what} may be {' or '.join(sources)}")

    def _sound(self, tried: _Tried, most: float, **candidates: Sequence[tuple[Named, ColumnEntry]]) -> _Tried:
        """The pairs that agree, which are as good; the best, where none does; none, where none moves."""
        sound = [row for row in tried if row[0] < most] or (
            [min(tried, key=lambda row: row[0])] if tried else []
        )
        agree = [row[2] for row in sound], [row[3] for row in sound]
        for (name, found), own in zip(candidates.items(), agree, strict=True):
            self._open(f"the {name}", own or [entry for _, entry in found])
        return sound

    def _attitude(self, family: str | None = None) -> _Columns:
        """Entries of the attitude and the body rates."""
        quaternions = self._candidates("q", kinds.QUATERNION) or self._candidates("q", kinds.EULER)
        rates = self._candidates("w", kinds.RATES)
        if not rates:
            self._missing("body rates (a gyroscope)", kinds.RATES)
        if not quaternions:
            return {"w": rates[0][1]} if rates else {}
        tried: _Tried = []
        for one, entry in quaternions:
            stream, q, entry = self._quaternion(one, entry)
            for rate, rate_entry in rates:
                w = self._on(stream, rate)
                # Euler angles turn the body into the world; a frame that the log fixes leaves no other signs open
                order = entry.order or ("wxyz" if len(one.columns) == 3 else None)
                ways = checks.attitude_ways(order, rate_entry.unit)
                left = [checks.attitude_left(stream.t, q, w, way) for way in ways]
                if (k := checks.best(left)) is not None:
                    tried.append((left[k], one, entry, rate_entry, ways[k]))
        sound = self._sound(tried, checks.SOUND_ATTITUDE, attitude=quaternions, rates=rates)
        if not sound:
            return {"q": self._quaternion(*quaternions[0])[2], **({"w": rates[0][1]} if rates else {})}
        sensors = [row for row in sound if any(word in " ".join(row[3].source).lower() for word in _SENSOR)]
        usual = quaternions[0][0]
        _, one, entry, rate_entry, way = min(
            sensors or sound, key=lambda row: (family not in (None, _family(row[2])), row[1] != usual, row[0])
        )
        if len(one.columns) == 4:
            entry = replace(entry, order=way.order)
        if way.turns == "world to body":
            entry = replace(entry, turns=way.turns)
        rate_entry = replace(rate_entry, unit=way.unit)
        if way.signs[1] < 0:
            rate_entry = replace(rate_entry, sign=way.signs)
        return {"q": entry, "w": rate_entry}

    def _places(self, attitude: ColumnEntry | None) -> _Columns:
        """Entries of position and velocity."""
        positions = self._candidates("p", kinds.POSITION)
        velocities = self._candidates("v", kinds.VELOCITY)
        if not positions:
            self._missing("a position", kinds.POSITION)
        if not velocities:
            self._missing("a velocity", kinds.VELOCITY)
        if not positions or not velocities:
            return {name: found[0][1] for name, found in (("p", positions), ("v", velocities)) if found}
        tried: _Tried = []
        for one, entry in positions:
            stream = self.log.stream(one.stream)
            p, q = stream.columns(*one.columns), self._known(attitude, stream.t)
            for velocity, velocity_entry in velocities:
                v = self._on(stream, velocity)
                ways = [w for w in checks.VELOCITY_WAYS if velocity_entry.axes in (None, w.axes)]
                left = [checks.velocity_left(stream.t, q, p, v, way) for way in ways]
                if (k := checks.best(left)) is not None:
                    tried.append((left[k], one, entry, velocity_entry, ways[k]))
        sound = self._sound(tried, checks.NOISY_VELOCITY, position=positions, velocity=velocities)
        if not sound:
            first = velocities[0][1]
            return {"p": positions[0][1], "v": replace(first, axes=first.axes or "world")}
        _, one, entry, velocity_entry, way = min(sound, key=lambda row: row[0])
        source = tuple(velocity_entry.source[k] for k in way.places)
        velocity_entry = replace(velocity_entry, axes=way.axes, source=source)
        if way.signs != (1.0, 1.0, 1.0):
            velocity_entry = replace(velocity_entry, sign=way.signs)
        if one.down:
            self.world = "NED"
        return {"p": entry, "v": velocity_entry}

    def _known(self, entry: ColumnEntry | None, t: Array) -> Array | None:
        """The attitude as the log has it, at other times."""
        if entry is None:
            return None
        stream, columns = self._of(entry)
        _, q, _ = self._quaternion(Named(kinds.QUATERNION, stream.name, columns), entry)
        if len(columns) == 4:
            way = checks.AttitudeWay(entry.order or "wxyz", entry.turns or "body to world")
            q = checks.read_attitude(q, way)
        return q if t is stream.t else attitudes(stream, q, t)

    def _axes(self, columns: _Columns) -> None:
        """Axes of world and body that the log does not name, by where the machine speeds up."""
        stream, names = self._of(columns["p"])
        q = self._known(columns["q"], stream.t)
        found = None if q is None else checks.lean(stream.t, q, stream.columns(*names))
        if found is None or found.way not in ("up", "down"):
            self.out.notes.append(f"axes are taken for {self.world} and {self.body}: the log does not tell")
            if found is not None and found.way is not None:
                self.out.open.append(f"positions and attitude have other axes ({found.way})")
            return
        up = found.way == "up"
        self.body = "FLU" if up else "FRD"
        self.world = "ENU" if up == (found.up > 0) else "NED"
        self.out.notes.append(
            f"axes are {self.world} and {self.body}: the machine speeds up "
            f"{'along' if up else 'against'} the lean of the body's third axis"
        )
        rates = columns.get("w")
        # of the body's other handedness, by its name
        if rates is not None and rates.sign[1:] == (-1.0, -1.0):
            columns["w"] = replace(rates, sign=(), body="FRD" if up else "FLU")

    def _motors(self) -> _Columns:
        wanted = len(self.system.input_names)
        said = self.said.get("u")
        if said is not None and len(said.source) != wanted:
            self.out.missing.append(f"{wanted} motors (the log has {len(said.source)}: choose the system)")
        if said is not None:
            return {"u": said} if len(said.source) == wanted else {}
        candidates: list[ColumnEntry] = []
        longer: list[ColumnEntry] = []
        for one in kinds.pick(self.found, kinds.MOTORS):
            stream = self.log.stream(one.stream)
            values = stream.columns(*one.columns)
            moves = moving(values)
            if int(moves.sum()) >= wanted and not (values < _NEGATIVE).any():
                columns = tuple(c for c, m in zip(one.columns, moves, strict=True) if m)[:wanted]
                entry = ColumnEntry(replace(one, columns=columns).sources)
                entry = in_unit(entry, stream.columns(*columns), one.unit or stream.units.get(columns[0]))
                (candidates if int(moves.sum()) == wanted else longer).append(entry)
        if longer and not candidates:
            candidates = longer
            told = ", ".join(longer[0].source)
            self.out.open.append(
                f"more than {wanted} columns of commands move; the motors are taken to be {told}"
            )
        if not candidates:
            self.out.missing.append(f"{wanted} motor commands that move")
            return {}
        entry = candidates[0]
        if any(_CRAZYFLIE.search(name) for name in self.log.names()) and wanted == 4:
            entry = replace(entry, numbering="crazyflie")
        else:
            self.out.notes.append("motors are taken to be numbered as PX4 does")
        if len(candidates) > 1:
            told = " or ".join(", ".join(one.source) for one in candidates)
            self.out.open.append(f"the motor commands may be {told}")
        return {"u": entry}

    def _battery(self) -> _Columns:
        if "battery_voltage" in self.said:
            return {"battery_voltage": self.said["battery_voltage"]}
        columns = ((s, c) for s in self.log.streams for c in s.fields)
        volts = [full(s, c) for s, c in columns if _BATTERY.search(bare(c)[0].lower())]
        return {"battery_voltage": ColumnEntry((volts[0],), unit="V")} if len(volts) == 1 else {}


def _family(entry: ColumnEntry) -> str:
    """What the names of one estimator begin with: the topic, or the first word of the column."""
    stream, slash, column = entry.source[0].rpartition("/")
    return stream if slash else column.partition("_")[0]


def in_unit(entry: ColumnEntry, values: Array, unit: str | None) -> ColumnEntry:
    """Motor commands with the ends of their range, or speeds of rotors, by their names and by what they read."""
    flat = values[np.isfinite(values)]
    top = float(np.quantile(flat, 0.999))
    running = flat[flat > 0.02 * top]
    low = float(np.quantile(running, 0.001)) if len(running) else 0.0
    names = " ".join(entry.source).lower()
    unit = unit or next((unit for mark, unit in _TURNS.items() if mark in names), None)
    speeds = unit in _TURNS.values() or _SPEEDS.search(names)
    if top <= 1.05:
        return replace(entry, unit="1")
    if top <= 105.0:
        return replace(entry, unit="%")
    # pulses below 1000 us are those of motors that stand, of one length or two
    stands = len(np.unique(running[running < _TURNS_US])) <= 2
    if not speeds and low > _SHORTEST_US and top <= 2250.0 and stands:
        return replace(entry, unit="us", low=1000.0, high=2000.0)
    if not speeds and 30000.0 < top <= 65535.0:  # a duty cycle in 16 bits
        return replace(entry, low=0.0, high=65535.0)
    most = float(flat.max())
    size = 10.0 ** (np.floor(np.log10(most)) - 1)  # a little above what was read
    return replace(entry, unit=unit, full=float(np.ceil(most / size) * size))
