"""Runs from wherever a user has them: a folder, a log, a simulation, arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from nsde_torch.data.mapping.checks import SUSPECT
from nsde_torch.data.mapping.reader import format_of
from nsde_torch.data.raw import Finding, RawRun
from nsde_torch.data.readers import Kind, name_of
from nsde_torch.data.run import DataSet, Run, Split, split
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.faults import remedies
from nsde_torch.recording.reading import assemble
from nsde_torch.recording.reading import read as read_kind
from nsde_torch.simulation.generate import Simulation
from nsde_torch.sysid.readings import better_readings
from nsde_torch.sysid.rough import beginnings, rough_fit
from nsde_torch.sysid.smoothed_states import undone_at_own_rate
from nsde_torch.systems.base import System
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
    given = {"dt": dt, "own_rate": True, "gap": gap, "clock": clock, "derived_rates": derived_rates}
    found = undone_at_own_rate(
        _assembled(data, machine, kind, options or {}, {**given, "most_rows": most_rows, **faults}),
        machine,
        dt=dt,
        stream_offsets=stream_offsets,
        state_smoothing=state_smoothing,
        taken_out=[name for name, value in faults.items() if value],
    )
    return _columns_checked(machine, found) if isinstance(data, str | Path) else found


def _columns_checked(machine: SystemInfo, found: DataSet) -> DataSet:
    """Runs of files; another sign, order or frame in which the declared physics leaves much less is in the summary."""
    # beside columns that kinematics speak against, physics would find what does a little better, and no cause
    suspect = any(one.kind == SUSPECT for one in found.summary.findings)
    if not isinstance(machine, System) or suspect:
        return found
    some = beginnings(found.runs, found.clock_scale, seconds=_PHYSICS_S, fewest=50)
    try:
        rough = rough_fit(machine, some, found.clock_scale)
        better = None if rough is None else better_readings(machine, some, found.clock_scale, rough)
    except (np.linalg.LinAlgError, ValueError):  # runs in which nothing moves say nothing of the columns
        return found
    if not better:
        return found
    said = Finding("reading", "", 1, f"{better.sentence}: {better.remedy}", "reported")
    return replace(found, summary=replace(found.summary, findings=(*found.summary.findings, said)))


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
