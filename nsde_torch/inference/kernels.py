"""The recursions of a filter over the rows of chunks, compiled.

They are loops over matrices of a few rows: called one by one from Python, the calls alone take ten times as long as
what is done in them. A step x -> A x of the errors of n = ne + d states, of which the last d are Ornstein-Uhlenbeck
disturbances that keep a share, has the transition

    F = | A (ne, n)    |
        | 0   keep (d) |

Arrays are (rows T, chunks C, ...) as in `nsde_torch.inference.filtering`, contiguous and in double precision. Each
kernel works on the chunks from `first` to `end`: chunks know nothing of one another, and parts of them run side by side
(`in_parts`).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.jit import compiled
from nsde_torch.threads import allowed_threads

_FEWEST = 2000  # rows a thread: of 400, a pass over a spring takes 0.17 ms in two threads and 0.11 in one


def in_parts(
    kernel: Callable[..., None], rows: int, chunks: int, *values: Tensor | NDArray[Any] | list[int] | float
) -> None:
    """Run a kernel on all chunks, in as many threads as the caller of the library allows; results are the same.

    Args:
        rows, chunks: How many rows a chunk has, and how many chunks there are.
        values: What the kernel takes behind `first` and `end`.
    """
    arrays = [
        v.contiguous().numpy() if isinstance(v, Tensor) else np.array(v) if isinstance(v, list) else v
        for v in values
    ]
    threads = allowed_threads()
    count = min(threads, chunks, rows * chunks // _FEWEST)
    if count < 2:
        kernel(0, chunks, *arrays)
        return
    ends = np.linspace(0, chunks, count + 1).round().astype(int).tolist()
    for done in [_pool(threads).submit(kernel, a, b, *arrays) for a, b in pairwise(ends)]:
        done.result()


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="filter")


@compiled
def _dot(a: Array, b: Array) -> float:
    """Of two rows: the form of a product that is fastest, as sums stay in registers."""
    total = 0.0
    for o in range(len(a)):
        total += a[o] * b[o]
    return total


@compiled
def _scores(w: Array, whitened: Array, v: Array) -> None:
    """v = S^-1 e = L^-T L^-1 e, from `whitening` w = L^-1 and the whitened innovation."""
    for j in range(len(v)):
        v[j] = 0.0
        for o in range(j, len(v)):
            v[j] += w[o, j] * whitened[o]


@compiled
def _closed_loop(a: Array, keep: Array, g: Array, observed: Labels, back: Array, closed: Array) -> None:
    """Fills F G (n, m) and the closed loop F (I - G H) (n, n); by elements, as copies of rows take longer."""
    ne, n = a.shape
    m = len(observed)
    for i in range(n):
        for j in range(n):
            closed[i, j] = a[i, j] if i < ne else 0.0
        if i >= ne:
            closed[i, i] = keep[i - ne]
        for j in range(m):
            back[i, j] = 0.0 if i < ne else keep[i - ne] * g[i, j]
        if i < ne:
            for o in range(n):
                for j in range(m):
                    back[i, j] += a[i, o] * g[o, j]
        for j in range(m):
            closed[i, observed[j]] -= back[i, j]


@compiled
def covariances(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    white: Array,
    gust: Array,
    sensor: Array,
    start: Array,
    observed: Labels,
    measured: NDArray[np.bool_],
    whitening: Array,
    gain: Array,
    left: Array,
) -> None:
    """Kalman gains, and what whitens the innovations.

    Args:
        slopes: A of the step from each row (T, C, ne, n).
        keep: Share of each disturbance that is left after a step (d,).
        white, gust: Variance that a step adds to the ports and to the disturbances (d,).
        sensor: Variance of the sensors (m,).
        start: Variance of the errors that a chunk starts with (n,).
        observed: Numbers of the measured errors (m,).
        measured: Whether a row measures each of these (T, C, m); (0, 0, 0) where all do.
        whitening, gain: Are filled (T, C, m, m) and (T, C, n, m).
        left: Is filled with the covariance after each row (T, C, n, n); not if empty.
    """
    rows, _, ne, n = slopes.shape
    m = len(observed)
    each = np.zeros((end - first, n, n))
    moved, seen, known = np.empty((ne, n)), np.empty((m, m)), np.ones(m, dtype=np.bool_)
    for c in range(first, end):
        for i in range(n):
            each[c - first, i, i] = start[i]
        whitening[0, c] = 0.0
        for i in range(m):
            whitening[0, c, i, i] = 1.0
        gain[0, c] = 0.0
        if len(left):
            left[0, c] = each[c - first]
    for k in range(1, rows):
        for c in range(first, end):  # chunks inside: memory is read in its order
            p = each[c - first]
            _predicted(slopes[k - 1, c], keep, white, gust, p, moved)
            shown = measured[k, c] if len(measured) else known
            _updated(p, sensor, observed, shown, whitening[k, c], gain[k, c], seen)
            if len(left):
                left[k, c] = p


@compiled
def _updated(
    p: Array,
    sensor: Array,
    observed: Labels,
    measured: NDArray[np.bool_],
    whitening: Array,
    gain: Array,
    seen: Array,
) -> None:
    """The covariance p after a row, in place; `whitening` and `gain` are filled, `seen` (m, m) is room to work in."""
    n, m = gain.shape
    for i in range(m):
        for j in range(i + 1):
            seen[i, j] = p[observed[i], observed[j]]
        seen[i, i] += sensor[i]
    for i in range(m):  # a channel that the row does not measure is white noise of its own
        for j in range(i + 1):
            if not (measured[i] and measured[j]):
                seen[i, j] = 1.0 if i == j else 0.0
    _inverse_triangle(seen, whitening)
    for i in range(m):  # and neither moves the state nor counts
        if not measured[i]:
            whitening[i] = 0.0
    half = gain  # P H' L^-T until it is the gain
    for i in range(n):
        for j in range(m):
            seen[0, j] = p[i, observed[j]]
        for j in range(m):
            half[i, j] = _dot(seen[0], whitening[j])
    for i in range(n):
        for j in range(i + 1):
            p[i, j] -= _dot(half[i], half[j])
            p[j, i] = p[i, j]
    seen[:] = whitening.T
    for i in range(n):
        for j in range(m):  # L^-1 is triangular: what is read is not yet written
            gain[i, j] = _dot(half[i, j:], seen[j, j:])


@compiled
def gated(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    white: Array,
    gust: Array,
    sensor: Array,
    start: Array,
    observed: Labels,
    begun: Array,
    missed: Array,
    seen: Array,
    gate: float,
    measured: NDArray[np.bool_],
) -> None:
    """Marks measurements that are further off than `gate` standard deviations as none, and goes on without them.

    Args:
        slopes, keep, white, gust, sensor, start, observed: As in `covariances`.
        begun, missed, seen: As in `means`.
        gate: Standard deviations of an innovation.
        measured: Whether a row measures each channel (T, C, m); what is beyond the gate is set to false.
    """
    rows, _, ne, n = slopes.shape
    m = len(observed)
    moved, room = np.empty((ne, n)), np.empty((m, m))
    whitening, gain, mean, error = np.empty((m, m)), np.empty((n, m)), np.empty(n), np.empty(m)
    for c in range(first, end):
        p, left = np.zeros((n, n)), np.zeros(n)
        for i in range(n):
            p[i, i] = start[i]
        left[:ne] = begun[c]
        for k in range(1, rows):
            _ahead(slopes[k - 1, c], keep, missed[k - 1, c], left, mean)
            _predicted(slopes[k - 1, c], keep, white, gust, p, moved)
            for j in range(m):
                o = observed[j]
                error[j] = seen[k, c, j] - mean[o]
                if error[j] * error[j] > gate * gate * (p[o, o] + sensor[j]):
                    measured[k, c, j] = False
            _updated(p, sensor, observed, measured[k, c], whitening, gain, room)
            for i in range(n):
                left[i] = mean[i] + _dot(gain[i], error)


@compiled
def _ahead(a: Array, keep: Array, missed: Array, left: Array, mean: Array) -> None:
    """`mean` is filled with what a step makes of the errors that are left after a row."""
    ne, n = a.shape
    for i in range(ne):
        mean[i] = missed[i] + _dot(a[i], left)
    for i in range(ne, n):
        mean[i] = keep[i - ne] * left[i]


@compiled
def _predicted(a: Array, keep: Array, white: Array, gust: Array, p: Array, moved: Array) -> None:
    """F P F' and what a step adds, in place; `moved` (ne, n) is room to work in."""
    ne, n = a.shape
    d = n - ne
    for i in range(ne):
        for j in range(n):
            moved[i, j] = _dot(a[i], p[j])
    for e in range(d):
        for i in range(ne):
            crossed = moved[i, ne + e] * keep[e]
            p[i, ne + e] = crossed
            p[ne + e, i] = crossed
            moved[i, ne + e] += a[i, ne + e] * white[e]
        for f in range(d):
            p[ne + e, ne + f] *= keep[e] * keep[f]
        p[ne + e, ne + e] += gust[e]
    for i in range(ne):
        for j in range(i + 1):
            p[i, j] = _dot(moved[i], a[j])
            p[j, i] = p[i, j]


@compiled
def _inverse_triangle(s: Array, inverse: Array) -> None:
    """L^-1 of s = L L', of which the lower triangle is read and lost."""
    m = len(s)
    for i in range(m):
        for j in range(i):
            total = s[i, j]
            for o in range(j):
                total -= s[i, o] * s[j, o]
            s[i, j] = total / s[j, j]
        total = s[i, i]
        for o in range(i):
            total -= s[i, o] * s[i, o]
        s[i, i] = np.sqrt(total)
    inverse[:] = 0.0
    for i in range(m):
        inverse[i, i] = 1.0 / s[i, i]
        for j in range(i):
            total = 0.0
            for o in range(j, i):
                total -= s[i, o] * inverse[o, j]
            inverse[i, j] = total * inverse[i, i]


@compiled
def means(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    begun: Array,
    missed: Array,
    seen: Array,
    observed: Labels,
    live: NDArray[np.bool_],
    whitening: Array,
    gain: Array,
    errors: Array,
    white: Array,
    left: Array,
    nats: Array,
) -> None:
    """The means of a pass, p_{k+1} = F (p + G e)_k + c_k with e = seen - H p.

    Args:
        slopes, keep, observed, whitening, gain: As in `covariances`.
        begun: Errors that each chunk starts with (C, ne).
        missed: c (T, C, ne).
        seen: What was measured less the state of the linearisation (T, C, m).
        live: Whether a row counts (T, C).
        errors, white: Are filled with e, and with what it is whitened (T, C, m).
        left: Is filled with p + G e (T, C, n).
        nats: Is filled with the log likelihood of each row (T, C).
    """
    rows, _, ne, n = slopes.shape
    m = len(observed)
    p = np.empty(n)
    for k in range(rows):
        for c in range(first, end):
            if k:
                _ahead(slopes[k - 1, c], keep, missed[k - 1, c], left[k - 1, c], p)
            else:
                p[:] = 0.0
                p[:ne] = begun[c]
            for j in range(m):
                errors[k, c, j] = seen[k, c, j] - p[observed[j]]
            for i in range(n):
                left[k, c, i] = p[i] + _dot(gain[k, c, i], errors[k, c])
            total = 0.0
            for j in range(m):
                scale = whitening[k, c, j, j]
                white[k, c, j] = _dot(whitening[k, c, j], errors[k, c])
                if scale != 0.0:  # 0 for what the row does not measure
                    total += np.log(scale) - 0.5 * white[k, c, j] * white[k, c, j]
            nats[k, c] = total if live[k, c] else 0.0


@compiled
def adjoints(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    observed: Labels,
    whitening: Array,
    gain: Array,
    whitened: Array,
    left_mean: Array,
    left: Array,
    live: NDArray[np.bool_],
    sensors: Array,
    struck: Array,
    gusts: Array,
    begun: Array,
    kept: Array,
) -> None:
    """One pass backwards: what the log likelihood does with each source of noise (`nsde_torch.inference.level_slopes`).

    Args:
        slopes, keep, observed, whitening, gain: Of the pass.
        whitened: Its innovations in standard deviations (T, C, m).
        left_mean, left: Mean (T, C, n) and covariance (T, C, n, n) after each row.
        live: Whether a row counts (T, C).
        sensors: Is filled with the slope in the variance of each sensor (C, m).
        struck, gusts, begun: Those in the variance that a step adds to each port and to each disturbance, and that a
            disturbance starts with (C, d).
        kept: That in the share that is left of a disturbance after a step (C, d).
    """
    rows, _, ne, n = slopes.shape
    m, d = len(observed), n - ne
    each_mean, each_spread = np.zeros((end - first, n)), np.zeros((end - first, n, n))
    moved, turned = np.empty(n), np.empty((n, n))
    v, pulled = np.empty(m), np.empty(m)
    own, twice, of_gain = np.empty((m, m)), np.empty((m, m)), np.empty((n, m))
    passed = np.empty((n, m))
    for part in (sensors, struck, gusts, kept):
        part[first:end] = 0.0
    for k in range(rows - 1, 0, -1):
        for c in range(first, end):
            mean, spread = each_mean[c - first], each_spread[c - first]
            w, g, a = whitening[k, c], gain[k, c], slopes[k - 1, c]
            weight = 0.5 if live[k, c] else 0.0
            _scores(w, whitened[k, c], v)
            for i in range(m):
                for j in range(i + 1):
                    total = v[i] * v[j]
                    for o in range(i, m):
                        total -= w[o, i] * w[o, j]
                    own[i, j] = weight * total
                    own[j, i] = own[i, j]
            pulled[:] = 0.0
            for i in range(n):
                of_gain[i] = 0.0
                for o in range(n):
                    share = spread[i, o]
                    for j in range(m):
                        of_gain[i, j] += share * g[o, j]
                for j in range(m):
                    pulled[j] += g[i, j] * mean[i]
            for j in range(m):
                total = own[j, j] - pulled[j] * v[j]
                for i in range(n):
                    total += g[i, j] * of_gain[i, j]
                sensors[c, j] += total
            # before the update: (I - G H)' a and (I - G H)' A (I - G H). I - G H is made first: A - A G H would be
            # the difference of two large numbers where a sensor is much better than what is predicted
            for i in range(n):
                for j in range(m):
                    passed[i, j] = -g[i, j]
            for j in range(m):
                passed[observed[j], j] += 1.0
            for i in range(n):
                of_gain[i] = 0.0
                for o in range(n):
                    share = spread[i, o]
                    for j in range(m):
                        of_gain[i, j] += share * passed[o, j]
            twice[:] = 0.0
            pulled[:] = 0.0
            for o in range(n):
                for i in range(m):
                    share = passed[o, i]
                    pulled[i] += share * mean[o]
                    for j in range(m):
                        twice[i, j] += share * of_gain[o, j]
            for j in range(m):
                for i in range(n):
                    spread[i, observed[j]] = of_gain[i, j]
                    spread[observed[j], i] = of_gain[i, j]
            for i in range(m):
                mean[observed[i]] = pulled[i]
                for j in range(m):
                    spread[observed[i], observed[j]] = twice[i, j] + own[i, j]
            for i in range(n):
                for j in range(m):
                    crossed = 0.5 * mean[i] * v[j]
                    spread[i, observed[j]] += crossed
                    spread[observed[j], i] += crossed
            for i in range(m):
                mean[observed[i]] += 2.0 * weight * v[i]
            # of the row before: F' a and F' A F
            for i in range(n):
                turned[i] = 0.0
                for o in range(ne):
                    share = spread[i, o]
                    for j in range(n):
                        turned[i, j] += share * a[o, j]
            for e in range(d):
                total = 0.0
                for i in range(ne):
                    total += a[i, ne + e] * turned[i, ne + e]
                struck[c, e] += total
                gusts[c, e] += spread[ne + e, ne + e]
            for i in range(n):
                for e in range(d):
                    turned[i, ne + e] += spread[i, ne + e] * keep[e]
            for e in range(d):
                total = 0.0
                for o in range(n):
                    total += turned[ne + e, o] * left[k - 1, c, o, ne + e]
                kept[c, e] += 2.0 * total + mean[ne + e] * left_mean[k - 1, c, ne + e]
            moved[:] = 0.0
            for o in range(ne):
                for i in range(n):
                    moved[i] += a[o, i] * mean[o]
            for e in range(d):
                moved[ne + e] += keep[e] * mean[ne + e]
            mean[:] = moved
            spread[:] = 0.0
            for o in range(ne):
                for i in range(n):
                    share = a[o, i]
                    for j in range(n):
                        spread[i, j] += share * turned[o, j]
            for e in range(d):
                for j in range(n):
                    spread[ne + e, j] += keep[e] * turned[ne + e, j]
            # only one side of it is read above: the asymmetry that rounding makes grows from row to row where sensors
            # are very precise (a gradient of 1e65 after 500 rows of NeuroBEM)
            for i in range(n):
                for j in range(i):
                    both = 0.5 * (spread[i, j] + spread[j, i])
                    spread[i, j], spread[j, i] = both, both
    for c in range(first, end):
        spread = each_spread[c - first]
        for j in range(m):  # a chunk starts as uncertain as its sensors and disturbances
            sensors[c, j] += spread[observed[j], observed[j]]
        for e in range(d):
            begun[c, e] = spread[ne + e, ne + e]


@compiled
def slopes_in_levels(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    observed: Labels,
    whitening: Array,
    gain: Array,
    whitened: Array,
    left_mean: Array,
    left: Array,
    kept: Array,
    white: Array,
    gust: Array,
    sensor: Array,
    z: Array,
    turned: Array,
) -> None:
    """One pass forwards: slopes of the whitened innovations in each level (`nsde_torch.inference.level_slopes`).

    Args:
        slopes, keep, observed, whitening, gain, whitened, left_mean, left: As in `adjoints`.
        kept: Slope of `keep` in the logarithm of the time constant (d,).
        white: Variance that a step adds to the ports (d,).
        gust, sensor: Variance of the disturbances (d,) and of the sensors (m,).
        z: Is filled with the slopes of the whitened innovations (T, C, m, p).
        turned: Is filled with those of their covariances (T, C, p, m, m); not if empty.
    """
    rows, _, ne, n = slopes.shape
    m, d = len(observed), n - ne
    p = m + 3 * d
    spread, mean = np.empty((p, n, n)), np.empty((p, n))
    closed, back, carried = np.empty((n, n)), np.empty((n, m)), np.empty((n, d))
    flat, room, across = spread.reshape(p * n, n), np.empty((p * n, n)), np.empty((n, n))
    answered, v, seen = np.empty(n), np.empty(m), np.empty((m, m))
    half, after_t = np.empty((m, m)), np.empty((m, m))
    for c in range(first, end):
        spread[:] = 0.0
        mean[:] = 0.0
        z[0, c] = 0.0
        for j in range(m):
            spread[j, observed[j], observed[j]] = 2.0 * sensor[j]
        for e in range(d):
            spread[m + d + e, ne + e, ne + e] = 2.0 * gust[e]
        if len(turned):
            turned[0, c] = 0.0
        for k in range(rows - 1):
            a, g, w = slopes[k, c], gain[k, c], whitening[k, c]
            _closed_loop(a, keep, g, observed, back, closed)
            for i in range(n):
                for e in range(d):
                    port = ne + e
                    last = _dot(a[i], left[k, c, port]) if i < ne else keep[i - ne] * left[k, c, i, port]
                    carried[i, e] = kept[e] * last
            v[:] = 0.0
            if k:  # no innovation where a chunk starts
                _scores(w, whitened[k, c], v)
            for q in range(p):
                part = spread[q]
                for i in range(n):
                    total = mean[q, i]
                    for j in range(m):
                        total += part[i, observed[j]] * v[j]
                    answered[i] = total
                for i in range(n):
                    mean[q, i] = _dot(closed[i], answered)
            across[:] = closed.T
            for _ in range(2):  # B 'P B^T, as symmetric 'P: 'P B^T turned is B 'P
                np.dot(flat, across, room)
                for q in range(p):
                    for i in range(n):
                        for j in range(n):
                            spread[q, j, i] = room[q * n + i, j]
            for q in range(m):
                for i in range(n):
                    mean[q, i] -= 2.0 * sensor[q] * back[i, q] * v[q]
                    for j in range(n):
                        spread[q, i, j] += 2.0 * sensor[q] * back[i, q] * back[j, q]
            for e in range(d):
                port = ne + e
                for i in range(ne):
                    for j in range(ne):
                        spread[m + e, i, j] += 2.0 * white[e] * a[i, port] * a[j, port]
                spread[m + d + e, port, port] += 2.0 * gust[e] * (1.0 - keep[e] * keep[e])
                lasts = spread[m + 2 * d + e]
                for i in range(n):
                    lasts[i, port] += carried[i, e]
                    lasts[port, i] += carried[i, e]
                lasts[port, port] -= 2.0 * keep[e] * kept[e] * gust[e]
                mean[m + 2 * d + e, port] += kept[e] * left_mean[k, c, port]
            after = whitening[k + 1, c]
            after_t[:] = after.T
            for q in range(p):
                for i in range(m):
                    total = 0.0
                    for o in range(i + 1):
                        total -= after[i, o] * mean[q, observed[o]]
                    z[k + 1, c, i, q] = total
                if len(turned):
                    for i in range(m):
                        for j in range(m):
                            seen[i, j] = spread[q, observed[i], observed[j]]
                    if q < m:
                        seen[q, q] += 2.0 * sensor[q]
                    np.dot(after, seen, half)
                    np.dot(half, after_t, turned[k + 1, c, q])


@compiled
def sensitivities(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    observed: Labels,
    gain: Array,
    whitening: Array,
    counted: NDArray[np.bool_],
    columns: Array,
    forces: Array,
    acts: Labels,
    moved: Array,
    table: Array,
) -> None:
    """What unknowns do to the whitened innovations of some rows (`nsde_torch.inference.sensitivity`).

    Args:
        slopes, gain: Of the rows before these, from which steps lead to these (T, C, ne, n), (T, C, n, m).
        keep, observed: As in `covariances`.
        whitening: Of these rows (T, C, m, m).
        counted: Whether a row counts (T, C).
        columns: What k parameters do to the steps (T, C, ne, k).
        forces: Forces of q others on disturbances (T, C, q).
        acts: Numbers of these disturbances (q,).
        moved: What they do to the predicted states of the row before; is left with that of the last row (C, n, k + q).
        table: Is filled (C, T, m, k + q).
    """
    rows, _, ne, n = slopes.shape
    m, k, more = len(observed), columns.shape[3], len(acts)
    closed, back, after = np.empty((n, n)), np.empty((n, m)), np.empty((n, k + more))
    seen, white = np.empty((m, k + more)), np.empty((m, k + more))
    for r in range(rows):
        for c in range(first, end):
            a, g, now = slopes[r, c], gain[r, c], moved[c]
            _closed_loop(a, keep, g, observed, back, closed)
            np.dot(closed, now, after)
            for i in range(ne):
                for q in range(k):
                    after[i, q] += columns[r, c, i, q]
                for q in range(more):
                    after[i, k + q] += a[i, ne + acts[q]] * forces[r, c, q]
            now[:] = after
            if counted[r, c]:
                for j in range(m):
                    seen[j] = after[observed[j]]
                np.dot(whitening[r, c], seen, white)
                table[c, r] = white
            else:
                table[c, r] = 0.0


@compiled
def step_adjoints(
    first: int,
    end: int,
    slopes: Array,
    keep: Array,
    observed: Labels,
    whitening: Array,
    gain: Array,
    counted: NDArray[np.bool_],
    white: Array,
    steps: Array,
) -> None:
    """Slopes of sums of whitened rows in what is done to each step (`nsde_torch.inference.force_scores`).

    Args:
        slopes, keep, observed, whitening, gain: As in `covariances`.
        counted: Whether a row counts (T, C).
        white: Rows of the whitened innovations, q of them side by side (T, C, m, q).
        steps: Is filled (T, C, ne, q); nothing follows from the last row.
    """
    rows, _, ne, n = slopes.shape
    m, q = len(observed), white.shape[3]
    each, ahead, pulled = np.zeros((end - first, n, q)), np.empty((n, q)), np.empty((m, q))
    steps[rows - 1, first:end] = 0.0
    for r in range(rows - 1, 0, -1):
        for c in range(first, end):
            after, g, w, a = each[c - first], gain[r, c], whitening[r, c], slopes[r - 1, c]
            ahead[:] = after
            for j in range(m):
                pulled[j] = 0.0
                for i in range(n):
                    share = g[i, j]
                    for b in range(q):
                        pulled[j, b] -= share * after[i, b]
                if counted[r, c]:
                    for o in range(j, m):
                        share = w[o, j]
                        for b in range(q):
                            pulled[j, b] += share * white[r, c, o, b]
            for j in range(m):
                for b in range(q):
                    ahead[observed[j], b] += pulled[j, b]
            steps[r - 1, c] = ahead[:ne]
            for j in range(n):
                if j < ne:
                    after[j] = 0.0
                else:
                    share = keep[j - ne]
                    for b in range(q):
                        after[j, b] = share * ahead[j, b]
                for i in range(ne):
                    share = a[i, j]
                    for b in range(q):
                        after[j, b] += share * ahead[i, b]
