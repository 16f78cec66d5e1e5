"""What columns must hold before anything is made of them: sizes, units, unit quaternions, angles without wraps.

**Conventions** (order and direction of a quaternion, axes of a velocity) are checked as `nsde inspect` does, by
`nsde_torch.data.mapping.checks`.
"""

from collections.abc import Sequence

import numpy as np

from nsde_torch.data.mapping.checks import LEAN, SUSPECT, checks
from nsde_torch.data.quaternion import continuous_signs
from nsde_torch.data.raw import Finding, RawRun, Report
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, rate_columns, rate_pairs
from nsde_torch.errors import DataError, ShapeError
from nsde_torch.recording.noise import white

_LARGEST = 1e15  # of a state or an input, in any unit: a simulation that diverged, a word read as a float
MAX_RATE = 60.0  # body rate above which the column cannot be rad/s [rad/s] (3400 deg/s)
ROUNDING = 1e-4
"""Departure from unit norm that rounding explains (four decimals); renormalised without a word."""
MAX_NORM_ERROR = 0.05  # departure from unit norm above which the columns cannot be a unit quaternion; refused


def check_shapes(run: RawRun, system: SystemInfo) -> None:
    for name, array, columns in (("x", run.x, system.state_names), ("u", run.u, system.input_names)):
        if array.ndim != 2 or array.shape[1] != len(columns):
            size = f"(n, {len(columns)}) {columns}"
            raise ShapeError(f"run {run.name!r}: `{name}` must be {size}; got {array.shape}.")
    if len(run.u) == len(run.x) - 1:  # no input follows the last row; nothing reads the copy
        run.u = np.concatenate([run.u, run.u[-1:]])
    if len(run.t) < 2:
        raise DataError(f"{run.label} has {len(run.t)} row(s); a run needs at least two.")
    if run.t.shape != (len(run.x),) or len(run.u) != len(run.x):
        raise ShapeError(
            f"run {run.name!r}: `t`, `x` and `u` must have one row a sample; got {run.t.shape}, "
            f"{run.x.shape}, {run.u.shape}."
        )
    for names, array in ((system.state_names, run.x), (system.input_names, run.u)):
        beyond = np.abs(array) > _LARGEST
        if beyond.any():
            row, column = np.argwhere(beyond)[0].tolist()
            own = names[column]
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
    """What `nsde inspect` says of the columns: what kinematics contradict is refused, other doubts are reported."""
    for check in checks(system, run):
        if check.passed is False and check.name != LEAN:
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
        rate = np.abs(run.x[:, list(system.state_names).index(positions[name])])
        if np.nanmean(rate * step > np.pi / 2) > 0.005:
            raise DataError(
                f"run {run.name!r}: {positions[name]!r} turns {name!r} by more than a quarter turn between rows "
                f"(up to {np.nanmax(rate):.4g} rad/s at a step of {step:.4g} s). Expected rad/s, perhaps the columns "
                "hold degrees: multiply both by pi / 180. Otherwise record at a higher rate."
            )
        good = np.isfinite(run.x[:, k])
        wraps = int((np.abs(np.diff(run.x[good, k])) > np.pi).sum())
        if wraps:
            run.x = run.x.copy()
            run.x[good, k] = np.unwrap(run.x[good, k])
            text = f"{wraps} wraps of the angle {name!r}"
            report(Finding("angle_wrap", run.name, wraps, text, "unwrapped"))


def check_norms(run: RawRun, columns: slice, names: tuple[str, ...], report: Report) -> None:
    """Renormalises small departures of the norm from 1 and reports them; refuses those of more than 0.05."""
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


# ---- conventions -----------------------------------------------------------------------------------------

_OWN_S = 1.0
_OWN, _NOISE, _OTHERS = 0.5, 6.0, 0.1
"""Of a position's changes over a second in one run: share that its rate leaves of a column that is of another run,
times the noise of both, and share that the rates of the other runs leave at most."""


def check_runs(system: SystemInfo, runs: Sequence[Run]) -> None:
    """Refuses a run whose position and rate do not belong together, where those of the other runs do."""
    for i, j in rate_pairs(system):
        left = [_own_share(run, i, j) for run in runs]
        for k, run in enumerate(runs):
            share, beyond = left[k]
            others = [s for n, (s, _) in enumerate(left) if n != k]
            if others and share > _OWN and beyond > _NOISE and float(np.median(others)) < _OTHERS:
                a, b = system.state_names[i], system.state_names[j]
                much = f"{share:.0%}" if share < 10.0 else "more than ten times"
                raise DataError(
                    f"run {run.name!r}: {a!r} and {b!r} do not belong together: {b!r} leaves {much} of what {a!r} "
                    f"changes by over {_OWN_S * run.pace:.3g} s, and {np.median(others):.1%} in the other runs. "
                    "One of the columns is of another run or another time: write the right one, or leave the run out."
                )


def _own_share(run: Run, i: int, j: int) -> tuple[float, float]:
    """Share of a position's changes that the integral of its rate leaves, and its size over that of the noise."""
    n = max(4, round(_OWN_S * run.pace / run.dt))
    gaps, moves, noise = [], [], 0.0
    for a, b in run.segments:
        p, v = run.x[a:b, i], run.x[a:b, j]
        if len(p) <= 2 * n:
            continue
        whole = np.concatenate([[0.0], np.cumsum(0.5 * run.dt * (v[1:] + v[:-1]))])
        change = np.diff(p[::n])
        gaps.append(change - np.diff(whole[::n]))
        moves.append(change)
        noise = max(noise, (2.0 * white(p) ** 2 + n * (run.dt * white(v)) ** 2) ** 0.5)
    if sum(map(len, gaps)) < 5:
        return 0.0, 0.0
    gap, move = np.concatenate(gaps), np.concatenate(moves)
    gap = gap - gap.mean()  # a biased rate is another fault
    size = float(np.sqrt(np.square(gap).mean()))
    return size / max(float(np.sqrt(np.square(move).mean())), 1e-300), size / max(noise, 1e-300)
