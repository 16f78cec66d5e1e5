"""What columns must hold before anything is made of them: sizes, units, unit quaternions, angles without wraps."""

from __future__ import annotations

import numpy as np

from nsde_torch.data.findings import Finding, Report
from nsde_torch.data.mapping.checks import LEAN, SUSPECT, VECTORS, checks
from nsde_torch.data.quaternion import continuous_signs
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo, rate_columns
from nsde_torch.errors import DataError, ShapeError

_WRAPS, _ODD_WRAPS = 5, 0.3  # fewest wraps, and share of them that the rate contradicts
_LARGEST = 1e15  # of a state or an input, in any unit: a simulation that diverged, a word read as a float
MAX_RATE = 60.0
"""Body rate above which the column cannot be rad/s [rad/s] (3400 deg/s)."""
ROUNDING = 1e-4
"""Departure from unit norm that rounding explains (four decimals); renormalised without a word."""
MAX_NORM_ERROR = 0.05
"""Departure from unit norm above which the columns cannot be a unit quaternion; refused."""


def check_shapes(run: RawRun, system: SystemInfo) -> None:
    nx, nu = len(system.state_names), len(system.input_names)
    if run.x.ndim != 2 or run.x.shape[1] != nx:
        raise ShapeError(f"run {run.name!r}: `x` must be (n, {nx}) {system.state_names}; got {run.x.shape}.")
    if run.u.ndim != 2 or run.u.shape[1] != nu:
        raise ShapeError(f"run {run.name!r}: `u` must be (n, {nu}) {system.input_names}; got {run.u.shape}.")
    if len(run.u) == len(run.x) - 1:  # no input follows the last row; nothing reads the copy
        run.u = np.concatenate([run.u, run.u[-1:]])
    if len(run.t) < 2:
        raise DataError(f"{run.label} has {len(run.t)} row(s); a run needs at least two.")
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
            says = "is infinite" if np.isinf(array[row, column]) else f"reads {array[row, column]:.3g}"
            raise DataError(
                f"{run.where(row)}: {own!r} {says}, which no sensor says; write `nan` where a value is missing, or "
                "leave out the rows from there on."
            )
    absent = [n for n in system.exogenous if n not in run.extra]
    if absent:
        raise DataError(
            f"run {run.name!r}: the effects of {system.name!r} read the channels {absent}, which are not in "
            f"the data (further channels: {sorted(run.extra) or 'none'}). Add the columns, or leave the "
            "effects out."
        )


def check_rates(run: RawRun, system: SystemInfo) -> None:
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


def check_columns(run: RawRun, system: SystemInfo, report: Report) -> None:
    """What `nsde inspect` says of the columns: what kinematics contradict is refused, other doubts are reported.

    Vectors of a vehicle are judged in all runs together (`conventions`, `clock_and_biases.check_units`).
    """
    for check in checks(system, run):
        if check.passed is False and check.name != LEAN:
            if check.name not in VECTORS:
                raise DataError(f"run {run.name!r}: {check.text} To mend it: {check.remedy}.")
        elif check.doubts:
            report(Finding(SUSPECT, run.name, 1, check.text.rstrip("."), "reported"))


def unwrap_angles(run: RawRun, system: SystemInfo, report: Report) -> None:
    """Angles logged in (-pi, pi] become continuous; a step of more than half a turn is taken for a wrap."""
    positions = {p: v for p, v, _ in system.position_derivatives}
    step = float(np.median(np.diff(run.t)))
    for k, (name, unit) in enumerate(zip(system.state_names, system.state_units, strict=True)):
        if unit != "rad" or name not in positions:
            continue
        speed = run.x[:, list(system.state_names).index(positions[name])]
        rate = np.abs(speed)
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
            speed = speed[good]
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
            text = f"{wraps} wraps of the angle {name!r}"
            report(Finding("angle_wrap", run.name, wraps, text, "unwrapped"))


def check_norms(run: RawRun, columns: slice, names: tuple[str, ...], report: Report) -> None:
    """Renormalises small departures of the norm from 1 and reports them.

    Raises:
        DataError: a norm is off by more than 0.05; the message names the first row and a likely cause.
    """
    q = run.x[:, columns]
    norm = np.linalg.norm(q, axis=1)
    error = np.abs(norm - 1.0)
    worst = float(np.nanmax(error)) if np.isfinite(norm).any() else 0.0
    if worst > MAX_NORM_ERROR:
        row = int(np.flatnonzero(error > MAX_NORM_ERROR)[0])
        cause = (
            "the columns hold degrees or another quantity" if np.nanmax(np.abs(q)) > 2 else "rows are damaged"
        )
        raise DataError(
            f"{run.where(row)}: the quaternion {names[columns]} = {np.round(q[row], 4).tolist()} has the "
            f"norm {norm[row]:.4g}; expected 1 (w x y z, body to world). Perhaps {cause}: write unit "
            "quaternions, or `nan` where there is none."
        )
    if worst > 1e-6:  # float32 rounding stays as it is
        run.x = run.x.copy()
        run.x[:, columns] = q / norm[:, None]
    count = int((error > ROUNDING).sum())
    if count:
        text = f"{count} quaternions off unit norm by up to {worst:.2g}"
        report(Finding("quaternion_norm", run.name, count, text, "normalised", {"worst": worst}))


def check_signs(run: RawRun, columns: slice, report: Report) -> None:
    """Undoes jumps between q and -q, which are one attitude but not one number to interpolate or learn."""
    known = np.isfinite(run.x[:, columns]).all(axis=1)
    q, flips = continuous_signs(run.x[known, columns])
    if flips:
        run.x = run.x.copy()
        run.x[known, columns] = q
        report(Finding("sign_flip", run.name, flips, f"{flips} sign flips of the quaternion", "unwrapped"))


def back_to_sphere(run: RawRun, columns: slice) -> None:
    """Unit norm again after holes were filled linearly, channel by channel."""
    norm = np.linalg.norm(run.x[:, columns], axis=1)
    off = np.abs(norm - 1.0) > 1e-6
    if off.any():
        run.x = run.x.copy()
        run.x[off, columns] /= norm[off, None]
