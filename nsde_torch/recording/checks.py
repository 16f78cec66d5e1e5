"""From raw recordings to a data set: every fault is found and handled, reported or refused, in a fixed order.

time order and duplicates -> interpolated columns -> quaternion norm and sign -> missing values -> single samples
that are off -> sensors that repeat themselves -> time on the ground -> gaps in time -> one uniform step -> hidden gaps
(jumps against the kinematics) -> columns that stand still -> other conventions of quaternion and velocity, columns of
another run -> clock against the kinematics -> sensors that are late against others -> range and rank of the inputs ->
summary

All of this is done at the rate of the log. A longer step is taken at last.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import inputs, interventions, kinematics
from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.mapping.checks import FRAMES, LEAN, VECTORS, checks
from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import DataSet, Run, fingerprint
from nsde_torch.data.summary import summarise
from nsde_torch.data.system_info import RATE_NAMES, SystemInfo, derivative_columns, rate_columns
from nsde_torch.errors import ConfigError, DataError, ShapeError
from nsde_torch.recording import (
    attitude,
    conventions,
    glitches,
    ground,
    held,
    missing,
    positions,
    straight,
    stuck,
    times,
)
from nsde_torch.recording import clock as _clock
from nsde_torch.recording.faults.fault import Fault
from nsde_torch.recording.faults.registry import in_order, remedies
from nsde_torch.recording.longer_step import findings_of, is_longer, late_in, on_longer_step

Array = NDArray[np.float64]

_WRAPS, _ODD_WRAPS = 5, 0.3  # fewest wraps, and share of them that the rate contradicts
_LARGEST = 1e15  # of a state or an input, in any unit: a simulation that diverged, a word read as a float
SHORT_S = 2.0 * kinematics.MIN_INTERVALS * kinematics.INTERVAL_S
"""Runs shorter than this are measured together against the clock [s]; each alone has too few intervals."""
MAX_RATE = 60.0
"""Body rate above which the column cannot be rad/s [rad/s] (3400 deg/s)."""


def _check_shapes(run: RawRun, system: SystemInfo) -> None:
    nx, nu = len(system.state_names), len(system.input_names)
    if run.x.ndim != 2 or run.x.shape[1] != nx:
        raise ShapeError(f"run {run.name!r}: `x` must be (n, {nx}) {system.state_names}; got {run.x.shape}.")
    if run.u.ndim != 2 or run.u.shape[1] != nu:
        raise ShapeError(f"run {run.name!r}: `u` must be (n, {nu}) {system.input_names}; got {run.u.shape}.")
    if len(run.u) == len(run.x) - 1:  # no input follows the last row; nothing reads the copy
        run.u = np.concatenate([run.u, run.u[-1:]])
    if len(run.t) < 2:
        raise DataError(
            f"{run.source or 'run'} {run.name!r} has {len(run.t)} row(s); a run needs at least two."
        )
    if run.t.shape != (len(run.x),) or len(run.u) != len(run.x):
        raise ShapeError(
            f"run {run.name!r}: `t`, `x` and `u` must have one row a sample; got {run.t.shape}, "
            f"{run.x.shape}, {run.u.shape}."
        )
    for name in ("x", "u"):
        array = getattr(run, name)
        beyond = np.abs(array) > _LARGEST
        if beyond.any():
            row, column = np.argwhere(beyond)[0].tolist()
            own = (system.state_names if name == "x" else system.input_names)[column]
            told = "is infinite" if np.isinf(array[row, column]) else f"reads {array[row, column]:.3g}"
            raise DataError(
                f"{run.where(row)}: {own!r} {told}, which no sensor says; write `nan` where a value is missing, or "
                "leave out the rows from there on."
            )
    absent = [n for n in system.exogenous if n not in run.extra]
    if absent:
        raise DataError(
            f"run {run.name!r}: the effects of {system.name!r} read the channels {absent}, which are not in "
            f"the data (further channels: {sorted(run.extra) or 'none'}). Add the columns, or leave the "
            "effects out."
        )


def _check_rates(run: RawRun, system: SystemInfo) -> None:
    columns = rate_columns(system)
    if columns is None:
        return
    high = np.nanmax(np.abs(run.x[:, columns]))
    if high > MAX_RATE:
        row = int(np.nanargmax(np.abs(run.x[:, columns]).max(axis=1)))
        raise DataError(
            f"{run.where(row)}: a body rate of {high:.4g} rad/s is beyond {MAX_RATE:.0f}; expected rad/s, "
            "perhaps the column holds deg/s: multiply by pi / 180."
        )


def _check_columns(run: RawRun, system: SystemInfo, report: Report) -> None:
    """What `nsde inspect` says of the columns: what kinematics contradict is refused, what gravity does reported.

    Vectors of a vehicle are judged in all runs together (`conventions`, `clock.check_units`).
    """
    for check in checks(system, run):
        if check.passed is False and check.name == LEAN:
            report(Finding(FRAMES, run.name, 1, check.text.rstrip("."), "reported"))
        elif check.passed is False and check.name not in VECTORS:
            raise DataError(f"run {run.name!r}: {check.text} To mend it: {check.remedy}.")


def _unwrap_angles(run: RawRun, system: SystemInfo, report: Report) -> None:
    """Angles logged in (-pi, pi] become continuous; a step of more than half a turn is taken for a wrap."""
    positions = {p: v for p, v, _ in system.position_derivatives}
    step = float(np.median(np.diff(run.t)))
    for k, (name, unit) in enumerate(zip(system.state_names, system.state_units, strict=True)):
        if unit != "rad" or name not in positions:
            continue
        rate = np.abs(run.x[:, list(system.state_names).index(positions[name])])
        if np.nanmean(rate * step > np.pi / 2) > 0.005:
            raise DataError(
                f"run {run.name!r}: {positions[name]!r} turns {name!r} by more than a quarter turn between rows "
                f"(up to {np.nanmax(rate):.4g} rad/s at a step of {step:.4g} s). Expected rad/s, perhaps the columns "
                "hold degrees: multiply both by pi / 180. Otherwise record at a higher rate."
            )
        good = np.isfinite(run.x[:, k])
        change = np.diff(run.x[good, k])
        wrapped = np.abs(change) > np.pi
        wraps = int(wrapped.sum())
        if wraps >= _WRAPS:  # a wrap leaves what the rate says
            speed = run.x[good, list(system.state_names).index(positions[name])]
            turned = np.remainder(change + np.pi, 2 * np.pi) - np.pi
            off = np.abs(turned - step * 0.5 * (speed[1:] + speed[:-1]))[wrapped]
            if np.nanmean(off > np.pi / 4) > _ODD_WRAPS:
                raise DataError(
                    f"run {run.name!r}: {name!r} changes by more than half a turn from row to row {wraps} times, and "
                    f"{positions[name]!r} does not say so. Expected rad, perhaps the column holds degrees: multiply it "
                    "by pi / 180."
                )
        if wraps:
            run.x = run.x.copy()
            run.x[good, k] = np.unwrap(run.x[good, k])
            report(
                Finding("angle_wrap", run.name, wraps, f"{wraps} wraps of the angle {name!r}", "unwrapped")
            )


def _own_step(runs: Sequence[RawRun]) -> float:
    """The step of a data set [s]: the median, or where times were rounded to it, what their sum says."""
    # times are decimal: 0.01 comes back from differences as 0.00999...
    median = round(float(np.median([np.median(np.diff(run.t)) for run in runs])), 12)
    return median if all(times.follows(run.t, median) for run in runs) else times.mean_step(runs, median)


def _split_at_jumps(
    system: SystemInfo, run: RawRun, segments: tuple[tuple[int, int], ...], dt: float, report: Report
) -> tuple[tuple[int, int], ...]:
    out: list[tuple[int, int]] = []
    jumps: list[kinematics.Jump] = []
    for start, stop in segments:
        at = start
        for jump in kinematics.find_jumps(system, run.x[start:stop], dt=dt):
            row = start + jump.row
            jumps.append(kinematics.Jump(row, jump.group, jump.size, jump.missing_s))
            out.append((at, row + 1))
            at = row + 1
        out.append((at, stop))
    if not jumps:
        return segments
    kept = tuple((a, b) for a, b in out if b - a >= 2)
    axes = {g: [system.state_names[k] for k in i] for g, (i, _) in derivative_columns(system).items()}
    shown = ", ".join(
        f"{j.size:.3g} in {kinematics.called(j.group, axes.get(j.group, RATE_NAMES))} after row {j.row}, about "
        f"{j.missing_s:.2g} s lost"
        for j in jumps[:3]
    )
    report(
        Finding(
            "hidden_gap",
            run.name,
            len(jumps),
            f"{len(jumps)} jumps without a gap in the clock ({shown}{', ...' if len(jumps) > 3 else ''})",
            "split",
            {
                "rows": [j.row for j in jumps],
                "sizes": [j.size for j in jumps],
                "groups": [j.group for j in jumps],
                "missing_s": [j.missing_s for j in jumps],
            },
        )
    )
    return kept


def _asked(faults: Mapping[str, Mapping[str, float] | None]) -> list[tuple[Fault, Mapping[str, float]]]:
    """Faults that a reader was told of, in the order in which they are undone."""
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
    for name, value in (("dt", dt), ("gap", gap)):
        if value is not None and not value > 0:
            raise ConfigError(f"`{name}` must be a positive time in seconds; got {value!r}.")
    if clock not in _clock.POLICIES:
        raise ConfigError(f"`clock` must be one of {', '.join(_clock.POLICIES)}; got {clock!r}.")
    findings: list[Finding] = []
    report = findings.append
    motors = system.quaternion is not None
    for run in raw:
        findings += run.notes
        _check_shapes(run, system)
        if motors:
            inputs.check_range(run.u, system.input_names, f"{run.source or 'run'} {run.name!r}")
        _check_rates(run, system)
        if system.quaternion is not None:
            attitude.check_norms(run, system.quaternion, tuple(system.state_names), report)
        times.order(run, report)
        _check_columns(run, system, report)
    interventions.check(raw)
    whole, rates = system, positions.to_infer(system, raw, policy=derived_rates, report=report)
    system = positions.measured_part(system, rates)
    own_step = _own_step(raw)
    wanted = own_step if dt is None else float(dt)
    limit = times.GAP_STEPS * max(wanted, own_step) if gap is None else float(gap)
    if limit <= wanted:
        raise ConfigError(f"`gap` must be longer than the step of {wanted:.4g} s; got {limit:.4g} s.")
    later = is_longer(wanted, own_step)
    step = own_step if later else wanted
    straight.check(system, raw, own_step, report)
    commands = ground.commands_in_motion(raw, system)
    runs: list[Run] = []
    slopes: list[kinematics.Slope] = []
    short: list[Array] = []
    for run in raw:
        if system.quaternion is not None:
            attitude.check_signs(run, system.quaternion, report)  # before holes are filled between its signs
        missing.fill(run, gap=limit, report=report)
        if system.quaternion is not None:
            attitude.back_to_sphere(run, system.quaternion)
        _unwrap_angles(run, whole, report)
        glitches.mend(run, system, report)
        held.cut(run, system, report)
        if commands is not None:
            ground.cut(run, system, commands, report)
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
    interventions.report_of(runs, report)
    stuck.check(system, runs, report)
    conventions.check(system, runs)
    conventions.check_runs(system, runs)
    _clock.check_units(slopes, tuple(system.state_names))
    scale = _clock.decide(slopes, policy=clock, report=report)
    runs = positions.inferred(whole, runs, rates, scale)
    for fault, values in _asked(faults):
        runs = [fault.undo(run, system, values) for run in runs]
    findings += findings_of(late_in(system, runs, scale))
    nu = len(system.input_names)
    rank = inputs.check_inputs([run.u[:, :nu] for run in runs], system.input_names, report)
    summary = summarise(
        runs, system, kind=kind, dt=step, clock_scale=scale, slopes=slopes, rank=rank, findings=findings
    )
    data = DataSet(
        system_name=system.name,
        runs=runs,
        dt=step,
        clock_scale=scale,
        summary=summary,
        fingerprint=fingerprint(runs, system_name=system.name, dt=step, clock_scale=scale),
        state_names=tuple(system.state_names),
        input_names=(*system.input_names, *system.exogenous),
        kind=kind,
    )
    return on_longer_step(data, whole, wanted) if later and not own_rate else data
