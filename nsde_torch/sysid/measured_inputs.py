"""Inputs as a sensor measured them, which is not how they act: noise about levels, white noise, motion between rows.

A log of commands holds each from its row to the next. A log of what a load cell or a tachometer measured does not, and
what is read wrongly passes for a saturation, a dead band or a memory (docs/content/theory/recording.md):

    noise about levels     x' = f(x, l(u)), l(u) the level that u is near, or u where it is near none
    white noise            u through 1 - 2 s^2 / S(f), with S its spectrum and s^2 its variance (Wiener), or
                           u_k - s^2 / S^2 e_k, with e_k of variance S^2 what the rows before do not predict of it: the
                           first knows more, but in a loop rows after k answer what pushed the machine at k
    motion between rows    x' = f(x, (u_k + u_{k+1}) / 2) over the step

Each is fitted beside what was logged, and taken where the log is likelier with it by `NATS`: 10 to 2,600 of noise about
levels of springs, pendulums and arms, 20 to 200 of white noise, 40 to 180 of what moves between rows; -7 to -12,000 of
means of commands that are held, in loops too. Nor may a lag, a delay, play, a dead band or a limit that nobody declared
explain as much as noise does, or a hidden mass as much as means.
"""

import copy
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.fft import fftshift, irfft
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter
from scipy.signal import fftconvolve, get_window, lfilter, welch
from scipy.special import ndtri

from nsde_torch.arrays import Array
from nsde_torch.data import DataSet, Finding, Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.inference.estimate import LogLikelihood, nearly_maximised
from nsde_torch.sysid.rough import beginnings
from nsde_torch.systems import System
from nsde_torch.texts import rendered

NATS = 5.0
"""By which a log must be likelier with another reading of its inputs; one that does nothing brings 0 +- 1."""
_PART_S, _FEWEST = 120.0, 600  # of the log that is asked for levels [s], and rows of each run at least
_ROWS, _FEWEST_ROWS = 3000, 100  # of the log, and of each run at least, that are asked for the others
_HELD = 0.5  # share of values that are as in the row before, above which inputs are held
_NEAR = 4.0  # standard deviations of the noise, within which an input is at a level
_MOST_LEVELS, _SAME = 8, 0.2  # levels at most, and share of the rows that stay at theirs at least
_FEW, _BETWEEN = 0.03, 0.4  # shares of the rows: at a level, at least, and between levels, at most
_TIGHT = 0.85  # share of those at a level that are within two standard deviations: normal 0.95, of waves 0.5
_ORDER = 20  # rows before, that predict an input
_WINDOW, _SLOW = 2048, 4  # rows of a spectrum, and its lowest frequencies, which it does not resolve
_AROUND, _WAVE = 7, 4.0  # frequencies about each, and times their median that a wave is
_TOP, _NOTHING = 0.35, 1e-6
"""Rows^-1 above which a spectrum may be white noise, and the share of an input's variance below which that is none."""
_MOST_OF_IT = 0.25
"""Share of it that noise may be: the flow through a heat exchanger, drawn anew every few seconds, was all noise."""
_FIRST, _ALIKE = 1.0 / 64.0, 2.0
"""Share of that which is tried first, and ratio of variances up to which inputs are taken for equally noisy."""
_LAGS, _DELAYS, _GAPS, _DEAD, _WITHIN = (1, 3, 10, 30), (1, 3, 10), (0.1, 0.3, 1.0), (0.2,), (0.8, 0.95)
"""What nobody may have declared: lags of first order and delays [rows], play and dead bands [standard deviations of the
input], and limits [share of the rows within]. Lags of 0.02 to 0.1 s are none of a heat exchanger that is logged every
second: what its flow does there was noise of 0.15 kg/s."""
_UNFIT = ConfigError, DataError, NonFiniteError, np.linalg.LinAlgError


@dataclass(frozen=True)
class NoisyInput:
    """An input that is mostly near a few levels."""

    column: int
    levels: Array
    std: float  # of the noise about them [unit of the input]

    def on_levels(self, run: Run) -> Run:
        """A run in which values near a level are this level."""
        u = np.array(run.u)
        own = u[:, self.column]
        nearest = self.levels[np.abs(own[:, None] - self.levels).argmin(1)]
        u[:, self.column] = np.where(np.abs(own - nearest) < _NEAR * self.std, nearest, own)
        return replace(run, u=u)


def without_noise_about_levels(data: DataSet, system: System) -> DataSet:
    """A data set without noise about the levels of its inputs that surely does not act.

    Its summary has a finding `input_noise` for each of these inputs.
    """
    around = [one for j in range(system.nu) if (one := around_levels(data.runs, j)) is not None]
    if not around:
        return data
    some = beginnings(data.runs, data.clock_scale, seconds=_PART_S, fewest=_FEWEST)
    runs, findings = list(data.runs), list(data.summary.findings)
    fits = _Fits(system, some, data.clock_scale)
    for one in around:
        other = [one.on_levels(run) for run in some]
        nats = fits.likelier(other)
        if nats > NATS:
            findings.append(_noise_found(one, system, nats))
            runs, some = [one.on_levels(run) for run in runs], other
            fits = _Fits(system, some, data.clock_scale)
    return data.changed(runs, findings)


def as_they_act(data: DataSet, system: System, fitted: Sequence[Run]) -> DataSet:
    """A data set without white noise of its inputs, and with their means over steps, where that is surely how they act.

    Its summary has a finding `input_noise` or `input_between_rows` then. Physics is fitted to the runs `fitted`, which
    may be those of the data without what a smoother did to their states.
    """
    clock = data.clock_scale
    some = beginnings(fitted, clock, seconds=_ROWS * data.dt * clock, fewest=_FEWEST_ROWS)
    left: list[_Way] = [_without_white_noise, _with_means_over_steps]
    while left:  # the likelier first, and the other where there is more to it
        fits = _Fits(system, some, clock)
        found = [(way, reading) for way in left if (reading := way(fits, some, system))]
        if not found:
            break
        taken, best = max(found, key=lambda one: one[1].nats)
        left.remove(taken)
        data = data.changed(best.read(data.runs), [*data.summary.findings, best.finding])
        some = best.read(some)
    return data


@dataclass(frozen=True)
class _Reading:
    """Another reading of the inputs, by which a log is surely likelier."""

    nats: float
    read: Callable[[Sequence[Run]], list[Run]]
    finding: Finding


class _Fits:
    """Physics fitted to the same rows with other inputs, each from where the fit of the first has ended."""

    def __init__(self, system: System, runs: Sequence[Run], clock: float) -> None:
        self._system, self._clock = copy.deepcopy(system), clock
        self._likelihood, self._near = math.nan, None
        with suppress(*_UNFIT):  # who fits these data next says why
            problem = LogLikelihood(system, runs, clock)
            best, self._near = nearly_maximised(problem)
            problem.vector.write(self._system, best.theta)
            self._likelihood = best.likelihood

    def likelier(self, runs: Sequence[Run]) -> float:
        """By how much the log is likelier with other inputs [nats]; -inf where physics cannot be fitted."""
        if self._near is None:
            return -math.inf
        try:
            # disturbed where the first fit is: with angles of the other sign the pole's half length went to 125 m, at
            # which a torque on it pushes in no way of its own (physical-cartpole)
            space = self._near.of.space
            problem = LogLikelihood(self._system, runs, self._clock, disturbances=space.disturbances)
            problem.space.measured = space.measured  # without the same outliers
            return nearly_maximised(problem, self._near)[0].likelihood - self._likelihood
        except _UNFIT:
            return -math.inf

    def with_a_resonance(self) -> float:
        """By how much the log, as it is, is likelier with the best resonance of the catalogue that nobody declared."""
        system, best = self._system, -math.inf
        if self._near is None:
            return best
        sizes = self._near.of.sizes
        for name, effect in system.able_effects().items():
            for values in effect.fits_from(sizes) if name not in system.effect_names else ():
                with suppress(*_UNFIT):
                    beside = system.with_effects(system.make_effect(name, dict(values)))
                    found = nearly_maximised(self._near.of.of(beside), self._near)[0]
                    best = max(best, found.likelihood - self._likelihood)
        return best


_Way = Callable[["_Fits", Sequence[Run], System], _Reading | None]


def _with_means_over_steps(fits: _Fits, runs: Sequence[Run], system: System) -> _Reading | None:
    """Inputs that move between rows.

    Of two values a mean holds less of their noise, that with the row before too; and what nobody declared may look like
    an input that is early: of dry friction of a pendulum the mean brings 10 nats, and the next row 20. Of a hidden mass
    of 9 % the mean brings 93, which the mass explains with 1,741 more, and a difference between runs was found beside
    it (benchmarks/blind/hidden_masses.py, spring 5).
    """
    moving = tuple(j for j in range(system.nu) if not _held(runs, j))
    nats = fits.likelier(later(runs, moving, 0.5))
    # of one kind at once. A turbine's wind is sampled and its torque held: as neither moved, it had an `input_delay`
    while len(kinds := {system.input_units[j] for j in moving}) > 1:
        fewer = [tuple(j for j in moving if system.input_units[j] != kind) for kind in sorted(kinds)]
        best, some = max((fits.likelier(later(runs, some, 0.5)), some) for some in fewer)
        if not best > nats:
            break
        nats, moving = best, some
    if not nats > NATS:
        return None
    if any(not nats - fits.likelier(later(runs, moving, rows)) > NATS for rows in (-0.5, 1.0)):
        return None
    if not nats - fits.with_a_resonance() > NATS:
        return None

    def means(some: Sequence[Run]) -> list[Run]:
        return [replace(run, ahead=0.5 * run.dt) for run in later(some, moving, 0.5)]

    return _Reading(nats, means, _between_rows_found([system.input_names[j] for j in moving], nats))


def _without_white_noise(fits: _Fits, runs: Sequence[Run], system: System) -> _Reading | None:
    """Inputs as they are to be expected, at the noise that is likeliest."""
    nu, noise = system.nu, _white_noise(runs, system.nu)
    share = np.full(nu, _FIRST)
    if noise is None or not (nats := fits.likelier(noise.smoothed(share, runs))) > 0.0:
        return None
    alike = noise.floor.max() < _ALIKE * noise.floor.min()
    factors = [np.full(nu, factor) for factor in (4.0, 4.0, 4.0, 2.0, 0.5)]
    factors += [
        np.where(np.arange(nu) == j, factor, 1.0) for j in range(nu) for factor in (4.0, 0.25) if not alike
    ]
    for factor in factors:
        if (noise.variances(share * factor) == noise.variances(share)).all():
            continue  # all that the spectra allow, already
        if (more := fits.likelier(noise.smoothed(share * factor, runs))) > nats:
            share, nats = share * factor, more
    before = fits.likelier(noise.filtered(share, runs))
    read = partial(noise.filtered if before > nats else noise.smoothed, share)
    nats = max(before, nats)
    if not nats > NATS or _of_an_effect(fits, runs, nats, nu):
        return None
    return _Reading(nats, read, _white_noise_found(system, np.sqrt(noise.variances(share)), nats))


@dataclass(frozen=True)
class _WhiteNoise:
    """White noise of inputs, as far as their own past and spectra allow it."""

    power: Array  # spectra of the inputs (nu, F)
    floor: Array  # variances that they fall to (nu,), which noise may have at most
    weights: list[Array]  # of the rows before (order,), the last first, by which each input is predicted best
    errors: Array  # variances of what is not predicted (nu,)

    def variances(self, share: Array) -> Array:
        """Variances (nu,) at shares (nu,) of the largest: sensors of one kind are as noisy as each other."""
        return np.minimum(share * self.floor.max(), self.floor)

    def smoothed(self, share: Array, runs: Sequence[Run]) -> list[Run]:
        """Runs whose inputs are what is to be expected of them, given the whole log."""
        kernels = []
        for power, noise in zip(self.power, self.variances(share), strict=True):
            level = np.clip(1.0 - 2.0 * noise / power, 0.0, 1.0)
            level[:_SLOW] = 1.0  # the spectrum lacks the mean and what is nearly one
            kernels.append(fftshift(irfft(level)) * get_window("hann", 2 * len(level) - 2))

        def through(u: Array, j: int) -> Array:
            reach = len(kernels[j]) // 2
            longer = np.pad(u, (reach - 1, reach), mode="reflect", reflect_type="odd")
            return np.asarray(fftconvolve(longer, kernels[j], mode="valid"))

        return changed(runs, range(len(kernels)), through)

    def filtered(self, share: Array, runs: Sequence[Run]) -> list[Run]:
        """Runs whose inputs are what is to be expected of them, given the log up to each row."""
        part = np.minimum(self.variances(share) / self.errors, 1.0)

        def through(u: Array, j: int) -> Array:
            out, kernel = u.copy(), np.concatenate([[1.0], -self.weights[j]])
            if len(u) >= len(kernel):
                out[_ORDER:] -= part[j] * np.convolve(u - u.mean(), kernel, mode="valid")
            return out

        return changed(runs, range(len(self.weights)), through)


def _white_noise(runs: Sequence[Run], nu: int) -> _WhiteNoise | None:
    """How large white noise of the inputs may be; None where it is next to nothing, or stretches are short."""
    parts = [
        run.u[a:b, :nu] - run.u[a:b, :nu].mean(0)
        for run in runs
        for a, b in run.segments
        if b - a > 5 * _ORDER
    ]
    if not parts:
        return None
    rows = min(_WINDOW, max(map(len, parts)) // 3)
    long = [u for u in parts if len(u) >= rows]
    f = np.fft.rfftfreq(rows)
    power: Array = np.average(
        [welch(u, nperseg=rows, axis=0)[1].T for u in long], axis=0, weights=[len(u) for u in long]
    )
    moved = np.concatenate(parts).var(0)
    floor = np.minimum(0.5 * np.median(power[:, f > _TOP], axis=1), _MOST_OF_IT * moved)
    if not (moved > 0.0).all() or (floor < _NOTHING * moved).all():
        return None
    weights, errors = [], []
    for j in range(nu):
        past = np.concatenate([sliding_window_view(u[:, j], _ORDER + 1)[:, ::-1] for u in parts])
        weights.append(np.linalg.lstsq(past[:, 1:], past[:, 0], rcond=1e-10)[0])
        errors.append(float(np.mean((past[:, 0] - past[:, 1:] @ weights[-1]) ** 2)))
    # a spectrum of few windows is above that of the noise in every other bin by chance: what stands out is a wave
    around = median_filter(power, (1, _AROUND))
    power = np.maximum(np.where(power > _WAVE * around, power, around), 1e-300)
    return _WhiteNoise(power, np.asarray(floor), weights, np.maximum(np.array(errors), 1e-300))


def _of_an_effect(fits: _Fits, runs: Sequence[Run], nats: float, nu: int) -> bool:
    """Whether what nobody declared of the actuators explains as much as noise of the inputs does, or nearly.

    Lags and delays take from commands what is fast, as a filter does, play and a dead band what is small, a limit what
    is large: a saturation of a cart brought 17 nats as noise.
    """
    every = np.concatenate([run.u[a:b, :nu] for run in runs for a, b in run.segments])
    size, none = every.std(0), np.zeros(nu)
    others: list[Callable[[Sequence[Run]], list[Run]]] = [
        *(partial(lagged, nu=nu, rows=rows) for rows in _LAGS),
        *(partial(later, columns=range(nu), rows=-rows) for rows in _DELAYS),
        *(partial(with_play, gap=part * size) for part in _GAPS),
        *(partial(limited, dead=part * size, most=np.full(nu, np.inf)) for part in _DEAD),
        *(partial(limited, dead=none, most=np.quantile(np.abs(every), share, axis=0)) for share in _WITHIN),
    ]
    return any(fits.likelier(other(runs)) > nats - NATS for other in others)


def held_over_rows(runs: Sequence[Run], nu: int) -> bool:
    """Whether each of the first `nu` inputs keeps its value in most rows, as commands do that change now and then."""
    return all(_held(runs, j) for j in range(nu))


def _held(runs: Sequence[Run], column: int) -> bool:
    parts = [run.u[a:b, column] for run in runs for a, b in run.segments]
    return bool(np.mean(np.concatenate([np.diff(u) for u in parts]) == 0.0) > _HELD)


def later(runs: Sequence[Run], columns: Sequence[int], rows: float) -> list[Run]:
    """Runs, some of whose inputs are those of so many rows later, straight between rows, in each stretch."""

    def through(u: Array, _: int) -> Array:
        return np.asarray(np.interp(np.arange(len(u)) + rows, np.arange(len(u)), u))

    return changed(runs, columns, through)


def lagged(runs: Sequence[Run], nu: int, rows: float) -> list[Run]:
    """Runs whose first `nu` inputs went through a lag of first order, of so many rows, in each stretch."""
    kept = math.exp(-1.0 / rows)
    return changed(runs, range(nu), lambda u, _: lfilter([1.0 - kept], [1.0, -kept], u, zi=[kept * u[0]])[0])


def limited(runs: Sequence[Run], dead: Array, most: Array) -> list[Run]:
    """Runs whose inputs do nothing up to a size (nu,), and no more beyond another (nu,), in their units."""

    def through(u: Array, j: int) -> Array:
        return np.asarray(np.sign(u) * np.clip(np.abs(u) - dead[j], 0.0, most[j] - dead[j]))

    return changed(runs, range(len(dead)), through)


def with_play(runs: Sequence[Run], gap: Array) -> list[Run]:
    """Runs whose inputs went through play, of gaps (nu,) in their units."""
    from nsde_torch.effects.recursions import play  # compiled: few logs need it

    def through(u: Array, j: int) -> Array:
        return np.asarray(play(np.ascontiguousarray(u)[:, None], 0.5 * float(gap[j]))[:, 0])

    return changed(runs, range(len(gap)), through)


def changed(runs: Sequence[Run], columns: Sequence[int], through: Callable[[Array, int], Array]) -> list[Run]:
    """Runs, some of whose inputs went through a function of their values in a stretch (n,) and their number."""
    out = []
    for run in runs:
        u = np.array(run.u)
        for a, b in run.segments:
            for j in columns:
                u[a:b, j] = through(run.u[a:b, j], j)
        out.append(replace(run, u=u))
    return out


def around_levels(runs: Sequence[Run], column: int) -> NoisyInput | None:
    """An input that is mostly near a few levels, and noisy; None for another.

    A fifth of the rows at least follow one of the same level, so that their changes are those of the noise. Levels are
    where most values are within a few standard deviations of it, one after another.
    """
    parts = [np.asarray(run.u[a:b, column]) for run in runs for a, b in run.segments]
    changes = np.abs(np.concatenate([np.diff(u) for u in parts]))
    std = float(np.quantile(changes, _SAME)) / (ndtri(0.5 + 0.5 * _SAME) * 2.0**0.5)
    values = left = np.sort(np.concatenate(parts))
    levels: list[float] = []
    squares = tight = 0.0
    while std > 0 and len(levels) < _MOST_LEVELS and len(left):
        until = np.searchsorted(left, left + 2.0 * _NEAR * std)
        first = int(np.argmax(until - np.arange(len(left))))
        near = np.abs(left - np.median(left[first : until[first]])) < _NEAR * std
        if near.sum() < _FEW * len(values):
            break
        levels.append(float(left[near].mean()))
        off = np.abs(left[near] - levels[-1])
        tight += (off < 2.0 * std).sum()
        squares += np.square(off).sum()
        left = left[~near]
    count = len(values) - len(left)
    if len(levels) < 2 or len(left) > _BETWEEN * len(values) or tight < _TIGHT * count:
        return None
    return NoisyInput(column, np.sort(levels), float(np.sqrt(squares / count)))


def _noise_found(one: NoisyInput, system: System, nats: float) -> Finding:
    name, unit = system.input_names[one.column], system.input_units[one.column]
    digits = max(0, 1 - int(np.floor(np.log10(one.std))))
    levels = ", ".join(f"{round(level, digits) + 0.0:g}" for level in one.levels.tolist())
    told = {"name": name, "std": one.std, "unit": unit, "levels": levels, "nats": nats}
    text = rendered(__file__, "recording.txt", what="levels", **told)
    values = {"input": name, "levels": one.levels.tolist(), "noise": one.std, "nats": nats}
    return Finding("input_noise", "", 1, text, "taken out", values)


def _white_noise_found(system: System, std: Array, nats: float) -> Finding:
    names = system.input_names
    pairs = zip(std.tolist(), system.input_units, strict=True)
    sizes = {f"{value:.2g} {unit}".removesuffix(" 1") for value, unit in pairs}
    size = " to ".join(sorted(sizes)[:: max(1, len(sizes) - 1)])
    text = rendered(__file__, "recording.txt", what="white", names=names, size=size, nats=nats)
    values = {"inputs": list(names), "noise": std.tolist(), "nats": nats}
    return Finding("input_noise", "", 1, text, "taken out", values)


def _between_rows_found(names: Sequence[str], nats: float) -> Finding:
    text = rendered(__file__, "recording.txt", what="between_rows", names=names, nats=nats)
    return Finding("input_between_rows", "", 1, text, "averaged", {"inputs": list(names), "nats": nats})
