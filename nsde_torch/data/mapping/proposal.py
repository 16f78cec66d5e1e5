"""What the columns of a log are likely to mean to a system: by what the format says, by names, and by kinematics.

Names say which columns are a position, a velocity, an attitude, rates, motors; where they leave open how (order of a
quaternion, degrees, axes), the interpretation is proposed that kinematics contradict least. Several sources of one
quantity make a proposal ambiguous: it is shown, and not used unseen.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.formats.log import UNNAMED, ClockOf, StreamLog, full
from nsde_torch.data.mapping import names as kinds
from nsde_torch.data.mapping.inputs import propose_inputs
from nsde_torch.data.mapping.kinematic import (
    INTERVAL_S,
    NOISY_VELOCITY,
    SOUND_ATTITUDE,
    SOUND_VELOCITY,
    attitude_left,
    attitude_ways,
    best,
    lean,
    read_attitude,
    velocity_left,
    velocity_ways,
)
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, mapping_of, targets
from nsde_torch.data.mapping.names import Named, bare, is_measured
from nsde_torch.data.quaternion import from_euler_zyx, rotate
from nsde_torch.data.streams import Stream, attitudes, linear, moving
from nsde_torch.data.system_info import SystemInfo

# What the columns of a table without names are: by what must hold between them, else by their order.
#
# Four neighbours of unit length are a quaternion, the three that turn it its rates, and of positions and
# velocities the pair whose movement agrees; as many neighbours as there are motors, never negative and of one
# size, are the motors.

_ROWS = 6000  # that are looked at
_UNIT = 0.01  # by which a quaternion's length is off
_ALIKE = 1.5  # times that the usual commands of motors differ


def names_by_content(log: StreamLog, system: SystemInfo) -> dict[str, str] | None:
    """Names of the system for the columns of a table without names; None of any other log.

    Args:
        log: The streams.
        system: The machine.
    """
    columns = [column for stream in log.streams for column in stream.fields]
    names = (*system.state_names, *system.input_names)
    if len(log.streams) != 1 or len(columns) < len(names) or not columns[0].startswith(UNNAMED):
        return None
    if system.quaternion is None:
        return dict(zip(columns, names, strict=False))
    found = _by_what_holds(log.streams[0], len(system.input_names))
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
    ways = list(attitude_ways(None, None))
    turning = [
        (left[k], p, ways[k])
        for p in free(3)
        for left in [[attitude_left(t, q, table[:, p], way) for way in ways]]
        for k in [best(left)]
        if k is not None
    ]
    left, places, way = min(turning, default=(1.0, [], ways[0]), key=lambda row: row[0])
    if left > SOUND_ATTITUDE:
        return {}
    take(places, "w_x", "w_y", "w_z")
    q = read_attitude(q, way)
    every = max(1, round(INTERVAL_S * stream.rate))
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
        if left < SOUND_VELOCITY
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


_POSITIONS = {
    "q",
    "x",
    "y",
    "pos",
    "position",
    "angle",
    "theta",
    "phi",
    "qm",
    "displacement",
    "deflection",
    "output",
}
_RATES = {
    "v",
    "vel",
    "velocity",
    "speed",
    "dq",
    "qd",
    "qdot",
    "dx",
    "xd",
    "xdot",
    "omega",
    "dtheta",
    "thetadot",
    "angvel",
}
_INPUTS = {
    "u",
    "f",
    "force",
    "input",
    "tau",
    "torque",
    "voltage",
    "current",
    "command",
    "cmd",
    "control",
    "vir",
    "motor",
}
_FEWEST = 10  # movements that determine a rate
_MEASURED = re.compile(r"_(meas|measured|act|actual|filt|filtered|enc|encoder)(?=\d*$)")
_COMMANDED = re.compile(r"_(cmd|command|commanded)(?=\d*$)")


@dataclass
class ColumnsFound:
    """Entries, and what is missing or open."""

    columns: dict[str, ColumnEntry] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def propose_single(
    log: StreamLog, system: SystemInfo, said: Mapping[str, ColumnEntry] | None = None
) -> ColumnsFound:
    """Entries for the states and inputs of a machine without an attitude.

    Args:
        log: The streams.
        system: The machine.
        said: Entries that the format gives; those that are of the system are taken.
    """
    out = ColumnsFound()
    names = {*system.state_names, *system.input_names, *system.exogenous}
    given: set[str] = set()
    for name, entry in (said or {}).items():
        own = targets(system, name)
        if set(own) <= names and len(own) == len(entry.source):
            out.columns[name] = entry
            given |= set(own)
    free: dict[str, tuple[str, str | None]] = {}
    still: set[str] = set()
    for stream in log.streams:
        for column, values in stream.fields.items():
            name, unit = bare(column)
            free[full(stream, column)] = (name, stream.units.get(column) or unit)
            if not moving(values[:, None])[0]:
                still.add(full(stream, column))
    names_of = list(free)
    rates = {rate: position for position, rate, _ in system.position_derivatives}
    for wanted in (*system.state_names, *system.input_names, *system.exogenous):
        if wanted in given:
            continue
        found = _named(wanted, free, still, system, rates)
        if wanted in rates:  # `v` may be a voltage: a rate of another name is one by its position
            place = out.columns.get(rates[wanted])
            same = [key for key in found if _squeezed(free[key][0]) == _squeezed(wanted)]
            found = same or [
                key for key in found if place is not None and _follows(log, place.source[0], key)
            ]
        if len(found) == 1:
            name = found[0]
            unit = free.pop(name)[1]
            out.columns[wanted] = ColumnEntry((name,), unit=unit)
        elif found:
            out.open.append(f"{wanted} may be {' or '.join(found)}")
            out.columns[wanted] = ColumnEntry((found[0],), unit=free.pop(found[0])[1])
        elif wanted not in rates and wanted not in system.optional_inputs:
            asked = [key for key, (name, _) in free.items() if not is_measured(name)]
            more = ""
            if asked and wanted in system.state_names:
                more = f" (taken for setpoints: {', '.join(asked)})"
            elif wanted in system.input_names and names_of:
                more = f" (where nothing drove it, any column times 0: `{wanted}: {{from: {names_of[0]}, scale: 0}}`)"
            out.missing.append(f"a column for {wanted}{more}")
        elif wanted in system.optional_inputs and (left := [key for key in free if key not in still]):
            out.notes.append(
                f"{wanted} is taken to be 0 throughout: none of {', '.join(left)} has such a name"
            )
    return out


def _named(
    wanted: str,
    free: dict[str, tuple[str, str | None]],
    still: set[str],
    system: SystemInfo,
    rates: dict[str, str],
) -> list[str]:
    """Columns of a name that means `wanted`: the same, else a synonym where the system has one such, else alike."""
    plain = {key: _squeezed(name) for key, (name, _) in free.items()}
    same = [key for key, name in plain.items() if name == _squeezed(wanted)]
    if same:
        return same
    plain = {key: _MEASURED.sub("", name.lower()) for key, (name, _) in free.items()}
    if wanted in system.input_names:
        plain = {key: _COMMANDED.sub("", name) for key, name in plain.items()}
    plain = {key: _squeezed(name) for key, name in plain.items()}
    plain = {key: name for key, name in plain.items() if key not in still}
    if wanted in system.state_names:  # a setpoint is no state, however much it is called like one
        plain = {key: name for key, name in plain.items() if is_measured(free[key][0])}
    positions = [n for n in system.state_names if n not in rates]
    words = _RATES if wanted in rates else _POSITIONS if wanted in positions else _INPUTS
    several = len(system.input_names if words is _INPUTS else positions) > 1
    number = re.sub(r"\D", "", wanted)
    if several and not number:  # of joints without numbers nothing says which is which
        words = set()
    alike = [key for key, name in plain.items() if name in words and not several]
    alike = alike or [
        key for key, name in plain.items() if _of_joint(name, words, number if several else None)
    ]
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
    every = max(1, round(INTERVAL_S * one.rate))
    good = np.isfinite(one.fields[p] + one.fields[v])
    place, speed = one.fields[p][good], one.fields[v][good]
    moved = np.diff(place[::every])
    told = np.diff(np.cumsum(speed)[::every])
    if len(moved) < _FEWEST or not np.ptp(moved) or not np.ptp(told):
        return True
    return bool(np.corrcoef(moved, told)[0, 1] ** 2 > 0.9)


def _squeezed(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", re.split(r"[./]", name.lower())[-1])


_SENSOR = ("gyro", "imu", "gyr")
_MOST = 6  # sources of one quantity that are compared


@dataclass
class Proposal:
    """A mapping, and how sure it is.

    Args:
        mapping: What is proposed; None where too little was recognised.
        missing: What was not found, in words.
        open: What else the columns could be, in words: not empty means that a user should look.
        notes: What was assumed, in words.
    """

    mapping: LogMapping | None
    missing: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def propose(log: StreamLog, system: SystemInfo, *, kind: str = "") -> Proposal:
    """A mapping of a log for a system.

    Args:
        log: The streams.
        system: The machine.
        kind: The reader, which the mapping names.
    """
    unnamed = _nameless(log, system, kind)
    if unnamed is not None:
        return unnamed
    if system.quaternion is None:
        said = mapping_of({"columns": dict(log.columns)}).columns if log.columns else {}
        found = propose_single(log, system, said)
        mapping = None
        if found.columns:
            world, body = log.frames.get("world", "ENU"), log.frames.get("body", "FLU")
            clock = log.clock or ClockOf()
            mapping = LogMapping(found.columns, system.name, kind, clock, world=world, body=body)
        return Proposal(mapping, found.missing, found.open, found.notes)
    return _Vehicle(log, system, kind).proposal()


def _nameless(log: StreamLog, system: SystemInfo, kind: str) -> Proposal | None:
    """A table without names as if its columns had those of the system, for checks to judge."""
    called = names_by_content(log, system)
    if called is None:
        return None
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


class _Vehicle:
    """A proposal for a machine with an attitude."""

    def __init__(self, log: StreamLog, system: SystemInfo, kind: str) -> None:
        self.log, self.system = log, system
        self.found = [one for stream in log.streams for one in kinds.vectors(stream)]
        self.out = Proposal(None)
        said = mapping_of({"columns": dict(log.columns)}).columns if log.columns else {}
        self.said = dict(said)
        self.world, self.body = log.frames.get("world", "ENU"), log.frames.get("body", "FLU")
        self.kind = kind

    def proposal(self) -> Proposal:
        columns: dict[str, ColumnEntry] = {}
        attitude = self._attitude()
        columns.update(attitude)
        if "q" not in attitude:
            self.out.missing.append("an attitude (a quaternion, or roll, pitch and yaw)")
        columns.update(self._places(columns.get("q")))
        if "p" in columns and "q" in columns and _family(columns["p"]) != _family(columns["q"]):
            columns.update(self._attitude(_family(columns["p"])))  # of two estimators, one
        motors = propose_inputs(self.log, self.system, self.found, self.said)
        columns.update(motors.columns)
        self.out.missing += motors.missing
        self.out.open += motors.open
        self.out.notes += motors.notes
        if "q" in columns and "p" in columns and not self.log.frames.get("world"):
            self._axes(columns)
        first: tuple[str, ...] = ("p", "v", "q", "w", "u")
        ordered = {name: columns[name] for name in first if name in columns}
        rest = {name: entry for name, entry in columns.items() if name not in ordered}
        for told in (self.out.missing, self.out.open, self.out.notes):
            told[:] = dict.fromkeys(told)
        if columns:
            self.out.mapping = LogMapping(
                {**ordered, **rest},
                system=self.system.name,
                kind=self.kind,
                time=self.log.clock or ClockOf(),
                world=self.world,
                body=self.body,
            )
        return self.out

    # ---- attitude and rates ----------------------------------------------------------------------------

    def _candidates(self, name: str, *wanted: str) -> list[tuple[Named, ColumnEntry]]:
        """Sources of a quantity: what the format says, else every vector of such a name."""
        if name in self.said:
            entry = self.said[name]
            stream, _ = self.log.find(entry.source[0])
            columns = tuple(self.log.find(s)[1] for s in entry.source)
            kind = kinds.EULER if name == "q" and len(columns) == 3 else wanted[0]
            return [(Named(kind, stream.name, columns, entry.unit, entry.order), entry)]
        out = []
        for kind in wanted:
            for one in kinds.pick(self.found, kind):
                stream = next(s for s in self.log.streams if s.name == one.stream)
                if self._moves(stream, one):
                    out.append((one, ColumnEntry(self._sources(one), unit=one.unit, order=one.order)))
        return out[:_MOST]

    def _sources(self, one: Named) -> tuple[str, ...]:
        return tuple(f"{one.stream}/{c}" if one.stream else c for c in one.columns)

    def _moves(self, stream: Stream, one: Named) -> bool:
        values = stream.columns(*one.columns)
        if not stream.timed or not moving(values).any():
            return False
        if one.kind == kinds.QUATERNION:
            length = np.linalg.norm(values, axis=1)
            return bool(np.median(np.abs(length[np.isfinite(length)] - 1.0)) < 0.05)
        return True

    def _stream(self, one: Named) -> Stream:
        return next(s for s in self.log.streams if s.name == one.stream)

    def _quaternion(self, one: Named, entry: ColumnEntry) -> tuple[Stream, Array, ColumnEntry]:
        """A candidate as a quaternion on its own rows, and its entry with a unit."""
        stream = self._stream(one)
        values = stream.columns(*one.columns)
        if one.kind == kinds.EULER or len(one.columns) == 3:
            unit = entry.unit or ("deg" if np.nanmax(np.abs(values)) > 6.4 else "rad")
            values = from_euler_zyx(values * (np.pi / 180.0 if unit == "deg" else 1.0))
            return stream, values, replace(entry, unit=unit, order=None)
        return stream, values / np.linalg.norm(values, axis=1, keepdims=True).clip(1e-9), entry

    def _attitude(self, family: str | None = None) -> dict[str, ColumnEntry]:
        quaternions = self._candidates("q", kinds.QUATERNION)
        quaternions = quaternions or self._candidates("q", kinds.EULER)
        rates = self._candidates("w", kinds.RATES)
        if not rates:
            self._missing("body rates (a gyroscope)", kinds.RATES)
        if not quaternions:
            return {"w": rates[0][1]} if rates else {}
        tried = []
        for one, entry in quaternions:
            stream, q, entry = self._quaternion(one, entry)
            for rate, rate_entry in rates:
                own = self._stream(rate)
                w = own.columns(*rate.columns)
                w = w if own is stream else linear(own, w, stream.t)
                # Euler angles turn the body into the world; a frame that the log fixes leaves no other signs open
                ways = list(
                    attitude_ways(entry.order or ("wxyz" if len(one.columns) == 3 else None), rate_entry.unit)
                )
                left = [attitude_left(stream.t, q, w, way) for way in ways]
                k = best(left)
                if k is not None:
                    tried.append((left[k], one, entry, rate, rate_entry, ways[k]))
        if not tried:
            one, entry = quaternions[0]
            self._several("attitude", quaternions)
            self._several("rates", rates)
            return {"q": self._quaternion(one, entry)[2], **({"w": rates[0][1]} if rates else {})}
        sound = [row for row in tried if row[0] < SOUND_ATTITUDE] or [min(tried, key=lambda row: row[0])]
        self._open("the attitude", [row[2] for row in sound])
        self._open("the rates", [row[4] for row in sound])
        sensors = [row for row in sound if any(word in " ".join(row[4].source).lower() for word in _SENSOR)]
        usual = quaternions[0][0]
        _, one, entry, _, rate_entry, way = min(
            sensors or sound, key=lambda row: (family not in (None, _family(row[2])), row[1] != usual, row[0])
        )
        if len(one.columns) == 4:
            entry = replace(entry, order=way.order)
        if way.turns == "world to body":
            entry = replace(entry, turns=way.turns)
        rate_entry = replace(rate_entry, unit=way.unit)
        if way.signs[1] < 0:
            rate_entry = replace(rate_entry, sign=(1.0, -1.0, -1.0))
        return {"q": entry, "w": rate_entry}

    def _missing(self, what: str, kind: str) -> None:
        asked = [", ".join(one.columns) for one in self.found if one.kind == kind and not one.measured]
        self.out.missing.append(f"{what} (taken for setpoints: {'; '.join(asked)})" if asked else what)

    def _several(self, what: str, found: list[tuple[Named, ColumnEntry]]) -> None:
        self._open(f"the {what}", [entry for _, entry in found])

    def _open(self, what: str, entries: list[ColumnEntry]) -> None:
        sources = list(dict.fromkeys(", ".join(entry.source) for entry in entries))
        if len(sources) > 1:
            self.out.open.append(f"{what} may be {' or '.join(sources)}")

    # ---- position and velocity -------------------------------------------------------------------------

    def _places(self, attitude: ColumnEntry | None) -> dict[str, ColumnEntry]:
        positions = self._candidates("p", kinds.POSITION)
        velocities = self._candidates("v", kinds.VELOCITY)
        if not positions:
            self._missing("a position", kinds.POSITION)
        if not velocities:
            self._missing("a velocity", kinds.VELOCITY)
        if not positions or not velocities:
            return {
                **({"p": positions[0][1]} if positions else {}),
                **({"v": velocities[0][1]} if velocities else {}),
            }
        tried = []
        for one, entry in positions:
            stream = self._stream(one)
            p = stream.columns(*one.columns)
            q = self._known(attitude, stream.t)
            for velocity, velocity_entry in velocities:
                own = self._stream(velocity)
                v = own.columns(*velocity.columns)
                v = v if own is stream else linear(own, v, stream.t)
                ways = [w for w in velocity_ways() if velocity_entry.axes in (None, w.axes)]
                left = [velocity_left(stream.t, q, p, v, way) for way in ways]
                k = best(left)
                if k is not None:
                    tried.append((left[k], one, entry, velocity, velocity_entry, ways[k]))
        if not tried:
            self._several("position", positions)
            self._several("velocity", velocities)
            return {
                "p": positions[0][1],
                "v": replace(velocities[0][1], axes=velocities[0][1].axes or "world"),
            }
        sound = [row for row in tried if row[0] < NOISY_VELOCITY] or [min(tried, key=lambda row: row[0])]
        self._open("the position", [row[2] for row in sound])
        self._open("the velocity", [row[4] for row in sound])
        _, one, entry, velocity, velocity_entry, way = min(sound, key=lambda row: row[0])
        velocity_entry = replace(velocity_entry, axes=way.axes)
        if way.places != (0, 1, 2):
            velocity_entry = replace(
                velocity_entry, source=tuple(velocity_entry.source[k] for k in way.places)
            )
        if way.signs != (1.0, 1.0, 1.0):
            velocity_entry = replace(velocity_entry, sign=way.signs)
        if one.down:
            self.world = "NED"
        return {"p": entry, "v": velocity_entry}

    def _known(self, entry: ColumnEntry | None, t: Array) -> Array | None:
        """The attitude as the log has it, at other times."""
        if entry is None:
            return None
        stream = self.log.find(entry.source[0])[0]
        columns = tuple(self.log.find(s)[1] for s in entry.source)
        one = Named(kinds.EULER if len(columns) == 3 else kinds.QUATERNION, stream.name, columns)
        _, q, _ = self._quaternion(one, entry)
        if len(columns) == 4:
            order = entry.order or "wxyz"
            way = next(
                w for w in attitude_ways(order, "rad/s") if w.turns == (entry.turns or "body to world")
            )
            q = read_attitude(q, way)
        return q if len(t) == len(stream.t) and t is stream.t else attitudes(stream, q, t)

    def _axes(self, columns: dict[str, ColumnEntry]) -> None:
        """Axes of world and body that the log does not name, by where the machine speeds up."""
        entry = columns["p"]
        stream = self.log.find(entry.source[0])[0]
        p = stream.columns(*(self.log.find(s)[1] for s in entry.source))
        q = self._known(columns["q"], stream.t)
        found = None if q is None else lean(stream.t, q, p)
        if found is None or found.way not in ("up", "down"):
            self.out.notes.append(f"axes are taken for {self.world} and {self.body}: the log does not tell")
            if found is not None and found.way is not None:
                self.out.open.append(f"positions and attitude have other axes ({found.way})")
            return
        self.body = "FLU" if found.way == "up" else "FRD"
        same = found.up > 0
        self.world = "ENU" if (found.way == "up") == same else "NED"
        self.out.notes.append(
            f"axes are {self.world} and {self.body}: the machine speeds up "
            f"{'along' if found.way == 'up' else 'against'} the lean of the body's third axis"
        )
        rates = columns.get("w")
        if rates is not None and rates.sign == (
            1.0,
            -1.0,
            -1.0,
        ):  # of the body's other handedness, by its name
            columns["w"] = replace(rates, sign=(), body="FRD" if self.body == "FLU" else "FLU")


def _family(entry: ColumnEntry) -> str:
    """What the names of one estimator begin with: the topic, or the first word of the column."""
    stream, slash, column = entry.source[0].rpartition("/")
    return stream if slash else column.partition("_")[0]
