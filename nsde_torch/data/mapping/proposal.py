"""What the columns of a log are likely to mean to a system: by what the format says, by names, and by kinematics.

Names say which columns are a position, a velocity, an attitude, rates, motors; where they leave open how (order of a
quaternion, degrees, axes), the reading that kinematics contradict least is proposed. Several sources of one quantity
make a proposal ambiguous: it is shown, and not used unseen.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.formats.clock import ClockOf
from nsde_torch.data.formats.log import StreamLog
from nsde_torch.data.mapping import nameless
from nsde_torch.data.mapping import names as kinds
from nsde_torch.data.mapping.inputs import propose_inputs
from nsde_torch.data.mapping.kinematic import (
    NOISY_VELOCITY,
    SOUND_ATTITUDE,
    attitude_left,
    attitude_ways,
    best,
    lean,
    read_attitude,
    velocity_left,
    velocity_ways,
)
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, mapping_of
from nsde_torch.data.mapping.names import Named
from nsde_torch.data.mapping.single import propose_single
from nsde_torch.data.quaternion import from_euler_zyx
from nsde_torch.data.streams import Stream, attitudes, linear, moving
from nsde_torch.data.system_info import SystemInfo

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
    called = nameless.called(log, system)
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
