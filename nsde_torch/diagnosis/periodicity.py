"""What repeats: a force that oscillates at a frequency of its own, and one that repeats along a variable.

**In time.** The periodogram of noise is exponential at every frequency, about a slowly varying level:
the median over a band, divided by log 2. The largest of M independent ordinates exceeds -log(p / M) times that level
with chance p (Fisher, Proceedings of the Royal Society A 125 (1929)). Residuals are whitened by what the sensor alone
does to them: an autoregression would have learned the line and taken it out.

**Along a variable**, as teeth, magnets, bearings and threads do:

    r(v) = a sin(2 pi n (v - low) / span) + b cos(2 pi n (v - low) / span)

for n from one and a half to forty periods over the range of v: finer than bins and hats can see. With M trials the
chance of the best is M times that of one.
"""

from dataclasses import dataclass
from math import exp, log

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions
from nsde_torch.inference.force_scores import ForceScores, FunctionScores
from nsde_torch.sysid.noise import extended
from nsde_torch.sysid.regression import Regression

HIGHEST = 0.4  # frequency over the rate of the rows above which a sinusoid is mostly sampling
_SHORTEST_S = 1.0  # stretches that are transformed
_FINER = 8  # points of the grid of frequencies per independent one
_BAND = 40  # independent ordinates that the level is the median of
_MEDIANS = 16  # per window
WHOLE = 0.5 * _BAND  # periods in the longest stretch from which on the band lies to both sides


@dataclass(frozen=True)
class Line:
    """A high ordinate."""

    frequency: float  # where it is [Hz]
    p: float  # chance of one as high anywhere in noise, in any channel
    row: int  # number of the channel, among the rows of the regression, in which it is highest
    height: float  # power over the level of the noise


def periodogram(regression: Regression) -> tuple[Array, Array]:
    """Frequencies [Hz] (M,) and power over its level per channel (channels, M), 1 on average for noise.

    Stretches are transformed on one grid with zeros behind them, and their powers are weighted by their lengths.
    """
    edges = extended(regression.series).edges
    longest = max(b - a for a, b in edges)
    n = int(2 ** np.ceil(np.log2(_FINER * longest)))
    noises = regression.own_noises(0)
    residuals = regression.residual.T[regression.rows]
    pairs = zip(noises, residuals, strict=True)
    white = np.stack([regression.whitened(noise, left[:, None])[:, 0] for noise, left in pairs])
    power, weight = np.zeros((len(white), n // 2 + 1)), 0
    for a, b in edges:
        if (b - a) * regression.dt < _SHORTEST_S:
            continue
        part = white[:, a:b]
        power += np.abs(np.fft.rfft(part - part.mean(1, keepdims=True), n)) ** 2
        weight += b - a
    level = _running_median(power, max(3, round(_BAND * n / longest))) / log(2.0)
    frequency: Array = np.fft.rfftfreq(n, regression.dt).astype(np.float64)
    return frequency, power / np.maximum(level, 1e-300)


def _running_median(power: Array, width: int) -> Array:
    """Median over a window (channels, M): at some points of each window, straight lines between them."""
    count = power.shape[1]
    half = min(width, count) // 2
    padded = np.pad(power, ((0, 0), (half, half)), mode="edge")
    step = max(1, width // _MEDIANS)
    at = np.append(np.arange(0, count - 1, step), count - 1)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=1)
    return np.stack([np.interp(np.arange(count), at, np.median(w[at], axis=1)) for w in windows])


def lines(
    regression: Regression,
    *,
    fewest: float | None = None,
    decisions: Decisions = DECISIONS,
    budgets: Budgets = BUDGETS,
) -> list[Line]:
    """The highest ordinates over all channels, the surest first, at least a period apart in the longest stretch.

    There are `fewest` periods at least in it; None takes those of `decisions`. Below `WHOLE` the level is that of one
    side of the band, and slow gusts stand above it.
    """
    longest = max(b - a for a, b in regression.series.edges) * regression.dt
    if longest < _SHORTEST_S:
        return []
    fewest = decisions.least_periods if fewest is None else fewest
    frequency, power = periodogram(regression)
    usable = (frequency > fewest / longest) & (frequency < HIGHEST / regression.dt)
    height = np.where(usable, power.max(0), 0.0)
    tried = len(power) * max(1.0, 0.5 * longest / regression.dt)
    out: list[Line] = []
    for i in np.argsort(-height):
        if height[i] <= 0 or len(out) == budgets.spectral_lines:
            break
        if all(abs(frequency[i] - line.frequency) > decisions.least_periods / longest for line in out):
            p = min(1.0, tried * exp(-min(float(height[i]), 700.0)))
            out.append(Line(float(frequency[i]), p, int(power[:, i].argmax()), float(height[i])))
    return out


def waves_of(regression: Regression, frequency: float) -> Array:
    """A sine and a cosine of a frequency [Hz] for each stretch, nothing elsewhere (M, 2 stretches)."""
    angle = 2.0 * np.pi * frequency * regression.dt * np.arange(len(regression.series))
    waves: Array = np.zeros((len(angle), 2 * len(regression.series.edges)))
    for k, (a, b) in enumerate(regression.series.edges):
        waves[a:b, 2 * k], waves[a:b, 2 * k + 1] = np.sin(angle[a:b]), np.cos(angle[a:b])
    return waves


# ---- along a variable ----------------------------------------------------------------------------------

COUNTS: Array = np.arange(1.5, 40.5, 0.5)  # periods over the range that are tried
PARTS: Array = 2.0 * np.pi / np.arange(1, 129)  # parts of a turn that are tried of what turns many times
_NEAR: Array = np.linspace(-0.45, 0.45, 10)


@dataclass(frozen=True)
class Repeat:
    """The period that helps most."""

    period: float  # of the variable, in its unit
    waves: Array  # a sine and a cosine of it (M, 2)
    scores: FunctionScores  # of these


def best_repeat(forces: ForceScores, port: int, v: Array, periods: Array | None = None) -> Repeat | None:
    """The best of some periods of a variable (M,), in its unit, or None where it does not move.

    None tries `COUNTS` over its range.
    """
    low, high = np.quantile(v, [0.005, 0.995])
    span = float(high - low)
    if not span > 0:
        return None
    turn = 2.0 * np.pi * (v - low) / span

    def waves(counts: Array) -> Array:
        angle = turn[:, None] * counts
        return np.stack((np.sin(angle), np.cos(angle)), 2).reshape(len(v), -1)

    def best_of(counts: Array) -> float:
        """The count of which a sine and a cosine bring most."""
        all_scores, pairs = forces.of(waves(counts), port), 2 * np.arange(len(counts))[:, None] + np.arange(2)
        total, whole = all_scores.total[pairs], all_scores.information
        grams = whole[pairs[:, :, None], pairs[:, None, :]]
        brought = np.einsum("ki,kij,kj->k", total, np.linalg.pinv(grams, rcond=1e-12), total)
        return float(counts[brought.argmax()])

    coarse = best_of(COUNTS if periods is None else span / periods)
    best = best_of(np.append(coarse, coarse + _NEAR))
    own = waves(np.array([best]))
    return Repeat(span / best, own, forces.of(own, port))
