"""Inputs and instruments on the rows of a regression, and the tests of their knowledge of its innovations.

An innovation e_k is what one step brings that nothing before it predicted. A score test asks whether columns v_k that
were known then predict it after all,

    S = sum_k e_k r_k,    V = sum_k e_k^2 r_k r_k',    S' V^-1 S ~ chi2(rank),    r: v without what was fitted anyway

with the covariance of White (Econometrica 48 (1980)), which does not need noise to be even. Several tests at once are
judged by Holm's chances (Scandinavian Journal of Statistics 6 (1979)).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.special import chdtrc

from nsde_torch.arrays import Array, Mask
from nsde_torch.columns import join_columns
from nsde_torch.sde.exponential import stiff_change
from nsde_torch.sysid.noise import Series, extended
from nsde_torch.sysid.regression import Regression

_ROWS = 4000  # steps that the mixing of the inputs is read from
_SAME = 0.99  # cosine between directions that are one
_STEADY = 0.5  # share of a slope's square that its mean must have to be a direction
_RANK = 1e-9  # of the largest variance
_SURE, _LEAST = 3.0, 10.0  # standard errors, and nats


@dataclass(frozen=True)
class Direction:
    """A combination of the inputs that drives something."""

    name: str  # what it is called in sentences
    weights: Array  # its weights (nu,), of length one
    channels: tuple[int, ...]  # numbers of the channels that it drives
    slopes: tuple[float, ...]  # rate of each of these per unit of the combination
    moved: tuple[int, ...] = ()
    """Numbers of the channels that it moves within a step: those, and what follows a state that settles within it."""


def box_means(regression: Regression, values: Array) -> Array:
    """Means of columns over steps (N, n) over the boxes of a regression (M, n)."""
    return regression.single.summed(values, regression.box) / regression.box


def spread_out(regression: Regression, values: Array) -> Array:
    """Rows of boxes (M, n) as rows of whitened residuals; the row before each stretch is zero."""
    longer = extended(regression.series)
    out = np.zeros((len(longer), values.shape[1]))
    for (a, b), (c, d) in zip(regression.series.edges, longer.edges, strict=True):
        out[c + 1 : d] = values[a:b]
    return out


def binned(columns: Array, edges: Sequence[int]) -> Array:
    """Sums of columns of 1, 2, ... rows before (N, n) between rows `edges`, of bins that begin among them."""
    bins = [(a, b) for a, b in pairwise(edges) if a <= columns.shape[1]]
    return np.stack([columns[:, a - 1 : b - 1].sum(1) for a, b in bins], 1)


def foreknown(new: Array, values: Array, share: float) -> bool:
    """Whether at most this share of the variance of values (N,) is new (N,), or there is none: that answers nothing."""
    return not len(values) or bool(np.square(new).mean() <= share * values.var())


def late(series: Series, rows: int) -> Mask:
    """Rows that have so many before them in their stretch."""
    return np.asarray(series.place >= rows)


def basis_of(columns: Array) -> Array:
    """Orthonormal columns that span these; none for rounding errors."""
    length = np.linalg.norm(columns, axis=0)
    columns = columns[:, length > 0] / length[length > 0]
    if not columns.shape[1]:
        return columns
    for _ in range(2):  # once more for its rounding; a singular value decomposition takes ten times as long
        values, along = np.linalg.eigh(columns.T @ columns)
        kept = values > _RANK * values[-1]
        columns = columns @ (along[:, kept] / np.sqrt(values[kept]))
    return np.asarray(columns)


def without(values: Array, basis: Array) -> Array:
    """Columns without their part along an orthonormal basis."""
    return np.asarray(values - basis @ (basis.T @ values))


def score_tests(innovations: Array, columns: Array, fitted: Array) -> list[tuple[float, float]]:
    """Chance (p value) of a score as large as this if nothing predicts an innovation, and the share predicted, of each.

    Of innovations (N, k), of columns (N, n) that may predict them, and orthonormal ones (N, p) that they were fitted
    with.
    """
    left, rest = without(innovations, fitted), without(columns, fitted)
    kept = np.linalg.norm(rest, axis=0) > 1e-6 * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    rest = basis_of(rest[:, kept])
    count = rest.shape[1]
    free = max(len(left) - fitted.shape[1] - count, 1)
    out = []
    for e in left.T:
        if not count or not e.any():
            out.append((1.0, 0.0))
            continue
        score = rest.T @ e
        scatter = (rest * np.square(e)[:, None]).T @ rest
        statistic = float(score @ np.linalg.pinv(scatter, hermitian=True) @ score)
        share = float(score @ score / (e @ e))
        # what chance alone predicts is taken off
        out.append((float(chdtrc(count, statistic)), max(0.0, 1.0 - (1.0 - share) * (free + count) / free)))
    return out


def surely_more(nats: Array) -> bool:
    """Whether nats by block of time (B,) are surely more than nothing: by ten, and three errors of their scatter."""
    return float(nats.sum()) > max(_LEAST, _SURE * float(nats.std()) * len(nats) ** 0.5)


def holm(chances: Sequence[float]) -> list[float]:
    """Chances adjusted for their number, in their order."""
    order, out = np.argsort(chances), np.empty(len(chances))
    larger = np.arange(len(chances), 0, -1) * np.asarray(chances, dtype=np.float64)[order]
    out[order] = np.maximum.accumulate(np.fmin(larger, 1.0))
    return out.tolist()


def principal(values: Array) -> Array:
    """Columns (N, n) along their principal directions, those without variance left out."""
    centred = values - values.mean(0)
    _, sizes, axes = np.linalg.svd(centred / np.sqrt(max(len(values), 1)), full_matrices=False)
    if not sizes.size or not sizes[0] > 0:
        return centred[:, :0]
    return np.asarray(centred @ axes[sizes > 1e-5 * sizes[0]].T)


@torch.no_grad()
def input_slopes(
    regression: Regression, way: Array, size: float, some: torch.Tensor, *, over: float = 0.0
) -> Array:
    """What a unit along a combination of inputs (nu,) changes of the rates of channels, at some steps (n, channels).

    By central differences of length `size`; `some` are the numbers of the steps (n,). With `over`, of the mean
    rates over so long [s], which differ where something settles within it.
    """
    physics = regression.physics
    system, steps = physics.vector.system, physics.steps
    physics.vector.use(torch.as_tensor(regression.theta))
    t, x, u = steps.t[some], steps.x0[some], steps.u[some]
    aside = torch.zeros_like(u)
    aside[:, : system.nu] = size * torch.as_tensor(way)

    def rates(v: torch.Tensor) -> torch.Tensor:
        memory = system.augment(x, v)[:, system.nx :]

        def at(z: torch.Tensor) -> torch.Tensor:
            return system.drift(t, join_columns((z, memory)), v)[:, : system.nx]

        return stiff_change(at, x, over) / over if over else at(x)

    change = physics.turn(rates(u + aside) - rates(u - aside), physics.attitude[some])
    return np.asarray(change.numpy()[:, regression.rows] / (2.0 * size))


def row_weights(regression: Regression) -> list[Array]:
    """What each row of a channel weighs in the estimate of each parameter, channel by channel (N, k)."""
    basis = regression.shown.basis
    slopes = [own @ basis for own in regression.slopes]
    squares = [s.T @ s for s in slopes]
    back = basis @ np.linalg.pinv(sum(squares[1:], squares[0]))
    return [own @ back.T for own in slopes]


def directions(regression: Regression) -> list[Direction]:
    """Combinations of the inputs that drive the channels of a regression, by the physics where it stands.

    A lag is taken for settled: what counts is the mixing.
    """
    physics = regression.physics
    system, steps = physics.vector.system, physics.steps
    some = torch.linspace(0, len(steps) - 1, min(len(steps), _ROWS)).round().long()
    slopes = np.empty((len(some), len(regression.rows), system.nu))
    for j, way in enumerate(np.eye(system.nu)):
        size = 1e-3 * max(float(steps.u[some, j].abs().max()), 1e-3)
        slopes[:, :, j] = input_slopes(regression, way, size, some)
    size = np.sqrt(np.square(slopes).mean(0).sum(1))
    motion = np.asarray(steps.u[:, : system.nu]).std(0)
    out: list[Direction] = []
    for i, channel in enumerate(regression.rows):
        mean = slopes[:, i].mean(0)
        length = float(np.linalg.norm(mean))
        if not length > 0 or length**2 < _STEADY * size[i] ** 2 or not np.abs(mean * motion).max() > 0:
            continue
        weights = mean / length
        same = [k for k, d in enumerate(out) if abs(float(d.weights @ weights)) > _SAME]
        if same:
            d = out[same[0]]
            gains = (*d.slopes, float(mean @ d.weights))
            out[same[0]] = replace(d, channels=(*d.channels, int(channel)), slopes=gains)
            continue
        name = system.input_names[0] if system.nu == 1 else f"the input of {physics.names[channel]}"
        out.append(Direction(name, weights, (int(channel),), (length,)))
    if not physics.is_stiff(torch.as_tensor(regression.theta)):
        return [replace(d, moved=d.channels) for d in out]
    return [replace(d, moved=(*d.channels, *_moved(regression, d, some))) for d in out]


def _moved(regression: Regression, way: Direction, some: torch.Tensor) -> list[int]:
    """Numbers of further channels that a direction moves within a step, by what settles within it.

    Their mean rate over a step is hardly more than over half of it, and that of what these move twice as large. A
    voltage moves the speed of a motor whose current settles within a row, and by the current alone its controller,
    which answered the speed, passed for one with sensors of its own (tests/sysid/test_loop.py).
    """
    size = 1e-3 * max(float(regression.physics.steps.u[some].abs().max()), 1e-3)
    half, whole = (
        input_slopes(regression, way.weights, size, some, over=share * regression.physics.steps.dt).mean(0)
        for share in (0.5, 1.0)
    )
    soon = np.abs(whole) < _SOON * np.abs(half)
    return [int(c) for c, now in zip(regression.rows, soon, strict=True) if now and c not in way.channels]


_SOON = 1.5  # how much larger a mean rate over a step is than over half of it, of what moves at once: 1 to 2
