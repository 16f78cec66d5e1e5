"""Sensors that do not show what the inputs do above some frequency.

States that were smoothed hard before they were logged hold little of their sensor's noise, so that their spectrum is
that of a motion that is slow (`smoothed_states` finds nothing in it). But inputs moved them, and the log says how:

    y(f) = g T(f) r(f) + n(f),      r: what the declared physics says that the inputs change, y: what changed beside it

Where y does not hold what the declared physics says of the inputs, something is between both: a smoother without delay
(T = S), a lag or a delay of actuators (T = e^(-2 pi i f d) / (1 + 2 pi i f l)^n), or noise of the inputs' own sensor.
A lag turns the phase before it removes much, so the likelihoods of both, with a spectrum of n that is free in each bin,

    L(T) = - K sum_f log (|y|^2 - 2 Re conj(g T) conj(r) y + g^2 |T|^2 |r|^2),

tell them apart. Neither a smoother nor noise of the inputs leaves anything to learn above, and nothing is read there:
the gain of a spring whose measured force holds noise of a fifth of its size is 0.88 +- 0.01 otherwise, sure and wrong,
and the thrust of racing flights with smoothed positions (NeuroBEM) has an error of 1.4 N in place of 0.9 N.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import csd

from nsde_torch.arrays import Array, Mask
from nsde_torch.data import Run
from nsde_torch.inference.steps import Steps
from nsde_torch.recording.smoothers import FAMILIES, Smoother
from nsde_torch.sysid.rough import beginnings, rough_fit
from nsde_torch.systems import System

Complex = NDArray[np.complex128]

NATS = 20.0  # by which the declared physics must be likelier behind a smoother than behind lags alone
MISSING = 0.3  # share of what the inputs do that a log may surely show at most, above
NOISE = 3.0
"""Power of all that is seen above, over that of what inputs do there. In a closed loop inputs answer the noise of
sensors, and how much is seen of them says nothing; but then that noise is most of what is seen (24 times, carts under
an LQR). Noise of inputs that is less than a third of all noise hardly bends a gain."""
_PART_S, _WINDOW_S = 60.0, 4.0  # of the log that is looked at, and of a window [s]
_SHORTEST, _FEWEST = 128, 4  # rows of a window, and windows
_BETA = 20.0  # of Kaiser's window: behind a steep smoother a spectrum spans ten decades
_KEPT = slice(6, -2)  # bins; the first are within the main lobe of what is constant
_EFFECTIVE = 0.6  # independent windows for each half-overlapping one
_FELT = 1e-3  # of what a channel does, which inputs must do of it
_LAGS_S, _LATEST_S = (0.0, 0.01, 0.02, 0.04, 0.07, 0.12), 0.05
"""Lags of actuators, of first order and of second order if at most half of the longest, and the longest delay [s]."""
_ORDERS, _SIZES = (1, 2, 4), 16  # of Butterworth's filters forwards and backwards, and how many cut-offs
_HIGHEST = 0.2  # of the rate of the log, at which a smoother ends that is looked for
_GAIN_STEPS = 4


@dataclass(frozen=True)
class CrossSpectra:
    """Spectra of what inputs do to one channel and of what it does beside all else, over frequencies (F,)."""

    f: Array  # [Hz]
    both: Complex  # conj(r) y
    inputs: Array  # |r|^2
    seen: Array  # |y|^2
    windows: float  # number of independent windows

    def left(self, transfer: Complex) -> tuple[Array, Array]:
        """What transfer functions (M, F) leave of the spectrum (M, F), and the gains (M,) that leave least of it."""
        weights, along = 1.0 / self.seen, (np.conj(transfer) * self.both).real
        squares = np.square(np.abs(transfer)) * self.inputs
        left = gain = np.empty(0)
        for _ in range(_GAIN_STEPS):
            gain = np.maximum((weights * along).sum(1) / np.maximum((weights * squares).sum(1), 1e-300), 0.0)
            g = gain[:, None]
            left = np.maximum(self.seen - 2.0 * g * along + g**2 * squares, 1e-12 * self.seen)
            weights = 1.0 / left
        return left, gain

    def shown(self, transfer: Complex, gain: float, band: Mask) -> tuple[float, float]:
        """What is seen of inputs behind a transfer function (F,) in a band.

        The share of their effect, at most (three standard deviations), and the power of all that is seen over theirs.
        """
        moved = gain * transfer[band]
        weights = 1.0 / self.seen[band]
        squares = np.square(np.abs(moved)) * self.inputs[band]
        size = max(float((weights * squares).sum()), 1e-300)
        share = abs(complex((weights * np.conj(moved) * self.both[band]).sum())) / size
        power = float(np.median(self.seen[band] / np.maximum(squares, 1e-300)))
        return share + 3.0 / (self.windows * size) ** 0.5, power


def ends_of_response(
    runs: Sequence[Run], system: System, sensors: Sequence[tuple[int, ...]], clock: float = 1.0
) -> list[Smoother | None]:
    """Of each sensor, by its columns, the smoother behind which it shows what the inputs do; None where it shows all.

    Runs are in the rows in which they were logged.
    """
    some = beginnings(runs, clock, seconds=_PART_S, fewest=_FEWEST * _SHORTEST)
    regression = rough_fit(system, some, clock, levels=False) if system.nu and sensors else None
    if regression is None:
        return [None for _ in sensors]
    physics = regression.physics
    steps, measured = physics.steps, physics.residual(regression.theta)
    means = torch.cat([steps.u[a:b].mean(0).expand(b - a, -1) for a, b in steps.segments])
    beside = physics.with_inputs(means).residual(regression.theta)
    out: list[Smoother | None] = []
    for columns in sensors:
        driven = [c for c in columns if c in regression.rows]
        parts = [
            [(beside[a:b, c] - measured[a:b, c], beside[a:b, c]) for a, b in steps.segments]
            for c in driven
            if (beside[:, c] - measured[:, c]).std() > _FELT * beside[:, c].std()
        ]
        spectra = [found for part in parts if (found := _cross_spectra(part, steps)) is not None]
        out.append(_end(spectra, steps) if spectra else None)
    return out


def _cross_spectra(parts: Sequence[tuple[Array, Array]], steps: Steps) -> CrossSpectra | None:
    dt, longest = steps.dt, max(len(y) for _, y in parts)
    if longest < _SHORTEST:
        return None
    rows = min(2 ** int(np.ceil(np.log2(_WINDOW_S * steps.pace / dt))), 2 ** int(np.log2(longest // 3)))
    rows = max(rows, _SHORTEST)
    f, total, count = np.empty(0), np.zeros((3, rows // 2 + 1), dtype=np.complex128), 0
    for r, y in parts:
        if (windows := (len(y) - rows) // (rows // 2) + 1) < 1:
            continue
        for k, (one, other) in enumerate(((r, y), (r, r), (y, y))):
            f, power = csd(one, other, 1.0 / dt, ("kaiser", _BETA), rows, detrend="linear")
            total[k] += windows * power
        count += windows
    if count < _FEWEST:
        return None
    both, inputs, seen = total[:, _KEPT] / count
    return CrossSpectra(f[_KEPT], both, inputs.real, np.maximum(seen.real, 1e-300), _EFFECTIVE * count)


def _end(channels: Sequence[CrossSpectra], steps: Steps) -> Smoother | None:
    f, dt, pace = channels[0].f, steps.dt, steps.pace
    every = [(n, lag) for n, lag in product((1, 2), _LAGS_S) if n == 1 or 0 < n * lag <= _LAGS_S[-1]]
    lags = [(n, pace * lag) for n, lag in every]
    delays = np.arange(0.0, pace * (_LATEST_S + 1e-9), max(0.5 * dt, 0.005 * pace))
    turn = 2j * np.pi * f
    actuators = np.array(
        [_delayed(turn, delay, dt) / (1.0 + turn * lag) ** n for (n, lag), delay in product(lags, delays)]
    )

    def likelihoods(transfer: Complex) -> Array:
        return np.asarray(sum(-c.windows * np.log(c.left(transfer)[0]).sum(1) for c in channels))

    without = likelihoods(actuators)
    sizes = np.geomspace(1.0 / (120.0 * dt), _HIGHEST / dt, _SIZES).tolist()
    smoothers = [Smoother(FAMILIES[0], order, size, dt) for order, size in product(_ORDERS, sizes)]
    behind = [likelihoods(actuators * smoother.response(f)) for smoother in smoothers]
    best = int(np.argmax([values.max() for values in behind]))
    if behind[best].max() - without.max() < NATS:
        return None
    actuator, lost = actuators[[int(behind[best].argmax())]], np.abs(smoothers[best].response(f)) < 0.5
    whole = actuator * smoothers[best].response(f)
    shown = [c.shown(actuator[0], float(c.left(whole)[1][0]), lost) for c in channels]
    missing = all(share < MISSING and power < NOISE for share, power in shown)
    return smoothers[best] if missing and lost.any() else None


def _delayed(turn: NDArray[Any], delay: float, dt: float) -> Complex:
    """A delay [s] of an input that is held over steps: of parts of a step, two inputs act within one."""
    whole, part = divmod(delay / dt, 1.0)
    return np.asarray((1.0 - part) * np.exp(-turn * whole * dt) + part * np.exp(-turn * (whole + 1.0) * dt))
