"""Finds a moving average in the logged inputs by the nulls that it leaves in their spectrum.

An average over a time T multiplies the spectrum by sinc(f T): nothing is left at f = k / T, k = 1, 2, ... The depth of
the spectrum at the first nulls, against the middle of the lobes between them, is a test of T: raw commands have no
reason to be silent there. Inputs that were averaged over T = n h are restored by regularised least squares,

    u = argmin |A u - u_logged|^2 + c^2 |D u|^2,      A the average, D second differences

which fills in what lies at the nulls with nothing and what lies elsewhere with itself.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.ndimage import convolve1d
from scipy.sparse.linalg import splu

from nsde_torch.arrays import Array
from nsde_torch.data.run import Run

_CURVED = 3e-3  # c: what the log of a command rounds off
_NULLS = 4
_DEPTH = 3.0  # a fall of e^3 = 20 in power at each of the nulls, where noise gives less than e^1
_SHORTEST = 6  # samples: below that too few nulls lie under half the sampling rate
_NEAR = 2  # samples to either side of the width among which the deepest nulls decide
_SHORT = 128  # rows of a part at least; of short runs a part is a run
_PARTS = 5  # overlapping parts at least: fewer scatter too much
_JUMPS = 6.0  # from here on a change stands alone: a command that is held at even spacing has the same nulls


def smoothing_width(runs: Sequence[Run], n_inputs: int) -> float:
    """Width [s] of a moving average found in the inputs, the longest that explains the nulls; 0 where none is clear."""
    dt = runs[0].dt
    power = _power(runs, n_inputs, dt)
    if power is None:
        return 0.0
    frequency, log_power = power
    best, width = 0.0, 0.0
    scores: dict[int, float] = {}
    for n in range(_SHORTEST, int(2.0 / dt) + 1):
        nulls = np.arange(1, _NULLS + 1) / (n * dt)
        nulls = nulls[nulls < 0.45 / dt]
        if len(nulls) < 2 or nulls[0] < 4 * (frequency[1] - frequency[0]):
            continue
        half = 0.5 / (n * dt)
        room = max(0.1 * half, frequency[1] - frequency[0])
        lowest = [log_power[np.abs(frequency - f) <= room].min() for f in nulls]
        scores[n] = score = float(np.min(np.interp(nulls + half, frequency, log_power) - lowest))
        # a wider average has the nulls of a narrower one, and more
        wider = score > 0.8 * best and n * dt > 1.8 * width
        if score > _DEPTH and (score > 1.15 * best or wider):
            best, width = max(score, best), n * dt
    # neighbours share the first nulls: the deepest is meant, one sample more or less ruins what is restored
    near = round(width / dt)
    found = max(range(near - _NEAR, near + _NEAR + 1), key=lambda n: scores.get(n, -np.inf)) if width else 0
    return found * dt


def _power(runs: Sequence[Run], n_inputs: int, dt: float) -> tuple[Array, Array] | None:
    """Mean log power of the changes of all inputs; of short runs that of as many parts as there are."""
    from scipy.signal import welch  # half a second, which those who read no data do not pay

    every = [np.abs(run.u[:, :n_inputs]).max(0, initial=0.0) for run in runs]
    size = np.max(every, axis=0, initial=0.0)
    size = np.where(size > 0.0, size, 1.0)  # kilonewtons are no other signal than micronewtons
    parts = [np.diff(run.u[a:b, :n_inputs] / size, axis=0) for run in runs for a, b in run.segments]
    longest = max((len(part) for part in parts), default=0)
    rows = min(1024, max(256, longest // 3)) if longest >= 2 * 256 else max(longest, _SHORT)
    if sum(max(2 * len(part) // rows - 1, 0) for part in parts) < _PARTS:
        return None
    spectra = []
    for changes in parts:
        if len(changes) < rows:
            continue
        _, p = welch(changes, fs=1 / dt, nperseg=rows, axis=0)
        active = (changes.std(0) > 1e-9) & (_standing_alone(changes) < _JUMPS)
        if active.any():
            spectra.append((len(changes), np.log(p[:, active] + 1e-30).mean(1)))
    if not spectra:
        return None
    total = sum(w for w, _ in spectra)
    return np.linspace(0, 0.5 / dt, rows // 2 + 1), sum((w / total) * s for w, s in spectra)


def _standing_alone(changes: Array) -> Array:
    """Mean fourth power of changes (N, n) over the mean product of the squares of neighbours (n,); noise gives 3.

    A step that is averaged over n rows changes n rows in a row, and a step in one row was not averaged: a telegraph
    signal every 0.5 s on a sum of sines was taken for a mean over 0.1 s.
    """
    square = changes**2
    apart = np.maximum((square[1:] * square[:-1]).mean(0), 1e-30)
    return np.asarray((square**2).mean(0) / apart)


def mean_weights(rows: int) -> Array:
    """Weights of a centred mean over a width of so many rows: an odd number; of an even width the ends have half."""
    weights = np.full(rows + 1 - rows % 2, 1.0 / rows)
    if not rows % 2:  # an odd width ends between rows
        weights[[0, -1]] *= 0.5
    return weights


def averaged(u: Array, steps: int) -> Array:
    """Mean over a window of `steps` rows about each row."""
    return u if steps < 1 else np.asarray(convolve1d(u, mean_weights(steps), axis=0, mode="nearest"))


def restored(run: Run, n_inputs: int, width: float, *, past: bool = False) -> Run:
    """A run with inputs as they were before a moving average of `width` [s], centred or of the `past`."""
    u = run.u.copy()
    for a, b in run.segments:
        u[a:b, :n_inputs] = _unaveraged(u[a:b, :n_inputs], round(width / run.dt), past)
    return replace(run, u=u)


def as_applied(runs: Sequence[Run], n_inputs: int) -> list[Run]:
    """Runs with inputs as they acted, where a moving average is found in those logged."""
    width = smoothing_width(runs, n_inputs)
    return [restored(run, n_inputs, width) for run in runs] if width else list(runs)


def _unaveraged(u: Array, steps: int, past: bool) -> Array:
    n = len(u)
    if steps < 2 or n < 3 * steps:
        return u
    weights = np.full(steps, 1.0 / steps) if past else mean_weights(steps)
    first = -(len(weights) - 1 if past else len(weights) // 2)
    last = first + len(weights)
    average = sparse.diags(list(weights), list(range(first, last)), shape=(n, n), format="csc")
    average = sparse.diags(1.0 / np.asarray(average.sum(1)).ravel()) @ average
    curvature = sparse.diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(n - 2, n), format="csc")
    inner = slice(-first, n - last + 1)  # how the ends were averaged is not known
    kept = average[inner]
    normal = (kept.T @ kept + _CURVED**2 * curvature.T @ curvature).tocsc()
    return np.asarray(splu(normal).solve(np.asarray(kept.T @ u[inner])))
