"""The recursions of a filter over the rows of chunks, compiled.

They are loops over matrices of a few rows: called one by one from Python, the calls alone take ten times as long as
what is done in them. A step x -> A x of the errors of n = ne + d states, of which the last d are Ornstein-Uhlenbeck
disturbances that keep a share, has the transition

    F = | A (ne, n)    |
        | 0   keep (d) |

Arrays are (rows T, chunks C, ...) as in `nsde_torch.inference.filtering`, contiguous and in double precision. Each
kernel works on the chunks from `first` to `end`: chunks know nothing of one another, and parts of them run side by side
(`in_parts`). Further arguments of a kernel are in its docstring, in order.
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
from nsde_torch.inference.lanes import WIDTH, lanes, load, root, store
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
def _copy(of: Array, out: Array) -> None:
    """A matrix to another place; as an assignment it takes seconds to compile, which can fail in many words."""
    for i in range(of.shape[0]):
        for j in range(of.shape[1]):
            out[i, j] = of[i, j]


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
def covariances(first: int, end: int, *of: Any) -> None:
    """Kalman gains, and what whitens the innovations.

    Args:
        slopes: A of the step from each row (T, C, ne, n).
        keep: Share of each disturbance that is left after a step (d,).
        white, gust: Variance that a step adds to the ports and to the disturbances (d,).
        sensor: Variance of the sensors (m,).
        start: Variances of the errors that each chunk starts with (C, n).
        observed: Numbers of the measured errors (m,).
        measured: Whether a row measures each of these (T, C, m); (0, 0, 0) where all do.
        whitening, gain: Are filled (T, C, m, m) and (T, C, n, m).
        left: Is filled with covariances of all errors with the last ones after each row (T, C, n, q); not if empty.
    """
    slopes, keep, white, gust, sensor, start, observed, measured, whitening, gain, left = of
    rows, _, ne, n = slopes.shape
    m = len(observed)
    a, moved, p = np.empty((ne, n, WIDTH)), np.empty((ne, n, WIDTH)), np.empty((n, n, WIDTH))
    w, g, half, room = _room_to_update(n, m)
    shown = np.empty((m if len(measured) else 0, WIDTH))
    for c in range(first, end, WIDTH):
        _begun(start, c, end, p)
        w[:], g[:] = 0.0, 0.0
        for i in range(m):
            store(w[i, i], 1.0)
        for k in range(rows):
            if k:
                _gather(slopes[k - 1], c, end, a)
                _predicted(a, keep, white, gust, p, moved)
                if len(measured):
                    _gather_rows(measured[k], c, end, shown)
                _updated(p, sensor, observed, shown, w, g, half, room)
            _scatter(w, c, end, whitening[k])
            _scatter(g, c, end, gain[k])
            if len(left):
                _scatter(p[:, n - left.shape[3] :], c, end, left[k])


@compiled
def _room_to_update(n: int, m: int) -> tuple[Array, Array, Array, Array]:
    """Room for what `_updated` fills, and to work in."""
    return np.empty((m, m, WIDTH)), np.empty((n, m, WIDTH)), np.empty((n, m, WIDTH)), np.empty((m, m, WIDTH))


@compiled
def _begun(start: Array, first: int, end: int, p: Array) -> None:
    """The covariance p (n, n, WIDTH) is filled with that of independent errors of the chunks from `first` on."""
    p[:] = 0.0
    for lane in range(WIDTH):
        own = start[min(first + lane, end - 1)]
        for i in range(len(own)):
            p[i, i, lane] = own[i]


@compiled
def _gather(of: Array, first: int, end: int, out: Array) -> None:
    """Matrices (C, a, b) of the chunks from `first` on, side by side (a, b, WIDTH); behind the end, the last one."""
    for lane in range(WIDTH):
        own = of[min(first + lane, end - 1)]
        for i in range(own.shape[0]):
            for j in range(own.shape[1]):
                out[i, j, lane] = own[i, j]


@compiled
def _gather_rows(of: NDArray[Any], first: int, end: int, out: Array) -> None:
    """The same of rows (C, a), side by side (a, WIDTH)."""
    for lane in range(WIDTH):
        for i in range(of.shape[1]):
            out[i, lane] = of[min(first + lane, end - 1), i]


@compiled
def _scatter(of: Array, first: int, end: int, out: Array) -> None:
    """Matrices side by side (a, b, WIDTH) go back to those of the chunks (C, a, b) before the end."""
    for lane in range(min(WIDTH, end - first)):
        own = out[first + lane]
        for i in range(own.shape[0]):
            for j in range(own.shape[1]):
                own[i, j] = of[i, j, lane]


@compiled
def _add_product(a: Array, b: Array, scale: float, out: Array, symmetric: bool) -> None:
    """out += scale a b, matrices (.., .., WIDTH) side by side; where that is symmetric, half of it is worked out.

    Four elements at once: what is loaded serves two of them.
    """
    inner, rows, columns = b.shape[0], out.shape[0], out.shape[1]
    for i in range(0, rows, 2):
        k = min(i + 1, rows - 1)
        for j in range(0, min(i + 2, columns) if symmetric else columns, 2):
            q = min(j + 1, columns - 1)
            ij, iq, kj, kq = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
            for o in range(inner):
                ao, co, bo, do = load(a[i, o]), load(a[k, o]), load(b[o, j]), load(b[o, q])
                ij += ao * bo
                iq += ao * do
                kj += co * bo
                kq += co * do
            ij, iq = load(out[i, j]) + scale * ij, load(out[i, q]) + scale * iq
            kj, kq = load(out[k, j]) + scale * kj, load(out[k, q]) + scale * kq
            store(out[i, j], ij)
            store(out[i, q], iq)
            store(out[k, j], kj)
            store(out[k, q], kq)
            if symmetric and j < i:
                store(out[j, i], ij)
                store(out[q, i], iq)
                store(out[j, k], kj)
                store(out[q, k], kq)


@compiled
def _updated(
    p: Array, sensor: Array, observed: Labels, shown: Array, w: Array, g: Array, half: Array, room: Array
) -> None:
    """The covariance p (n, n, WIDTH) after a row, in place.

    Args:
        shown: 1 where the row measures a channel, 0 where not (m, WIDTH); empty where it measures all.
        w, g: Are filled with what whitens the innovation (m, m, WIDTH) and with the gain (n, m, WIDTH).
        half, room: To work in, as large as the gain and as what whitens.
    """
    n, m = len(p), len(w)
    for i in range(m):
        for j in range(i + 1):
            seen = load(p[observed[i], observed[j]])
            if i == j:
                seen += sensor[i]
            if len(shown):  # a channel that the row does not measure is white noise of its own
                seen = seen * load(shown[i]) * load(shown[j])
                if i == j:
                    seen += 1.0 - load(shown[i])
            store(room[i, j], seen)
    _inverse_triangle(room, w)
    if len(shown):  # and neither moves the state nor counts
        for i in range(m):
            for j in range(i + 1):
                store(w[i, j], load(w[i, j]) * load(shown[i]))
    for i in range(n):  # P H' L^-T
        for j in range(m):
            total = lanes(0.0)
            for o in range(j + 1):
                total += load(p[i, observed[o]]) * load(w[j, o])
            store(half[i, j], total)
    _add_product(half, half.transpose(1, 0, 2), -1.0, p, True)
    for i in range(n):
        for j in range(m):
            total = lanes(0.0)
            for o in range(j, m):
                total += load(half[i, o]) * load(w[o, j])
            store(g[i, j], total)


@compiled
def gated(first: int, end: int, *of: Any) -> None:
    """Marks measurements that are further off than `gate` standard deviations as none, and goes on without them.

    Args:
        slopes, keep, white, gust, sensor, start, observed: As in `covariances`.
        begun, missed, seen: As in `means`.
        gate: Standard deviations of an innovation.
        measured: Whether a row measures each channel (T, C, m); what is beyond the gate is set to false.
    """
    slopes, keep, white, gust, sensor, start, observed, begun, missed, seen, gate, measured = of
    rows, _, ne, n = slopes.shape
    m = len(observed)
    a, moved, p = np.empty((ne, n, WIDTH)), np.empty((ne, n, WIDTH)), np.empty((n, n, WIDTH))
    w, g, half, room = _room_to_update(n, m)
    shown, mean, error = np.empty((m, WIDTH)), np.empty(n), np.empty(m)
    for c in range(first, end, WIDTH):
        _begun(start, c, end, p)
        left = np.zeros((WIDTH, n))
        for lane in range(min(WIDTH, end - c)):
            for i in range(ne):
                left[lane, i] = begun[c + lane, i]
        for k in range(1, rows):
            _gather(slopes[k - 1], c, end, a)
            _predicted(a, keep, white, gust, p, moved)
            for lane in range(min(WIDTH, end - c)):
                _ahead(slopes[k - 1, c + lane], keep, missed[k - 1, c + lane], left[lane], mean)
                for i in range(n):
                    left[lane, i] = mean[i]
                for j in range(m):
                    o = observed[j]
                    off = seen[k, c + lane, j] - mean[o]
                    if off * off > gate * gate * (p[o, o, lane] + sensor[j]):
                        measured[k, c + lane, j] = False
            _gather_rows(measured[k], c, end, shown)
            _updated(p, sensor, observed, shown, w, g, half, room)
            for lane in range(min(WIDTH, end - c)):
                for j in range(m):
                    error[j] = seen[k, c + lane, j] - left[lane, observed[j]]
                for i in range(n):
                    left[lane, i] += _dot(g[i, :, lane], error)


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
    """F P F' and what a step adds (n, n, WIDTH), in place; `moved` (ne, n, WIDTH) is room to work in."""
    ne, n = a.shape[0], a.shape[1]
    d = n - ne
    moved[:] = 0.0
    _add_product(a, p, 1.0, moved, False)
    for e in range(d):
        for i in range(ne):
            crossed = load(moved[i, ne + e])
            store(p[i, ne + e], crossed * keep[e])
            store(p[ne + e, i], crossed * keep[e])
            store(moved[i, ne + e], crossed + load(a[i, ne + e]) * white[e])
        for f in range(d):
            store(p[ne + e, ne + f], load(p[ne + e, ne + f]) * (keep[e] * keep[f]))
        store(p[ne + e, ne + e], load(p[ne + e, ne + e]) + gust[e])
    p[:ne, :ne] = 0.0
    _add_product(moved, a.transpose(1, 0, 2), 1.0, p[:ne, :ne], True)


@compiled
def _inverse_triangle(s: Array, inverse: Array) -> None:
    """L^-1 of s = L L' (m, m, WIDTH), of which the lower triangle is read and lost."""
    m = len(s)
    for i in range(m):
        for j in range(i):
            total = load(s[i, j])
            for o in range(j):
                total -= load(s[i, o]) * load(s[j, o])
            store(s[i, j], total * load(inverse[j, j]))
        total = load(s[i, i])
        for o in range(i):
            total -= load(s[i, o]) * load(s[i, o])
        store(inverse[i, i], 1.0 / root(total))
    for i in range(m):
        for j in range(i):
            total = lanes(0.0)
            for o in range(j, i):
                total -= load(s[i, o]) * load(inverse[o, j])
            store(inverse[i, j], total * load(inverse[i, i]))
            store(inverse[j, i], 0.0)


@compiled
def means(first: int, end: int, *of: Any) -> None:
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
    slopes, keep, begun, missed, seen, observed, live, whitening, gain, errors, white, left, nats = of
    rows, _, ne, n = slopes.shape
    m = len(observed)
    p = np.empty(n)
    for k in range(rows):
        for c in range(first, end):
            if k:
                _ahead(slopes[k - 1, c], keep, missed[k - 1, c], left[k - 1, c], p)
            else:
                p[:] = 0.0
                for i in range(ne):
                    p[i] = begun[c, i]
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
def adjoints(first: int, end: int, *of: Any) -> None:
    """One pass backwards: what the log likelihood does with each source of noise (`nsde_torch.inference.maximum`).

    Args:
        slopes, keep, observed, whitening, gain: Of the pass.
        whitened: Its innovations in standard deviations (T, C, m).
        left_mean, left: Mean (T, C, n) and covariance with the disturbances (T, C, n, d) after each row.
        live: Whether a row counts (T, C).
        sensors: Is filled with the slope in the variance of each sensor (C, m).
        struck, gusts, begun: Those in the variance that a step adds to each port and to each disturbance, and that a
            disturbance starts with (C, d).
        kept: That in the share that is left of a disturbance after a step (C, d).
    """
    slopes, keep, observed, whitening, gain, whitened, left_mean, left = of[:8]
    live, sensors, struck, gusts, begun, kept = of[8:]
    rows, _, ne, n = slopes.shape
    m, d = len(observed), n - ne
    mean, spread = np.empty((n, WIDTH)), np.empty((n, n, WIDTH))
    a, w, g = np.empty((ne, n, WIDTH)), np.empty((m, m, WIDTH)), np.empty((n, m, WIDTH))
    moved, turned, passed = np.empty((n, WIDTH)), np.empty((n, n, WIDTH)), np.empty((n, m, WIDTH))
    v, white, pulled = np.empty((m, WIDTH)), np.empty((m, WIDTH)), np.empty((m, WIDTH))
    weight = np.empty(WIDTH)
    own, of_passed = np.empty((m, m, WIDTH)), np.empty((n, m, WIDTH))
    before, mean_before = np.empty((n, d, WIDTH)), np.empty((n, WIDTH))
    of_sensors, of_ports = np.empty((m, WIDTH)), np.empty((d, WIDTH))
    of_gusts, of_kept = np.empty((d, WIDTH)), np.empty((d, WIDTH))
    for c in range(first, end, WIDTH):
        mean[:], spread[:] = 0.0, 0.0
        of_sensors[:], of_ports[:], of_gusts[:], of_kept[:] = 0.0, 0.0, 0.0, 0.0
        for k in range(rows - 1, 0, -1):
            _gather(whitening[k], c, end, w)
            _gather(gain[k], c, end, g)
            _gather(slopes[k - 1], c, end, a)
            _gather(left[k - 1], c, end, before)
            _gather_rows(left_mean[k - 1], c, end, mean_before)
            _gather_rows(whitened[k], c, end, white)
            for lane in range(WIDTH):
                weight[lane] = 0.5 if live[k, min(c + lane, end - 1)] else 0.0
            _row_adjoints(
                w, g, observed, white, weight, mean, spread, v, own, pulled, passed, of_passed, of_sensors
            )
            # of the row before: F' a and F' A F
            turned[:] = 0.0
            _add_product(spread, a, 1.0, turned, False)
            for e in range(d):
                port = ne + e
                total = load(of_ports[e])
                for i in range(ne):
                    total += load(a[i, port]) * load(turned[i, port])
                store(of_ports[e], total)
                store(of_gusts[e], load(of_gusts[e]) + load(spread[port, port]))
                for i in range(n):
                    store(turned[i, port], load(turned[i, port]) + load(spread[i, port]) * keep[e])
            for e in range(d):
                port = ne + e
                total = lanes(0.0)
                for o in range(n):
                    total += load(turned[port, o]) * load(before[o, e])
                lasts = 2.0 * total + load(mean[port]) * load(mean_before[port])
                store(of_kept[e], load(of_kept[e]) + lasts)
            for i in range(n):
                total = load(mean[i]) * keep[i - ne] if i >= ne else lanes(0.0)
                for o in range(ne):
                    total += load(a[o, i]) * load(mean[o])
                store(moved[i], total)
            spread[:] = 0.0
            for e in range(d):
                for j in range(n):
                    store(spread[ne + e, j], load(turned[ne + e, j]) * keep[e])
            # one side alone: the asymmetry that rounding makes of two grows from row to row where sensors are very
            # precise (a gradient of 1e65 after 500 rows of NeuroBEM)
            _add_product(a.transpose(1, 0, 2), turned[:ne], 1.0, spread, True)
            for i in range(n):
                store(mean[i], load(moved[i]))
        for j in range(m):  # a chunk starts as uncertain as its sensors and disturbances
            store(of_sensors[j], load(of_sensors[j]) + load(spread[observed[j], observed[j]]))
        for lane in range(min(WIDTH, end - c)):
            for j in range(m):
                sensors[c + lane, j] = of_sensors[j, lane]
            for e in range(d):
                struck[c + lane, e], gusts[c + lane, e] = of_ports[e, lane], of_gusts[e, lane]
                kept[c + lane, e], begun[c + lane, e] = of_kept[e, lane], spread[ne + e, ne + e, lane]


@compiled
def _row_adjoints(*of: Any) -> None:
    """The adjoints of the mean (n, WIDTH) and covariance (n, n, WIDTH) before a row's update, from those after it.

    In place: (I - G H)' a and (I - G H)' A (I - G H), and what the row itself says of both.

    Args:
        w, g, white: Of the row: what whitens (m, m, WIDTH), gain (n, m, WIDTH) and whitened innovation (m, WIDTH).
        weight: 1/2 where the row counts, else 0 (WIDTH,).
        v, own, pulled, passed, of_passed: To work in.
        of_sensors: Slopes in the variance of each sensor (m, WIDTH), which are added to.
    """
    w, g, observed, white, weight, mean, spread, v, own, pulled, passed, of_passed, of_sensors = of
    n, m = len(mean), len(v)
    for j in range(m):  # S^-1 e
        total = lanes(0.0)
        for o in range(j, m):
            total += load(w[o, j]) * load(white[o])
        store(v[j], total)
    for i in range(m):
        for j in range(i + 1):
            total = load(v[i]) * load(v[j])
            for o in range(i, m):
                total -= load(w[o, i]) * load(w[o, j])
            store(own[i, j], total * load(weight))
            store(own[j, i], total * load(weight))
    for i in range(n):
        for j in range(m):
            store(passed[i, j], (1.0 if i == observed[j] else 0.0) - load(g[i, j]))
    # I - G H is made first: A - A G H would be the difference of two large numbers where a sensor is much better than
    # what is predicted
    of_passed[:] = 0.0
    _add_product(spread, passed, 1.0, of_passed, False)
    for j in range(m):
        at, for_sensor = lanes(0.0), load(own[j, j])
        total = lanes(0.0)
        for o in range(n):
            total += load(g[o, j]) * load(mean[o])
            # A G H = A - A (I - G H)
            for_sensor += load(g[o, j]) * (load(spread[o, observed[j]]) - load(of_passed[o, j]))
            at += load(passed[o, j]) * load(mean[o])
        store(of_sensors[j], load(of_sensors[j]) + for_sensor - total * load(v[j]))
        store(pulled[j], at)
    _add_product(passed.transpose(1, 0, 2), of_passed, 1.0, own, True)
    for j in range(m):
        for i in range(n):
            store(spread[i, observed[j]], load(of_passed[i, j]))
            store(spread[observed[j], i], load(of_passed[i, j]))
    for i in range(m):
        store(mean[observed[i]], load(pulled[i]))
        for j in range(i + 1):
            store(spread[observed[i], observed[j]], load(own[i, j]))
            store(spread[observed[j], observed[i]], load(own[i, j]))
    for i in range(n):
        for j in range(m):
            crossed = 0.5 * load(mean[i]) * load(v[j])
            store(spread[i, observed[j]], load(spread[i, observed[j]]) + crossed)
            store(spread[observed[j], i], load(spread[observed[j], i]) + crossed)
    for i in range(m):
        store(mean[observed[i]], load(mean[observed[i]]) + 2.0 * load(weight) * load(v[i]))


@compiled
def slopes_in_levels(first: int, end: int, *of: Any) -> None:
    """One pass forwards: slopes of the whitened innovations in each level (`nsde_torch.inference.maximum`).

    Args:
        slopes, keep, observed, whitening, gain, whitened, left_mean, left: As in `adjoints`.
        kept: Slope of `keep` in the logarithm of the time constant (d,).
        white: Variance that a step adds to the ports (d,).
        gust, sensor: Variance of the disturbances (d,) and of the sensors (m,).
        z: Is filled with the slopes of the whitened innovations (T, C, m, p).
        turned: Is filled with those of their covariances (T, C, p, m, m); not if empty.
    """
    slopes, keep, observed, whitening, gain, whitened, left_mean, left = of[:8]
    kept, white, gust, sensor, z, turned = of[8:]
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
                    last = 0.0 if i < ne else keep[i - ne] * left[k, c, i, e]
                    if i < ne:
                        for o in range(n):
                            last += a[i, o] * left[k, c, o, e]
                    carried[i, e] = kept[e] * last
            v[:] = 0.0
            if k:  # no innovation where a chunk starts; S^-1 e = L^-T L^-1 e
                for j in range(m):
                    for o in range(j, m):
                        v[j] += w[o, j] * whitened[k, c, o]
            for q in range(p):
                part = spread[q]
                for i in range(n):
                    total = mean[q, i]
                    for j in range(m):
                        total += part[i, observed[j]] * v[j]
                    answered[i] = total
                for i in range(n):
                    mean[q, i] = _dot(closed[i], answered)
            _copy(closed.T, across)
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
            _copy(after.T, after_t)
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
def sensitivities(first: int, end: int, *of: Any) -> None:
    """What unknowns do to the whitened innovations of some rows (`nsde_torch.inference.sensitivity`).

    Args:
        slopes, gain: Of the rows before these, from which steps lead to these (T, C, ne, n), (T, C, n, m).
        keep, observed: As in `covariances`.
        whitening: Of these rows (T, C, m, m).
        place: Where in the table a row stands (T, C); below 0 where it does not.
        columns: What k parameters do to the steps (T, C, ne, k).
        forces: Forces of q others on disturbances (T, C, q).
        acts: Numbers of these disturbances (q,).
        moved: What they do to the predicted states of the row before; is left with that of the last row (C, n, k + q).
        begun: The first column of the table that is filled.
        table: Rows that stand there are filled (C, rows, m, begun + k + q and more).
    """
    slopes, keep, observed, gain, whitening, place, columns, forces, acts, moved, begun, table = of
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
            _copy(after, now)
            if place[r, c] >= 0:
                for j in range(m):
                    for q in range(k + more):
                        seen[j, q] = after[observed[j], q]
                np.dot(whitening[r, c], seen, white)
                out = table[c, place[r, c]]
                for j in range(m):
                    for q in range(k + more):
                        out[j, begun + q] = white[j, q]


@compiled
def step_adjoints(first: int, end: int, *of: Any) -> None:
    """Slopes of sums of whitened rows in what is done to each step (`nsde_torch.inference.force_scores`).

    Args:
        slopes, keep, observed, whitening, gain: As in `covariances`.
        counted: Whether a row counts (T, C).
        white: Rows of the whitened innovations, q of them side by side (T, C, m, q).
        steps: Is filled (T, C, ne, q); nothing follows from the last row.
    """
    slopes, keep, observed, whitening, gain, counted, white, steps = of
    rows, _, ne, n = slopes.shape
    m, q = len(observed), white.shape[3]
    each, ahead, pulled = np.zeros((end - first, n, q)), np.empty((n, q)), np.empty((m, q))
    steps[rows - 1, first:end] = 0.0
    for r in range(rows - 1, 0, -1):
        for c in range(first, end):
            after, g, w, a = each[c - first], gain[r, c], whitening[r, c], slopes[r - 1, c]
            _copy(after, ahead)
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
            _copy(ahead[:ne], steps[r - 1, c])
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
