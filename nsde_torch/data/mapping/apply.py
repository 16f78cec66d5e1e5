"""A log through a mapping: one run in the system's units, axes and order.

The rows are those of the stream of the attitude, else of the first state. What was logged on other clocks is put on
them: states interpolated, commands held (of a faster stream: the mean input during the step).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, targets
from nsde_torch.data.mapping.names import factor
from nsde_torch.data.quaternion import (
    attitude_between,
    conjugate,
    from_euler_zyx,
    rotate,
    swap_body,
    swap_world,
)
from nsde_torch.data.raw import Finding, RawRun, run_of
from nsde_torch.data.streams import Stream, StreamLog, attitudes, commands, linear
from nsde_torch.data.system_info import RATE_NAMES, SystemInfo
from nsde_torch.errors import ConfigError, DataError

# Which motor is which: how firmwares number the motors of an X frame, against PX4's numbers.
#
# Sources: PX4 airframe reference (quad-x, hexa-x), ArduPilot's motor diagrams (the same numbers for these two
# frames), Betaflight's mixer tables (QUAD X, HEX X), Crazyflie's diagram (M1 front right, then clockwise).

NUMBERINGS: dict[str, dict[int, tuple[int, ...]]] = {
    "px4": {4: (1, 2, 3, 4), 6: (1, 2, 3, 4, 5, 6)},
    "ardupilot": {4: (1, 2, 3, 4), 6: (1, 2, 3, 4, 5, 6)},
    # 1 rear right, 2 front right, 3 rear left, 4 front left, 5 right, 6 left
    "betaflight": {4: (2, 3, 4, 1), 6: (5, 6, 4, 1, 2, 3)},
    # 1 front right, 2 rear right, 3 rear left, 4 front left
    "crazyflie": {4: (1, 3, 4, 2)},
}
"""Numbers of a firmware's motors in the order of PX4's: quadrotors front right, rear left, front left, rear right;
hexacopters right, left, front left, rear right, front right, rear left."""


def order(numbering: str, motors: int) -> tuple[int, ...]:
    """Places, from 0, of a firmware's motors in the order of PX4's; a ConfigError where they are not known."""
    if numbering not in NUMBERINGS:
        raise ConfigError(f"`numbering` must be one of {', '.join(NUMBERINGS)}; got {numbering!r}.")
    frames = NUMBERINGS[numbering]
    if motors not in frames:
        raise ConfigError(
            f"the numbering {numbering!r} is known of {' and '.join(map(str, frames))} motors; got {motors}. List the "
            "motors in the order of PX4's, and leave `numbering` out."
        )
    return tuple(number - 1 for number in frames[motors])


SLOWEST = 4.0  # slowest rate of a state, or of an input of a machine without motors of its own [Hz]
MOTOR_RATE = 50.0  # slowest rate of motors [Hz], which answer within 50 ms
_FAR = 0.8  # share of the rows' rate below which a stream is reported as slow
_BEYOND = 0.05
"""Share of the readings of inputs that may lie outside their range (Neural-Fly's flights in still air: 46 % of their
pulses are below 1000, and were taken for 0)."""
_VALUES = 10  # number of values from which readings outside the range are no resting value


def apply(log: StreamLog, mapping: LogMapping, system: SystemInfo) -> RawRun:
    """One run from one log.

    A ConfigError refuses a column that the log does not have, an entry that does not fit the system, or a unit; a
    DataError a stream without a clock, too slow, or at another time than the others.
    """
    return _Applied(log, mapping, system).run()


class _Applied:
    def __init__(self, log: StreamLog, mapping: LogMapping, system: SystemInfo) -> None:
        self.log, self.system = log, system
        self.names = {name: targets(system, name) for name in mapping.columns}
        self.notes = [Finding("log", log.name, 1, note, "reported") for note in log.notes]
        self.mapping = self._with_what_is_there(mapping)
        q = () if system.quaternion is None else tuple(system.state_names[system.quaternion])
        self.attitude = next((name for name in self.mapping.columns if self.names[name] == q), None)
        names, units = (*system.state_names, *system.input_names), (*system.state_units, *system.input_units)
        self.units = dict(zip(names, units, strict=True))
        self.columns: dict[str, Array] = {}
        self._complete()
        self.base = self._rows()
        self.t = self.base.t

    def run(self) -> RawRun:
        if self.attitude is not None:
            self._read_attitude(self.attitude)
        for name, entry in self.mapping.columns.items():
            if name != self.attitude:
                self._fill(name, entry)
        t = self.t - self.t[0]
        run = run_of(self.columns, t, self.system, name=self.log.name, source=self.log.source)
        run.notes += self.notes
        slow = sorted({s.name for s in self._used() if s.rate < _FAR * self.base.rate and s.name})
        if slow:
            told = f"streams slower than {self.base.name} ({self.base.rate:.3g} Hz): {', '.join(slow)}"
            run.notes.append(Finding("slow_topic", run.name, len(slow), told, "interpolated, commands held"))
        return run

    # ---- what there must be ----------------------------------------------------------------------------

    def _with_what_is_there(self, mapping: LogMapping) -> LogMapping:
        """The mapping without channels that the machine does not need and this log does not have."""
        needed = {*self.system.state_names, *self.system.input_names, *self.system.exogenous}
        kept = {}
        for name, entry in mapping.columns.items():
            if not needed & set(self.names[name]) and not all(map(self.log.has, entry.source)):
                text = f"no column {', '.join(entry.source)} for the channel {name!r}"
                self.notes.append(Finding("channel", self.log.name, 1, text, "reported"))
                continue
            kept[name] = entry
        return replace(mapping, columns=kept)

    def _complete(self) -> None:
        """Every state and input has one entry of the right width."""
        system, given = self.system, [one for names in self.names.values() for one in names]
        twice = sorted({name for name in given if given.count(name) > 1})
        if twice:
            raise ConfigError(f"the mapping says twice where {twice[0]!r} comes from; keep one of them.")
        rates = {rate for _, rate, _ in system.position_derivatives} if system.quaternion is None else set()
        needed = (*system.state_names, *system.input_names, *system.exogenous)
        missing = [n for n in needed if n not in given and n not in system.optional_inputs and n not in rates]
        if missing:
            raise ConfigError(
                f"the mapping of {self.log.source} says nothing of {', '.join(missing)}, which the system "
                f"{system.name!r} needs. Add entries to `columns:`, or choose a system of what was logged."
            )
        for name, entry in self.mapping.columns.items():
            wanted, got = len(self.names[name]), len(entry.source)
            if wanted != got and not (got == 3 and name == self.attitude):
                raise ConfigError(
                    f"the mapping gives {got} column(s) for {name!r}, and {system.name!r} has {wanted}: "
                    f"{', '.join(self.names[name])}."
                )

    def _rows(self) -> Stream:
        """The stream whose rows the run has."""
        if self.system.quaternion is not None and self.attitude is None:
            raise ConfigError("the mapping has no entry `q` of all of the attitude; it is read as a whole.")
        state = next(n for n in self.mapping.columns if self.names[n][0] in self.system.state_names)
        base = self._stream(self.mapping.columns[self.attitude or state])
        for stream in self._used():
            if not stream.timed:
                raise DataError(
                    f"{self.log.source}: {stream.name or 'the table'} has no column of times. Say which it is, `time: "
                    "{from: NAME, unit: s}` in the mapping, or how fast it was logged, `time: {rate: 100}`."
                )
            apart = min(stream.t[-1], base.t[-1]) - max(stream.t[0], base.t[0])
            if apart <= 0:
                raise DataError(
                    f"{self.log.source}: {stream.name!r} ({stream.t[0]:.6g} to {stream.t[-1]:.6g} s) and {base.name!r} "
                    f"({base.t[0]:.6g} to {base.t[-1]:.6g} s) have no time in common: two clocks, or two recordings."
                )
        self._fast_enough()
        return base

    def _fast_enough(self) -> None:
        """Refuse what was logged too slowly to say how a machine moves."""
        system = self.system
        for name, entry in self.mapping.columns.items():
            if self.names[name][0] not in (*system.state_names, *system.input_names):
                continue
            motors = system.quaternion is not None and self.names[name][0] in system.input_names
            slowest = entry.slowest or (MOTOR_RATE if motors else SLOWEST)
            stream = self._stream(entry)
            if stream.rate < 0.95 * slowest:
                why = ", as gains and lags come out wrong of commands that change unseen" if motors else ""
                raise DataError(
                    f"{self.log.source}: {name!r} ({stream.name or entry.source[0]}) was logged at {stream.rate:.3g} "
                    f"Hz; at least {slowest:g} Hz are needed{why}. Log it faster, or read it all the same with "
                    f"`slowest: {max(np.floor(stream.rate), 0.01):g}` in its entry of the mapping."
                )

    def _stream(self, entry: ColumnEntry) -> Stream:
        return self.log.find(entry.source[0])[0]

    def _used(self) -> list[Stream]:
        found = [self.log.find(s)[0] for e in self.mapping.columns.values() for s in e.source]
        return list({id(stream): stream for stream in found}.values())

    # ---- columns ---------------------------------------------------------------------------------------

    def _values(self, entry: ColumnEntry, *, held: bool) -> Array:
        """The columns of an entry on the rows of the run, in its own units, (n, k)."""
        out = []
        for source in entry.source:
            stream, column = self.log.find(source)
            own = stream.fields[column][:, None]
            out.append(own if stream is self.base else (commands if held else linear)(stream, own, self.t))
        return np.concatenate(out, axis=1) * np.array(entry.sign or 1.0) * entry.scale

    def _read_attitude(self, name: str) -> None:
        entry = self.mapping.columns[name]
        if len({id(self.log.find(source)[0]) for source in entry.source}) > 1:
            raise ConfigError(
                f"the mapping reads {name!r} from several streams; an attitude is read from one."
            )
        stream = self._stream(entry)
        values = stream.columns(*(self.log.find(source)[1] for source in entry.source))
        values = values * np.array(entry.sign or 1.0) * entry.scale
        if len(entry.source) == 3:
            values = from_euler_zyx(values * factor(entry.unit or "rad", "rad", what=f"columns.{name}"))
        else:
            length = np.linalg.norm(values, axis=1, keepdims=True)
            values = np.where(length > 0.5, values, np.nan)  # before the first fix, quaternions are zero
            if entry.order == "xyzw":
                values = values[:, [3, 0, 1, 2]]
        if entry.turns == "world to body":
            values = conjugate(values)
        ned, frd = self.mapping.axes_of(entry)
        values = attitude_between(values, ned=ned, frd=frd)
        if stream is not self.base:
            values = attitudes(stream, values, self.t)
        self.columns |= zip(self.names[name], values.T, strict=True)

    def _fill(self, name: str, entry: ColumnEntry) -> None:
        system, names = self.system, self.names[name]
        inputs = names[0] in system.input_names
        values = self._values(entry, held=inputs)
        if inputs:
            values = self._commands(name, entry, values)
        else:
            for place, column in enumerate(names):
                target = self.units.get(column)
                if target is not None and entry.unit is not None:
                    values[:, place] *= factor(entry.unit, target, what=f"columns.{name}")
            values = self._turned(names, entry, values)
        self.columns |= zip(names, values.T + entry.offset, strict=True)

    def _turned(self, names: Sequence[str], entry: ColumnEntry, values: Array) -> Array:
        """Vectors of the world to ENU, those of the body to FLU; a velocity of the body to the world."""
        system, (ned, frd) = self.system, self.mapping.axes_of(entry)
        if tuple(names) == RATE_NAMES:
            return swap_body(values) if frd else values
        if system.quaternion is None or len(names) != 3:
            return values
        moved = {one for p, v, frame in system.position_derivatives if frame == "world" for one in (p, v)}
        if not set(names) <= moved:
            return values
        if entry.axes == "body":
            values = swap_body(values) if frd else values
            q = np.stack([self.columns[c] for c in system.state_names[system.quaternion]], axis=1)
            return rotate(q / np.linalg.norm(q, axis=1, keepdims=True), values)
        return swap_world(values) if ned else values

    def _commands(self, name: str, entry: ColumnEntry, values: Array) -> Array:
        """Inputs in the system's unit and order."""
        if entry.low is not None and entry.high is not None:
            share = (values - entry.low) / (entry.high - entry.low)
            beyond = values[(share < 0.0) | (share > 1.0)]
            # one value is what is written while disarmed
            if beyond.size > _BEYOND * values.size and len(np.unique(beyond)) > _VALUES:
                raise DataError(
                    f"{self.log.source}: inputs are {np.nanmin(values):.6g} to {np.nanmax(values):.6g}, and "
                    f"{beyond.size / values.size:.0%} of them lie outside `low: {entry.low:g}` and "
                    f"`high: {entry.high:g}` of the mapping; write the readings that mean 0 and 1, or `full`, if these "
                    "are speeds of rotors."
                )
            values = np.clip(share, 0.0, 1.0)
        elif entry.full is not None:
            most = float(np.nanmax(values, initial=0.0))
            if most > 1.02 * entry.full:  # a square of 1.05, which is refused
                raise DataError(
                    f"{self.log.source}: a rotor turns at {most:.6g}, above the `full: {entry.full:g}` of the mapping; "
                    "write a `full` above the greatest speed of all runs."
                )
            values = np.square(values / entry.full)
        elif entry.unit is not None:
            for place, column in enumerate(self.names[name]):
                values[:, place] *= factor(entry.unit, self.units[column] or "1", what=f"columns.{name}")
        if entry.numbering is not None:
            values = values[:, list(order(entry.numbering, values.shape[1]))]
        return values
