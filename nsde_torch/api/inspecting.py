"""What is in a log, what its columns mean to a system, and whether that is so."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from math import exp
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.api.reading import read
from nsde_torch.data.mapping.apply import NUMBERINGS, apply, order
from nsde_torch.data.mapping.checks import SUSPECT, LogCheck, checks, together
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, read_mapping, targets, text
from nsde_torch.data.mapping.proposal import Proposal, propose
from nsde_torch.data.mapping.reader import LogFile, format_of, log_files, scaled_by_all
from nsde_torch.data.places import files_of, log_place
from nsde_torch.data.raw import RawRun
from nsde_torch.data.readers import READERS, reader
from nsde_torch.data.run import Run
from nsde_torch.data.streams import ClockOf, StreamLog, moving
from nsde_torch.data.system_info import changed
from nsde_torch.data.ulog import open_ulog
from nsde_torch.errors import ConfigError, DataError, NsdeError
from nsde_torch.sysid.readings import better_readings, motor_orders
from nsde_torch.sysid.rough import left_at, rough_fit
from nsde_torch.systems.base import System
from nsde_torch.systems.multirotor import Multirotor
from nsde_torch.systems.options import SystemOptions, system_options
from nsde_torch.threads import one_thread
from nsde_torch.whole_files import finite

_RUNS = 3  # that physics are looked at
_PAUSES = 5.0  # steps that are a gap
_SIGNS = "signs of the physics"
_DOUBTS = ("constant_state", "same_runs")  # findings of reading that are mended before anything is trained
REFUSED = "mend what reading refuses (`checks` above)"  # the remedy of a check that is a refusal


@dataclass(frozen=True)
class ColumnRow:
    """One column of a log."""

    stream: str  # of which topic or table
    column: str  # name
    unit: str  # where the log says it
    rows: int  # how many
    rate: float  # median rate [Hz]; nan without a clock
    low: float  # smallest value
    high: float  # largest value
    missing: float  # share of values that are not finite
    gaps: int  # pauses longer than five steps and 0.25 s


@dataclass
class Inspection:
    """What `inspect` found."""

    path: str  # what was looked at
    kind: str  # the reader of its format
    runs: list[str]  # names of the runs
    columns: list[ColumnRow]  # what is in the first
    system: str  # name of the system
    mapping: LogMapping | None = None
    """What the columns mean, with an empty entry for what is missing; None where the format needs none."""
    native: bool = False  # whether the reader needs no mapping
    missing: list[str] = field(default_factory=list)  # what was not found
    open: list[str] = field(default_factory=list)  # what else the columns could be
    notes: list[str] = field(default_factory=list)  # what was assumed
    checks: list[LogCheck] = field(default_factory=list)  # what kinematics and physics say

    @property
    def usable(self) -> bool:
        """Whether runs can be read: all is there, and no check fails."""
        return (self.native or (self.mapping is not None and not self.missing)) and not self.refused

    @property
    def refused(self) -> bool:
        """Whether a check fails."""
        return any(check.passed is False for check in self.checks)

    @property
    def doubts(self) -> list[str]:
        """What to mend before anything is trained, the surest first; empty where nothing speaks against it."""
        first = [check.remedy or check.text for check in self.checks if check.passed is False]
        return first + [check.remedy for check in self.checks if check.passed is None and check.remedy]

    def content(self) -> dict[str, Any]:
        """What was found as plain containers for a JSON file; a number that is not finite is None."""
        entries = () if self.mapping is None else self.mapping.columns.values()
        mapped = sorted({name for entry in entries for name in entry.source})
        more = {"usable": self.usable, "doubts": self.doubts, "mapping": self.yaml, "mapped": mapped}
        return finite({**asdict(self), **more})

    @property
    def yaml(self) -> str:
        """The mapping as YAML; empty without one."""
        return "" if self.mapping is None else text(self.mapping)


@one_thread()
def inspect(
    path: str | Path,
    *,
    system: str | type[System] | SystemOptions | None = None,
    kind: str | None = None,
    mapping: str | Path | LogMapping | None = None,
    physics: bool = True,
) -> Inspection:
    """List what is in a log or a folder of logs, propose what its columns mean, and check it.

    Args:
        path: File or folder.
        system: The machine; None: guessed by what is logged.
        kind: Reader, a key of `nsde_torch.data.READERS`; None: by the names of the files.
        mapping: A mapping to check in place of a proposal, or its YAML file.
        physics: Whether to fit the declared physics, roughly, and look for signs and orders in which it leaves less.

    Raises:
        DataError: nothing there, or a log that cannot be read.
        ConfigError: an unknown system, or a mapping that does not fit.

    Example:
        >>> found = nsde_torch.inspect("flights", system="quadrotor")  # doctest: +SKIP
        >>> print(found.yaml)  # doctest: +SKIP
    """
    log_place(path, "a log or a folder of logs")
    machine = None if system is None else system_options(system).make()
    kind = kind or format_of(path, machine)
    if kind not in READERS:
        raise ConfigError(f"`kind` must be one of {', '.join(READERS)}; got {kind!r}.")
    given = read_mapping(mapping) if isinstance(mapping, str | Path) else mapping
    if kind == "published":
        own = machine or system_options("hexacopter").make()
        reader(kind)(own, path=path)  # a pickle that is none says so
        raise DataError(
            f"`path`: {path} holds the published files, which `data=published` reads as they are."
        )
    if READERS[kind].streams is None and given is None:
        native = _native(Path(path), kind, machine, physics=physics)
        refused = [check.text for check in native.checks if check.remedy == REFUSED]
        if kind != "csv" or not refused:
            return native
        mapped = _mapped(path, kind, machine, None, physics=physics)
        note = f"read through a mapping, as the package's own reader refuses it: {refused[0]}"
        mapped.notes.insert(0, note)
        own = machine or system_options(mapped.system).make()
        try:
            there = mapped.usable and reader(mapped.kind)(own, path=path, mapping=mapped.mapping)
        except NsdeError:
            there = []
        return mapped if there else native
    return _mapped(path, kind, machine, given, physics=physics)


def _mapped(
    path: str | Path, kind: str, machine: System | None, given: LogMapping | None, *, physics: bool
) -> Inspection:
    """A log whose columns mean what a mapping says."""
    files = log_files("table" if kind == "csv" else kind, path)
    log = files[0].open(given.time if given else None)
    guessed = machine or system_options((given and given.system) or guess_system(log)).make()
    found = Proposal(given) if given else propose(log, guessed, kind=files[0].kind)
    if given is None:
        found.mapping = scaled_by_all(_with_blanks(found.mapping, guessed, files[0].kind, log), log, files)
    out = Inspection(
        str(path), files[0].kind, [file.name for file in files], rows_of(log), guessed.name, found.mapping,
        missing=found.missing, open=found.open, notes=[*log.notes, *found.notes],
    )  # fmt: skip
    if machine is None and not (given and given.system):
        note = f"the system is taken for {guessed.name!r}, by what is logged (`system=` says another)"
        out.notes.insert(0, note)
    if found.missing:
        return out
    assert out.mapping is not None
    entry = out.mapping.columns.get("u")
    said = entry is None or "u" in log.columns
    numbering = None if entry is None or said else entry.numbering or "px4"
    runs_of = partial(_applied, out, files, log, guessed)
    numbers = _judge(out, guessed, runs_of, physics=physics, numbering=numbering, fixed=given is not None)
    if numbers is not None:
        out.mapping = out.mapping.changed("u", numbering=numbers)
        out.notes = [note for note in out.notes if "taken to be numbered" not in note]
    return out


def _with_blanks(mapping: LogMapping | None, machine: System, kind: str, log: StreamLog) -> LogMapping:
    """A proposal with an empty entry for what was not found: what is left to fill in, in its place."""
    mapping = mapping or LogMapping({}, machine.name, kind, log.clock or ClockOf())
    rates = {rate for _, rate, _ in machine.position_derivatives} if machine.quaternion is None else set()
    there = {name for key in mapping.columns for name in targets(machine, key)}
    own = (*machine.state_names, *machine.input_names, *machine.exogenous)
    left = [n for n in own if n not in {*there, *rates, *machine.optional_inputs}]
    if machine.quaternion is not None:  # groups, as `p` for `p_x p_y p_z`
        left = list(dict.fromkeys(name.partition("_")[0] for name in left))
    return replace(mapping, columns={**mapping.columns, **{name: ColumnEntry(()) for name in left}})


def _applied(out: Inspection, files: Sequence[LogFile], log: StreamLog, machine: System) -> list[RawRun]:
    """The first runs, as the mapping reads them."""
    assert out.mapping is not None
    runs = [apply(log, out.mapping, machine)]
    for file in files[1:_RUNS]:
        try:
            runs.append(apply(file.open(out.mapping.time), out.mapping, machine))
        except NsdeError as error:
            out.notes.append(f"{file.name} cannot be read: {error}")
    return runs


def _native(path: Path, kind: str, machine: System | None, *, physics: bool) -> Inspection:
    """A log whose reader needs no mapping."""
    suffixes = READERS[kind].suffixes or (".csv",)
    files = [path] if path.is_file() else files_of(path, suffixes)
    if not files:
        raise DataError(f"`path`: {path} holds no file of the kind {kind!r} ({', '.join(suffixes)}).")
    # the package's own tables are in seconds, whatever the steps look like: a heater every 2 s was at 500 Hz
    seconds = ClockOf(unit="s") if kind == "csv" else None
    log = open_ulog(files[0]) if kind == "ulog" else LogFile(files[0].stem, files[0], "table").open(seconds)
    machine = machine or system_options(_px4_frame(log) if kind == "ulog" else guess_system(log)).make()
    out = Inspection(str(path), kind, [p.stem for p in files], rows_of(log), machine.name, native=True)
    runs_of = partial(reader(kind), machine, path=files[0] if kind == "ulog" else path)
    _judge(out, machine, runs_of, physics=physics)
    return out


def _judge(
    out: Inspection,
    machine: System,
    runs_of: Callable[[], list[RawRun]],
    *,
    physics: bool,
    numbering: str | None = None,
    fixed: bool = False,
) -> str | None:
    """Kinematics, gravity and all checks of reading; physics, fitted to means over 0.15 s, and better interpretations.

    `numbering`: whose numbers the motors are taken to have, where others are to be tried, `fixed`: which a user said;
    whose they have is returned, where the physics speaks for another.
    """
    try:
        runs = runs_of()
    except NsdeError as error:
        out.checks = [LogCheck("reading", False, str(error), REFUSED)]
        return None
    out.checks = checks(machine, together(runs), out.mapping)
    if out.refused:
        return None
    # beside a doubt, physics would find an interpretation that is a little better, and no cause
    fits = physics and not out.doubts
    try:
        data = read(runs[:_RUNS], system=changed(machine), state_smoothing="restore" if fits else "keep")
    except NsdeError as error:
        out.checks.append(LogCheck("checks of all data", False, str(error), REFUSED))
        return None
    said = (SUSPECT, "log")  # by a check, and by the notes of the log
    for one in data.summary.findings:
        if one.kind in _DOUBTS:
            out.checks.append(LogCheck("what moves, and when", None, f"{one.message}.", one.message))
        elif one.kind not in said:
            out.notes.append(f"reading finds: {one}")
    if not fits:
        return None
    clock, found, other = data.clock_scale, list(data.runs), None
    if numbering is not None and isinstance(machine, Multirotor):
        numbered = _numbered(machine, found, clock, numbering, fixed, out)
        if numbered is None:
            return None
        found, other = numbered
    rough = rough_fit(machine, found, clock)
    better = None if rough is None else better_readings(machine, found, clock, rough)
    if rough is None:
        text = "the log is too short, or says too little, to fit the physics roughly."
        check = LogCheck(_SIGNS, None, text, "record longer runs in which the machine moves")
    elif better is not None:
        check = LogCheck(_SIGNS, False, f"{better.sentence}: {better.remedy}.", better.remedy)
    else:
        left = ", ".join(f"{exp(c.share):.0%} of {c.name}" for c in left_at(rough, rough.theta))
        text = "no other sign, order of the inputs or axes in which the declared physics leaves much less"
        check = LogCheck(_SIGNS, True, f"{text}; it leaves {left}.")
    out.checks.append(check)
    return other


def _numbered(
    machine: Multirotor, runs: list[Run], clock: float, assumed: str, fixed: bool, out: Inspection
) -> tuple[list[Run], str | None] | None:
    """The runs with the motors numbered as their moments say surely, and whose numbers these are where not `assumed`.

    None where a user said otherwise, which is a check that fails.
    """
    motors = machine.nu
    back = np.argsort(order(assumed, motors))
    places: dict[tuple[int, ...], str] = {}
    for name, frames in NUMBERINGS.items():
        if motors in frames:
            places.setdefault(tuple(back[list(order(name, motors))].tolist()), name)
    ranked = motor_orders(machine, runs, clock, list(places))
    if not ranked:
        return runs, None
    best = ranked[0]
    first, rival = places[best.places], next(o for o in ranked if o.places != best.places)
    same = best.places == tuple(range(motors))
    told = f"{best.nats - rival.nats:.0f} nats likelier than with {places[rival.places]}"
    if not best.surely_better(rival):
        out.notes.append(
            f"moments of motors numbered as in {first} are no more than {told}: check the numbers"
        )
        return runs, None
    if fixed and not same:
        now = next(o for o in ranked if o.places == tuple(range(motors)))
        text = f"moments of motors numbered as in {first} are {best.nats - now.nats:.0f} nats likelier."
        remedy = f"write `numbering: {first}` in the entry of the motors"
        out.checks.append(LogCheck("numbering of the motors", False, text, remedy))
        return None
    out.notes.append(f"motors are numbered as in {first}: their moments are {told}")
    if same:
        return runs, None
    own = [*best.places, *range(motors, runs[0].u.shape[1])]
    return [replace(run, u=run.u[:, own]) for run in runs], first


def _px4_frame(log: StreamLog) -> str:
    """By how many motors moved."""
    motors = [s.fields for s in log.streams if s.name == "actuator_motors"][:1]
    controls = [values for fields in motors for name, values in fields.items() if name.startswith("control[")]
    return "hexacopter" if sum(bool(moving(v[:, None])[0]) for v in controls) == 6 else "quadrotor"


def guess_system(log: StreamLog) -> str:
    """Name of a system of the package by what is logged."""
    from nsde_torch.data.mapping import names

    found = [one for stream in log.streams for one in names.vectors(stream)]
    motors = log.columns.get("u", {}).get("from", ())
    count = len(motors) if isinstance(motors, list) else 0
    for one in names.pick(found, names.MOTORS):
        several = int(moving(log.stream(one.stream).columns(*one.columns)).sum())
        count = count or (several if several in (4, 6) else 0)
    attitude = any(one.kind in (names.QUATERNION, names.EULER) for one in found) or "q" in log.columns
    if count == 6:
        return "hexacopter"
    if count == 4 or attitude:
        return "quadrotor"
    columns = {column for stream in log.streams for column in stream.fields}
    return "cartpole" if {"theta", "theta_dot"} & columns else "mass_spring_damper"


def rows_of(log: StreamLog) -> list[ColumnRow]:
    """A row for each column of a log."""
    out = []
    for stream in log.streams:
        steps = np.diff(stream.t) if stream.timed else np.zeros(0)
        usual = float(np.median(steps)) if len(steps) else float("nan")
        gaps = int((steps > max(_PAUSES * usual, 0.25)).sum()) if len(steps) else 0
        for column, values in stream.fields.items():
            good = values[np.isfinite(values)]
            low, high = (float(good.min()), float(good.max())) if len(good) else (float("nan"), float("nan"))
            missing = 1.0 - len(good) / max(len(values), 1)
            about = stream.units.get(column, ""), len(values), stream.rate, low, high, missing, gaps
            out.append(ColumnRow(stream.name, column, *about))
    return out
