"""Runs from wherever a user has them: a folder, a log, a simulation, arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import exp
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from nsde_torch.data.mapping.apply import NUMBERINGS, order
from nsde_torch.data.mapping.checks import SUSPECT, LogCheck
from nsde_torch.data.mapping.reader import format_of
from nsde_torch.data.raw import Finding, RawRun
from nsde_torch.data.readers import Kind, name_of
from nsde_torch.data.run import DataSet, Run, Split, split
from nsde_torch.data.system_info import SystemInfo, changed
from nsde_torch.errors import ConfigError, DataError, NsdeError
from nsde_torch.recording.faults import remedies
from nsde_torch.recording.reading import assemble
from nsde_torch.recording.reading import read as read_kind
from nsde_torch.simulation.generate import Simulation
from nsde_torch.sysid.readings import better_readings, motor_orders
from nsde_torch.sysid.rough import beginnings, left_at, rough_fit
from nsde_torch.sysid.smoothed_states import undone_at_own_rate
from nsde_torch.systems.base import System
from nsde_torch.systems.multirotor import Multirotor
from nsde_torch.systems.options import SystemOptions, system_options
from nsde_torch.threads import one_thread

_PHYSICS_S = 60.0  # of the runs, to which the declared physics is fitted roughly
Data: TypeAlias = str | Path | DataSet | Simulation | Sequence[RawRun]
"""What functions of `nsde_torch` take as data (see `read`)."""


@one_thread()
def read(
    data: Data,
    *,
    system: str | type[System] | SystemOptions | SystemInfo,
    kind: Kind | None = None,
    options: Mapping[str, Any] | None = None,
    dt: float | None = None,
    gap: float | None = None,
    clock: str = "rescale",
    state_smoothing: str = "restore",
    stream_offsets: str = "undo",
    derived_rates: str = "infer",
    most_rows: int | None = None,
    **faults: Mapping[str, float] | None,
) -> DataSet:
    """Read and check runs: units, times, gaps, kinematics; of files also signs and order, by the physics.

    Args:
        data: Folder with one CSV file per run (header row; `t` [s], the states and inputs of the system in SI units,
            and any further channels), a PX4 log or a folder of them, what `nsde_torch.simulate` made, or a list of
            `nsde_torch.data.RawRun` with arrays t (n,), x (n, nx) and u (n, nu). A data set is returned as it is.
        system: The machine: key of `nsde_torch.systems.SYSTEMS`, `module:Class`, a class, or an instance.
        kind: Reader: a key of `nsde_torch.data.READERS`, `module:function` of your own, or the function; None: by the
            names of the files.
        options: Further arguments of the reader.
        dt: Step to resample to [s]; None: the step of the data. A longer one is taken after all checks.
        gap: A longer pause between rows splits a run [s]; None: 2.5 steps of the data.
        clock: What to do when the kinematics disagree with the clock, or with a single rate: "rescale", "trust" or
            "refuse".
        state_smoothing: What to do with states that were smoothed before they were logged, and with inputs that were
            measured and act in another way: "restore" or "keep".
        stream_offsets: What to do with streams whose offsets against others differ between runs: "undo" or "keep".
        derived_rates: What to do with rates that were made of positions, and that no sensor measured: "infer" them
            again from the positions, or "keep".
        most_rows: Rows in all that are used of a longer log, in stretches spread over each run; None: as many as hold
            1.5 million states and inputs.
        faults: What the recording did, to take out, by name of the fault and of the states: `sensor_bias` (what sensors
            read too much, in the unit of the state), `sensor_delay` (by how much states are logged late [s]),
            `sensor_lag` (time constants of filters that states went through [s]); see
            `nsde_torch.recording.RemedyOptions`.

    Returns:
        The data set; `print(data.summary)` reports what was found and done.

    Raises:
        DataError: data that cannot be used; the message says where and what to do.
        ConfigError: an unknown system or kind, or an option out of range.

    Example:
        >>> import nsde_torch
        >>> made = nsde_torch.simulate("mass_spring_damper", durations=[4.0, 4.0], seed=1)
        >>> data = nsde_torch.read(made, system="mass_spring_damper")
        >>> data.names, data.dt
        (('run_0', 'run_1'), 0.01)
    """
    if state_smoothing not in ("restore", "keep"):
        raise ConfigError(f"`state_smoothing` must be restore or keep; got {state_smoothing!r}.")
    if isinstance(data, DataSet):
        return data
    machine: SystemInfo = (
        system_options(system).make() if isinstance(system, str | type | SystemOptions) else system
    )
    given = {"dt": dt, "own_rate": True, "gap": gap, "clock": clock, "derived_rates": derived_rates, **faults}
    given |= {"most_rows": most_rows}
    found = _assembled(data, machine, kind, options or {}, given)
    found = undone_at_own_rate(
        found,
        machine,
        dt=dt,
        stream_offsets=stream_offsets,
        state_smoothing=state_smoothing,
        taken_out=[name for name, value in faults.items() if value],
    )
    return columns_checked(machine, found) if isinstance(data, str | Path) else found


def columns_checked(machine: SystemInfo, found: DataSet) -> DataSet:
    """Runs of files with what their summary says of columns that the physics of the machine contradicts."""
    # beside columns that kinematics speak against, physics would find what does a little better, and no cause
    suspect = any(one.kind == SUSPECT for one in found.summary.findings)
    if not isinstance(machine, System) or suspect:
        return found
    more = (*found.summary.findings, *_columns_otherwise(machine, found))
    return replace(found, summary=replace(found.summary, findings=more))


def _columns_otherwise(machine: System, data: DataSet) -> list[Finding]:
    """Another sign, order or frame of the columns in which the declared physics leaves much less, if there is one."""
    some = beginnings(data.runs, data.clock_scale, seconds=_PHYSICS_S, fewest=50)
    try:
        rough = rough_fit(machine, some, data.clock_scale)
        better = None if rough is None else better_readings(machine, some, data.clock_scale, rough)
    except (np.linalg.LinAlgError, ValueError):  # runs in which nothing moves say nothing of the columns
        return []
    text = better and f"{better.sentence}: {better.remedy}"
    return [Finding("reading", "", 1, text, "reported")] if text else []


def _assembled(
    data: str | Path | Simulation | Sequence[RawRun],
    machine: SystemInfo,
    kind: Kind | None,
    options: Mapping[str, Any],
    given: dict[str, Any],
) -> DataSet:
    if isinstance(data, str | Path):
        return read_kind(kind or format_of(data, machine), machine, path=str(data), **given, **options)
    for name, fault in remedies().items():
        if fault.remedy_first and given.pop(name, None):
            raise ConfigError(f"`{name}` is taken out of files; take it out of arrays of your own before.")
    runs = data.runs if isinstance(data, Simulation) else data
    copies = [RawRun(r.name, r.t.copy(), r.x.copy(), r.u.copy(), dict(r.extra), r.source) for r in runs]
    made = "simulated" if isinstance(data, Simulation) else "arrays"
    return assemble(copies, machine, kind=name_of(kind or made), **given)


def split_runs(
    data: DataSet, test: Sequence[int | str] | None = None, *, test_data: DataSet | None = None
) -> Split:
    """Training runs, and the test: `test` by index or name (None: the last), or all of `test_data`; none is both."""
    if test_data is None:
        return split(data, test)
    left = split(data, test or [])
    train = {run.content_hash: run.name for run in left.train}
    for run in test_data.runs:
        if run.content_hash in train:
            raise DataError(
                f"`data.test_path`: run {run.name!r} has the same content as the training run "
                f"{train[run.content_hash]!r}; a test on training data says nothing."
            )
    return Split(train=left.train, test=tuple(test_data.runs))


def runs_named(data: DataSet, names: Sequence[int | str | Run] | None) -> list[Run]:
    """Runs of a data set, by index or name (a DataError where there is no such run); None: all."""
    if names is None:
        return list(data.runs)
    return [name if isinstance(name, Run) else data[name] for name in names]


_NAME = "signs of the physics"
_DOUBTS = ("constant_state", "same_runs")  # findings of reading that are mended before anything is trained
REFUSED = "mend what reading refuses (`checks` above)"  # the remedy of a check that is a refusal


@dataclass
class PhysicsFound:
    """What the physics says."""

    checks: list[LogCheck] = field(default_factory=list)  # in words
    notes: list[str] = field(default_factory=list)  # what was assumed or found
    numbering: str | None = None
    """Whose numbers the motors have, where the physics speaks for another than was assumed."""


@one_thread()
def check_physics(
    machine: System,
    runs: Sequence[RawRun],
    *,
    numbering: str | None = None,
    fixed: bool = False,
    fits: bool = True,
) -> PhysicsFound:
    """Read runs with all checks, fit the declared physics to means over 0.15 s, and look for better interpretations.

    Args:
        numbering: Whose numbers the motors are taken to have, where others are to be tried; None: they are said.
        fixed: Whether a user said so: another is then reported, and not applied.
        fits: Whether the physics is fitted.
    """
    out = PhysicsFound()
    try:
        data = read(list(runs), system=changed(machine), state_smoothing="restore" if fits else "keep")
    except NsdeError as error:
        out.checks.append(LogCheck("checks of all data", False, str(error), REFUSED))
        return out
    said = (SUSPECT, "log")  # by a check, and by the notes of the log
    for one in data.summary.findings:
        if one.kind in _DOUBTS:
            out.checks.append(LogCheck("what moves, and when", None, f"{one.message}.", one.message))
        elif one.kind not in said:
            out.notes.append(f"reading finds: {one}")
    if not fits:
        return out
    clock, found = data.clock_scale, list(data.runs)
    if numbering is not None and isinstance(machine, Multirotor):
        found = _numbered(machine, found, clock, numbering, fixed, out)
        if out.checks:
            return out
    rough = rough_fit(machine, found, clock)
    if rough is None:
        text = "the log is too short, or says too little, to fit the physics roughly."
        out.checks.append(LogCheck(_NAME, None, text, "record longer runs in which the machine moves"))
        return out
    better = better_readings(machine, found, clock, rough)
    if better is not None:
        out.checks.append(LogCheck(_NAME, False, f"{better.sentence}: {better.remedy}.", better.remedy))
    else:
        left = ", ".join(f"{exp(c.share):.0%} of {c.name}" for c in left_at(rough, rough.theta))
        text = "no other sign, order of the inputs or axes in which the declared physics leaves much less"
        out.checks.append(LogCheck(_NAME, True, f"{text}; it leaves {left}."))
    return out


def _numbered(
    machine: Multirotor, runs: list[Run], clock: float, assumed: str, fixed: bool, out: PhysicsFound
) -> list[Run]:
    """The runs with the motors numbered as their moments say, where they say it surely."""
    motors = machine.nu
    back = np.argsort(order(assumed, motors))
    places: dict[tuple[int, ...], str] = {}
    for name, frames in NUMBERINGS.items():
        if motors in frames:
            places.setdefault(tuple(back[list(order(name, motors))].tolist()), name)
    ranked = motor_orders(machine, runs, clock, list(places))
    if not ranked:
        return runs
    best = ranked[0]
    first, rival = places[best.places], next(o for o in ranked if o.places != best.places)
    same = best.places == tuple(range(motors))
    told = f"{best.nats - rival.nats:.0f} nats likelier than with {places[rival.places]}"
    if not best.surely_better(rival):
        out.notes.append(
            f"moments of motors numbered as in {first} are no more than {told}: check the numbers"
        )
        return runs
    if fixed and not same:
        now = next(o for o in ranked if o.places == tuple(range(motors)))
        text = f"moments of motors numbered as in {first} are {best.nats - now.nats:.0f} nats likelier."
        remedy = f"write `numbering: {first}` in the entry of the motors"
        out.checks.append(LogCheck("numbering of the motors", False, text, remedy))
        return runs
    out.notes.append(f"motors are numbered as in {first}: their moments are {told}")
    if same:
        return runs
    out.numbering = first
    own = [*best.places, *range(motors, runs[0].u.shape[1])]
    return [replace(run, u=run.u[:, own]) for run in runs]
