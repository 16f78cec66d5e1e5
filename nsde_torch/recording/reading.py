"""From files to a data set: every fault of a recording is found and handled, reported or refused, in a fixed order.

time order and duplicates -> interpolated columns -> quaternion norm and sign -> missing values -> single samples
that are off -> sensors that repeat themselves -> time on the ground -> gaps in time -> one uniform step -> hidden gaps
(jumps against the kinematics) -> columns that stand still -> other conventions of quaternion and velocity, columns of
another run -> clock against the kinematics -> sensors that are late against others -> range and rank of the inputs ->
summary

All of this is done at the rate of the log. A longer step is taken at last.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import inputs, interventions, kinematics
from nsde_torch.data.mapping.checks import together
from nsde_torch.data.pace import at_their_pace
from nsde_torch.data.raw import Finding, RawRun, Report
from nsde_torch.data.readers import READERS, Kind, name_of, reader
from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.summary import data_set_of
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import clock_and_biases, columns, noise, standstill, times, unmeasured_rates
from nsde_torch.recording.fault import Fault
from nsde_torch.recording.faults import in_order, remedies
from nsde_torch.recording.latency import late_channels, latency_findings, surely_late

_FINER = 1000  # steps of the data are divided into that many at most
SHORT_S = 2.0 * kinematics.MIN_INTERVALS * kinematics.INTERVAL_S
"""Runs shorter than this are measured together against the clock [s]; each alone has too few intervals."""


def read(kind: Kind, system: SystemInfo, *, path: str, dt: float | None = None, **options: Any) -> DataSet:
    """Reads and checks a data set.

    Args:
        kind: Key of `READERS`, `module:function` of the user's own, or the function.
        system: The system that the data belong to.
        path: File or folder, as the kind says.
        dt: Step [s]; default: the data's own (the nominal step of a published file, else the median).
        options: Those of `assemble`: `gap`, `clock`, `derived_rates`, `own_rate`, `most_rows`, and what the recording
            did, to take out (`sensor_bias={"q": 0.1}`, see `RemedyOptions`); and further options of the kind.

    Returns:
        The data set with its summary.

    Raises:
        ConfigError: an unknown kind or option.
        DataError: data that cannot be used; the message says where and what to do.
    """
    make, name = reader(kind), name_of(kind)
    own = ("gap", "clock", "derived_rates", "own_rate", "most_rows")
    how = {option: options.pop(option) for option in own if option in options}
    asked = {fault: options.pop(fault) for fault in remedies() if fault in options}
    if dt is not None and name in READERS and READERS[name].takes_step:
        options["dt"] = dt
    if not path:
        raise ConfigError(f"`path` is empty; data of kind {name!r} need the path of a file or folder.")
    raw = _called(make, name, system, path=path, **options)
    for fault in [fault for fault in asked if remedies()[fault].remedy_first]:
        values = asked.pop(fault) or {}
        named = {run.name for run in raw}
        strange = sorted(k for k, v in values.items() if isinstance(v, Mapping) and k not in named)
        if strange:
            raise ConfigError(
                f"`{fault}` names {strange[0]!r}, which is no run; runs are {', '.join(sorted(named))}."
            )
        for run in raw if values else ():
            remedies()[fault].undo_raw(run, system, values)
    return assemble(raw, system, kind=name, dt=dt, **how, **asked)


def _called(make: Callable[..., Any], name: str, system: SystemInfo, **given: Any) -> Sequence[RawRun]:
    """What a reader returns, once its arguments are found to be those of a reader."""
    try:
        inspect.signature(make).bind(system, **given)
    except (TypeError, ValueError) as error:  # other arguments, or a function in C without a signature
        raise ConfigError(
            f"data of kind {name!r}: {error}. A reader is a function `read(system, *, path, ...)`."
        ) from error
    raw: Sequence[RawRun] = make(system, **given)
    if not isinstance(raw, Sequence) or not all(isinstance(run, RawRun) for run in raw):
        raise ConfigError(
            f"data of kind {name!r}: a reader returns a list of `nsde_torch.data.RawRun`; got {type(raw).__name__}."
        )
    return raw


def _split_at_jumps(
    system: SystemInfo, run: RawRun, segments: tuple[tuple[int, int], ...], dt: float, report: Report
) -> tuple[tuple[int, int], ...]:
    jumps = [
        (a + row, group, size, lost)
        for a, b in segments
        for row, group, size, lost in kinematics.find_jumps(system, run.x[a:b], dt=dt)
    ]
    if not jumps:
        return segments
    cuts = sorted({row for segment in segments for row in segment} | {row + 1 for row, *_ in jumps})
    kept = tuple((a, b) for a, b in pairwise(cuts) if b - a >= 2)
    axes = {group: positions for group, (positions, _) in kinematics.pairs_of(system).items()}
    shown = ", ".join(
        f"{size:.3g} in {kinematics.called(group, axes[group])} after row {row}, about {lost:.2g} s lost"
        for row, group, size, lost in jumps[:3]
    )
    text = f"{len(jumps)} jumps without a gap in the clock ({shown}{', ...' if len(jumps) > 3 else ''})"
    rows, groups, sizes, missing = map(list, zip(*jumps, strict=True))
    values = {"rows": rows, "sizes": sizes, "groups": groups, "missing_s": missing}
    report(Finding("hidden_gap", run.name, len(jumps), text, "split", values))
    return kept


def _check_twins(runs: Sequence[Run], report: Report) -> None:
    """Report runs that are copies of others: evidence counts them twice, and a test on them says nothing."""
    first: dict[str, str] = {}
    twins = [
        (run.name, twin) for run in runs if (twin := first.setdefault(run.content_hash, run.name)) != run.name
    ]
    if twins:
        shown = ", ".join(f"{name!r} is {twin!r}" for name, twin in twins[:5]) + ", ..." * (len(twins) > 5)
        text = f"runs that hold the same rows as others ({shown}): keep one of each"
        report(Finding("same_runs", "", len(twins), text, "reported", {"runs": [name for name, _ in twins]}))


def _asked(faults: Mapping[str, Mapping[str, float] | None]) -> list[tuple[Fault, Mapping[str, float]]]:
    """Faults that a reader was asked to take out, in the order in which they are undone."""
    known = {name: fault for name, fault in remedies().items() if not fault.remedy_first}
    unknown = sorted(set(faults) - set(known))
    if unknown:
        raise ConfigError(
            f"{unknown[0]!r} is nothing that can be taken out of runs; what is: {', '.join(known)}."
        )
    return [(known[f.name], values) for f in in_order() if (values := faults.get(f.name))]


def assemble(
    raw: Sequence[RawRun],
    system: SystemInfo,
    *,
    kind: str,
    dt: float | None = None,
    gap: float | None = None,
    clock: str = "rescale",
    derived_rates: str = "infer",
    own_rate: bool = False,
    most_rows: int | None = None,
    **faults: Mapping[str, float] | None,
) -> DataSet:
    """Checks raw runs and joins them to a data set. The raw runs are used up.

    Args:
        raw: What a reader returned.
        system: The system that the columns belong to.
        kind: Name of the reader, for the summary.
        dt: Step of the data set [s]; default: the median step over the runs.
        gap: Time between rows from which on it is a gap [s]; default: 2.5 steps.
        clock: What to do about a clock that disagrees with the kinematics: `rescale`, `trust` or `refuse`.
        derived_rates: What to do with rates that were made of positions: `infer` or `keep`.
        own_rate: Whether the step stays that of the log where `dt` is longer, for `on_longer_step` to come later.
        most_rows: Rows in all that are used, at the step that was asked for, in stretches spread over each run; None:
            as many as hold 1.5 million states and inputs.
        faults: What the recording did, to take out: `sensor_delay={"p": 0.01}` (see `RemedyOptions`).

    Returns:
        The data set, with what was found and done in its summary.

    Raises:
        DataError: a fault that cannot be handled; the message names run, row or column and the remedy.
        ConfigError: an option out of range.
        ShapeError: a run of the wrong width.
    """
    if not raw:
        raise DataError("the data set holds no runs.")
    if most_rows is not None and not most_rows >= 2:
        raise ConfigError(f"`most_rows` must be 2 rows or more; got {most_rows!r}.")
    for name, value in (("dt", dt), ("gap", gap)):
        if value is not None and not value > 0:
            raise ConfigError(f"`{name}` must be a positive time in seconds; got {value!r}.")
    if clock not in clock_and_biases.POLICIES:
        raise ConfigError(f"`clock` must be one of {', '.join(clock_and_biases.POLICIES)}; got {clock!r}.")
    findings: list[Finding] = []
    report = findings.append
    for run in raw:
        findings += run.notes
        columns.check_shapes(run, system)
        if system.quaternion is not None:
            inputs.check_range(run.u, system.input_names, run.label)
            columns.check_rates(run, system)
            columns.check_norms(run, system.quaternion, tuple(system.state_names), report)
        times.order(run, report)
        columns.check_columns(run, system, report)
    joined = together(raw)
    if joined is not raw[0]:
        columns.check_columns(joined, system, report)
    interventions.check(raw)
    whole, rates = system, unmeasured_rates.to_infer(system, raw, policy=derived_rates, report=report)
    system = unmeasured_rates.measured_part(system, rates)
    # times are decimal: 0.01 comes back from differences as 0.00999...
    own_step = round(float(np.median([np.median(np.diff(run.t)) for run in raw])), 12)
    if not all(times.follows(run.t, own_step) for run in raw):
        own_step = times.mean_step(raw, own_step)  # of times that were rounded to it
    wanted = own_step if dt is None else float(dt)
    if wanted < own_step / _FINER:
        raise ConfigError(
            f"`dt` must be at least 1/{_FINER} of the data's step of {own_step:.4g} s, between whose rows nothing was "
            f"measured; got {wanted:.4g} s."
        )
    limit = times.GAP_STEPS * max(wanted, own_step) if gap is None else float(gap)
    if limit <= wanted:
        raise ConfigError(f"`gap` must be longer than the step of {wanted:.4g} s; got {limit:.4g} s.")
    later = times.is_longer(wanted, own_step)
    step = own_step if later else wanted
    noise.check_interpolated(system, raw, own_step, report)
    commands = standstill.commands_in_motion(raw, system)
    runs: list[Run] = []
    slopes: list[kinematics.Slope] = []
    short: list[Array] = []
    for run in raw:
        if system.quaternion is not None:
            columns.check_signs(run, system.quaternion, report)  # before holes are filled between its signs
        times.fill_missing(run, system, gap=limit, report=report)
        columns.unwrap_angles(run, whole, report)
        noise.mend_glitches(run, system, report)
        standstill.cut_repeats(run, system, report)
        if commands is not None:
            standstill.cut_ground(run, system, commands, report)
        cuts = times.cuts_at_gaps(run, gap=limit, report=report)
        even, segments = times.uniform(run, cuts, dt=step, quaternion=system.quaternion, report=report)
        segments = _split_at_jumps(system, even, segments, step, report)
        parts = [even.x[a:b] for a, b in segments]
        if sum(len(part) for part in parts) * step < SHORT_S:
            short += parts
        else:
            slopes += kinematics.clock_slopes(system, run.name, parts, dt=step)
        u = even.u
        if system.exogenous:
            u = np.column_stack([u, *(even.extra[n] for n in system.exogenous)])
        runs.append(Run(run.name, even.t, even.x, u, segments=segments, source=run.source, extra=even.extra))
        run.x = run.u = run.t = np.empty(0)  # used up: a long recording must not be held twice
        run.extra = {}
    if short:
        slopes += kinematics.clock_slopes(system, "short runs together", short, dt=step)
    _check_twins(runs, report)
    runs = at_their_pace(runs)
    interventions.report_of(runs, report)
    standstill.check_constant(system, runs, report)
    columns.check_runs(system, runs)
    clock_and_biases.check_units(slopes, tuple(system.state_names))
    clock_and_biases.check_scales(system, slopes, report)
    rate = clock_and_biases.single_rate(system)
    scale, read_too_much = clock_and_biases.decide(slopes, rate, policy=clock, report=report)
    if read_too_much:
        runs = [
            replace(r, x=clock_and_biases.without(r, system, "sensor_scale", read_too_much)) for r in runs
        ]
    runs = unmeasured_rates.inferred(whole, runs, rates, scale)
    for fault, values in _asked(faults):
        runs = [fault.undo(run, system, values) for run in runs]
    findings += latency_findings(surely_late(late_channels(system, runs, clock=scale), runs[0].dt))
    nu = len(system.input_names)
    rank = inputs.check_inputs([run.u[:, :nu] for run in runs], system.input_names, report)
    own = {"dt": step, "clock_scale": scale}
    data = data_set_of(runs, system, kind=kind, slopes=slopes, rank=rank, findings=findings, **own)
    width = len(data.state_names) + len(data.input_names)
    most = (times.LONG // width if most_rows is None else most_rows) * (wanted / step if later else 1.0)
    data = times.no_longer(data, whole, most)
    return times.on_longer_step(data, whole, wanted) if later and not own_rate else data
