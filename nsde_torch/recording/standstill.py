"""What stands still: a log that froze, a sensor at its end, a column that never changes, a machine on the ground.

A value that repeats exactly over several rows is no measurement where its partner in the kinematics says otherwise:

    | integral of (v - b) dt |  over the rows of a position that repeats
    | p(t + T) - p(t) - (v - b) T |  over those of a rate v that repeats

beyond 8 robust standard deviations of one step of `dp - (v - b) dt`, 6 of the integral of the rate's white noise, a few
quanta of the columns, and a small share of the usual travel in that time; `b` is the bias of the rate in the run. Where
all states repeat, a log froze if it is noisy just before and just behind. A column that holds most of its values, as
one that is sampled more slowly, is left alone.

A column of one value throughout a run is refused where a smooth motion of its partner contradicts it, and reported
where it stands still in every run: noise alone does not contradict (a machine at rest before a coarse sensor).

A multirotor on the ground stands still on commands that could not carry it:

    mean command  <  0.6 of its median in motion,  |mean v| < 0.15 m/s and |mean omega| < 0.15 rad/s over 0.3 s,
    for half a second and longer

The ground's force is no part of any model: such rows are cut out, with those next to them in which it still stands as
the commands rise or sink, and with those in which it leaves the ground or comes down on it and bounces: the last row
within 3 s that is less than 5 cm above where it stands, and all before it (docs/content/theory/recording.md).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d

from nsde_torch.arrays import Array, Mask
from nsde_torch.data.quaternion import increments
from nsde_torch.data.raw import Finding, RawRun, Report, holes
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import RATE_NAMES, SystemInfo, moving_columns, rate_columns, rate_pairs
from nsde_torch.errors import DataError
from nsde_torch.recording.noise import quantum, white
from nsde_torch.recording.times import GAP_STEPS

FEWEST = 5  # rows of one value that are looked at
_SIGMAS, _NOISE, _QUANTA, _SHARE = 8.0, 6.0, 5.0, 0.05
_MOST = 0.5  # share of rows that repeat; more is how the column was sampled
_NOISY, _GRAINS = 0.3, 2.0
"""White noise over the usual change of a row, and over the steps that values come in, of a sensor that is noisy."""
_FAINT = 1e-5  # share of a column's range that is rounding, no noise
_NEAR = 20  # rows on each side that show whether the log is noisy there
_MOVING = 50  # steps of a motion, fewest
_CLOSE = 5  # rows between two that are at an end
_FEWEST_ROWS = 20  # of a run whose column never changes
_SMOOTH = 0.7  # steps over spread: 1.4 for white noise, little for a motion

LOW = 0.6  # share of the commands of flight below which nothing flies
_REST, _WINDOW_S, _FEWEST_S = 0.15, 0.3, 0.5
_FLIES, _FEWEST_MOVING = 0.3, 100  # speed of flight [m/s], and rows of it
_NEARLY, _LONGEST_S = 0.95, 3.0  # commands, and time, in which it may stand while they rise
_SHORT_S = 0.05
CLEAR = 0.05
"""Height above where it stands, up to which a machine that has just stood, or is about to, may touch the ground [m]."""
_BOUNCE_S = 3.0  # longest time of touching down


def cut_repeats(run: RawRun, system: SystemInfo, report: Report) -> None:
    """Drops rows of frozen logs and of sensors that repeat a value or stand at their end; no holes are left."""
    frozen = _frozen(run, system)
    if frozen.any():
        text = "all states repeat themselves, though the log is noisy there"
        _tell(run, report, "frozen_rows", frozen, text)
        run.rows(~frozen)
    drop = np.zeros(len(run.t), dtype=bool)
    for name, column, bad in (*_contradicted(run, system), *_at_ends(run, system)):
        for which, value in (("lowest", column.min()), ("highest", column.max())):
            at_end = column == value
            if not (bad & at_end).any():
                continue
            bad, rows = bad & ~at_end, _closed(at_end)
            text = f"{name} stands at its {which} value {value:.6g} and there alone: the sensor's end"
            _tell(run, report, "sensor_end", rows, text, {"column": name, "value": float(value)})
            drop |= rows
        if bad.any():
            text = f"{name} repeats itself exactly, while its partner moves on"
            _tell(run, report, "frozen_rows", bad, text, {"column": name})
            drop |= bad
    if drop.any():
        run.rows(~drop)


def _tell(
    run: RawRun, report: Report, kind: str, rows: Mask, what: str, values: dict[str, object] | None = None
) -> None:
    parts, count = holes(rows), int(rows.sum())
    message = f"{count} rows in which {what} ({_shown(run, parts)})"
    report(Finding(kind, run.name, count, message, "dropped", {**(values or {}), "rows": parts[:100]}))


def _shown(run: RawRun, parts: Sequence[tuple[int, int]]) -> str:
    """The first stretches of rows by their times."""
    first = ", ".join(f"t = {run.t[a]:.6g} to {run.t[b - 1]:.6g} s" for a, b in parts[:3])
    return first + (", ..." if len(parts) > 3 else "")


def _frozen(run: RawRun, system: SystemInfo) -> Mask:
    """Rows behind the first of those in which all states repeat, where the log is noisy on both sides."""
    x, out = run.x, np.zeros(len(run.x), dtype=bool)
    same = _repeats((np.diff(x, axis=0) == 0).all(1))
    if same.mean() > _MOST:
        return out
    rates = [b for _, b in rate_pairs(system)]
    changes = np.abs(np.diff(x, axis=0))
    usual = np.array([np.median(c[c > 0]) if (c > 0).any() else np.inf for c in changes.T])
    noise = np.array([white(column) for column in x.T])
    grain = np.array([quantum(column) for column in x.T])
    noisy = (noise > _NOISY * usual) & (noise > _GRAINS * grain) & (noise > _FAINT * np.ptp(x, axis=0))
    if not noisy.any() or not rates:
        return out
    for a, b in holes(same):
        sure = noisy & bool((x[a, rates] != 0).any())
        for part in (x[max(0, a - 1 - _NEAR) : a], x[b : b + _NEAR + 1]):
            sure &= len(part) > _NEAR // 2
            sure &= np.array([white(column) for column in part.T]) > 0.5 * noise
        out[a:b] = sure.any()
    return out


def _repeats(same: Mask) -> Mask:
    """Rows that repeat the one before, of stretches of `FEWEST` rows and more; from whether steps change nothing."""
    out = np.zeros(len(same) + 1, dtype=bool)
    for a, b in holes(same):
        if b - a + 1 >= FEWEST:
            out[a + 1 : b + 1] = True
    return out


def _closed(rows: Mask) -> Mask:
    """With what lies between two rows that are close to each other."""
    out = rows.copy()
    for a, b in holes(~rows):
        if a > 0 and b < len(rows) and b - a <= _CLOSE:
            out[a:b] = True
    return out


def _contradicted(run: RawRun, system: SystemInfo) -> Iterator[tuple[str, Array, Mask]]:
    """Of each position and rate: name, column, and rows that repeat while the partner moves."""
    x, names, steps = run.x, system.state_names, np.diff(run.t)
    for a, b in rate_pairs(system):
        changes, fine = np.diff(x[:, a]), quantum(x[:, a])
        for c in (a, b):
            held = np.diff(x[:, c]) == 0
            yield repr(names[c]), x[:, c], _false(held, changes, x[:, b], steps, fine, held_rate=c == b)
    rates, q = rate_columns(system), system.quaternion
    if rates is not None and q is not None:
        fine = 2.0 * max(quantum(v) for v in x[:, q].T)
        for w, turned, name in zip(x[:, rates].T, increments(x[:, q]).T, RATE_NAMES, strict=True):
            yield repr(name), w, _false(np.diff(w) == 0, turned, w, steps, fine, held_rate=True)


def _at_ends(run: RawRun, system: SystemInfo) -> Iterator[tuple[str, Array, Mask]]:
    """The same of states without a partner: rows at an end of a column that is noisy but there (a level of 10 V)."""
    if system.quaternion is not None:  # all that it has is paired
        return
    paired = {j for pair in rate_pairs(system) for j in pair}
    for j, name in enumerate(system.state_names):
        column = run.x[:, j]
        noise = white(column) if j not in paired and len(column) > _MOVING else 0.0
        if noise > _GRAINS * quantum(column) and noise > _FAINT * np.ptp(column):
            held = _repeats(np.diff(column) == 0)
            at_end = (column == column.min()) | (column == column.max())
            # at 0 a car stands, and a tank is empty
            yield repr(name), column, held & at_end & (column != 0.0)


def _false(same: Mask, changes: Array, rate: Array, steps: Array, fine: float, *, held_rate: bool) -> Mask:
    """Rows (n,) in which a position (of a quantum `fine`) or its rate repeats, while the partner moves."""
    out = np.zeros(len(rate), dtype=bool)
    usual = float(np.median(steps))
    near = steps < GAP_STEPS * usual  # over gaps nothing can be said
    repeats = _repeats(same & near)
    moving = near & (changes != 0)
    if not repeats.any() or repeats.mean() > _MOST or moving.sum() < _MOVING:
        return out
    mean = 0.5 * (rate[1:] + rate[:-1])
    # what a position lost while it repeats, it makes up for afterwards; a rate does not
    fair = near & ~repeats[1:] if held_rate else near
    bias = -float((changes - steps * mean)[fair].sum()) / max(float(steps[fair].sum()), usual)
    rest = changes - steps * (mean - bias)
    sigma = 1.4826 * float(np.median(np.abs(rest[moving])))
    speed = float(np.quantile(np.abs(rate), 0.95))
    for a, b in holes(repeats):
        part = slice(a - 1, b - 1)  # steps from the first row of the stretch to its last
        travel = np.cumsum((steps * (mean - bias))[part])
        time = float(steps[part].sum())
        size = abs(float(rest[part].sum())) if held_rate else float(np.abs(travel).max())
        noise = 0.0 if held_rate else _NOISE * usual * white(rate) * (b - a) ** 0.5
        coarse = 2.0 * quantum(rate) * time if held_rate else 0.0
        if size > max(_SIGMAS * sigma, noise, _QUANTA * fine, coarse, _SHARE * speed * time):
            out[a:b] = True
    return out


def check_constant(system: SystemInfo, runs: Sequence[Run], report: Report) -> None:
    """Refuses a column that stands still while its partner moves; reports one that stands still in every run."""
    names = system.state_names
    for run in runs:
        for column, other, still, moving in _pairs(system, run):
            if len(moving) >= _FEWEST_ROWS and (still == still[0]).all() and _moves(moving):
                raise DataError(
                    f"run {run.name!r}: {column} never changes ({still.flat[0]:.4g} in all {len(still)} rows), while "
                    f"{other} does, so that it is no measurement. Write what the sensor measured, or leave the run out."
                )
    free = np.delete(np.arange(len(names)), system.quaternion or [])
    fixed = [k for k in free.tolist() if all((run.x[:, k] == runs[0].x[0, k]).all() for run in runs)]
    if fixed:
        shown = ", ".join(f"{names[k]} = {runs[0].x[0, k]:.4g}" for k in fixed)
        text = (
            f"states that never change: {shown}; nothing that acts on them, or through them, can be learned. "
            "If they are no measurements, write those; if they stand still, record runs in which they move"
        )
        values = {"states": [names[k] for k in fixed]}
        report(Finding("constant_state", "", len(fixed), text, "reported", values))


def _pairs(system: SystemInfo, run: Run) -> Iterator[tuple[str, str, Array, Array]]:
    """Of each position and rate, either way round: both names, the column that may stand still, and its partner."""
    names, x = system.state_names, run.x
    for a, b in rate_pairs(system):
        yield repr(names[a]), repr(names[b]), x[:, a], x[:, b]
        yield repr(names[b]), repr(names[a]), x[:, b], x[:, a]
    rates, q = rate_columns(system), system.quaternion
    if rates is None or q is None:
        return
    for w, turned, name in zip(x[:, rates].T, increments(x[:, q]).T, RATE_NAMES, strict=True):
        yield "the quaternion", repr(name), x[:, q], w
        yield repr(name), "the attitude about its axis", w, np.cumsum(turned)


def _moves(column: Array) -> bool:
    """Whether a column holds a smooth motion, beside a drift at a constant rate."""
    line = np.linspace(-1.0, 1.0, len(column))
    rest = column - column.mean()
    rest = rest - line * float(line @ rest) / float(line @ line)
    spread = float(rest.std())
    return spread > 1e-12 and float(np.diff(rest).std()) < _SMOOTH * spread


def commands_in_motion(runs: Sequence[RawRun], system: SystemInfo) -> float | None:
    """Median of the mean command while a multirotor moves; None of another machine, or where it hardly moves."""
    columns = moving_columns(system)
    # what floats or rolls may well stand still on nothing
    if columns is None or not system.input_names or any(n[:2] != "u_" for n in system.input_names):
        return None
    parts = [run.u.mean(axis=1)[np.linalg.norm(run.x[:, columns[0]], axis=1) > _FLIES] for run in runs]
    commands = np.concatenate(parts)
    commands = commands[np.isfinite(commands)]
    return float(np.median(commands)) if len(commands) >= _FEWEST_MOVING else None


def cut_ground(run: RawRun, system: SystemInfo, commands: float, report: Report) -> None:
    """Drops rows in which a multirotor stands, or touches, the ground; refuses a run in which it stands throughout.

    `commands` is the mean command in motion.
    """
    rows = _touching(run, system, _grounded(run, system, commands))
    if not rows.any():
        return
    if len(run.t) - rows.sum() < 2:
        raise DataError(f"{run.label}: the machine stands on the ground throughout. Leave the run out.")
    share = float(run.u[rows].mean()) / commands
    parts = holes(rows)
    seconds = sum(float(run.t[b - 1] - run.t[a]) for a, b in parts)
    text = (
        f"{seconds:.3g} s on the ground ({_shown(run, parts)}): it stands there, leaves it or comes down on it, on "
        f"{share:.0%} of the commands of flight"
    )
    values = {"seconds": seconds, "rows": parts[:100]}
    report(Finding("on_ground", run.name, int(rows.sum()), text, "dropped", values))
    run.rows(~rows)


def _grounded(run: RawRun, system: SystemInfo, commands: float) -> Mask:
    step = float(np.median(np.diff(run.t)))
    columns = moving_columns(system)
    assert columns is not None
    moved, turned = (run.x[:, some] for some in columns)
    mean = run.u.mean(axis=1)
    low = (mean < LOW * commands) & _at_rest(moved, turned, _WINDOW_S / step)
    stands = (mean < _NEARLY * commands) & _at_rest(moved, turned, _SHORT_S / step)
    out = np.zeros(len(run.t), dtype=bool)
    most = round(_LONGEST_S / step)
    for a, b in holes(low):
        if run.t[b - 1] - run.t[a] < _FEWEST_S:
            continue
        before, behind = stands[max(0, a - most) : a][::-1], stands[b : b + most]
        # up to the first row on each side in which it does not stand
        first, last = (int(np.argmin(np.append(rows, False))) for rows in (before, behind))
        out[a - first : b + last] = True
    return out


def _touching(run: RawRun, system: SystemInfo, stands: Mask) -> Mask:
    """Rows in which it stands, with those next to them in which it leaves the ground or bounces on it."""
    if "p_z" not in system.state_names:
        return stands
    height, out = run.x[:, list(system.state_names).index("p_z")], stands.copy()
    most = round(_BOUNCE_S / float(np.median(np.diff(run.t))))
    for a, b in holes(stands):
        near = np.flatnonzero(height < np.median(height[a:b]) + CLEAR)
        near = near[(near >= a - most) & (near < b + most)]
        out[near.min(initial=a) : near.max(initial=b - 1) + 1] = True
    return out


def _at_rest(moved: Array, turned: Array, rows: float) -> Mask:
    size = max(1, round(rows))
    speeds = [np.linalg.norm(uniform_filter1d(c, size, axis=0), axis=1) for c in (moved, turned)]
    return np.asarray((speeds[0] < _REST) & (speeds[1] < _REST))
