"""Residual of every channel as a rate: before, after, and the floor that sensors and gusts leave.

Over a step the residual is r_k = w_k + e_{k+1} - e_k: what pushes (w) and what the sensor adds (e). At high frequency
both are white, and the spectrum

    S(f) = s_w^2 + 4 sin^2(pi f h) s_e^2

gives their sizes, by non-negative least squares over the upper three quarters of the band, each frequency weighed by
its own size. The floor is what these two leave of a mean rate over a test function (`sysid.explained`).
"""

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.signal import welch

from nsde_torch.sysid.explained import bump, per_second, smooth_rate
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]

_FROM = 0.25  # of half the sampling rate
_PART = 256  # steps of a periodogram


@dataclass(frozen=True)
class ChannelResidual:
    """Residual of one channel, rms of mean rates over the test function."""

    name: str  # of the channel
    unit: str  # of its rate
    measured: float  # standard deviation of the measured rate
    before: float
    after: float  # before, after: without and with the effects
    floor: float  # what white noise of sensors and pushes leaves

    @property
    def explained(self) -> float:
        """Share of the residual above the floor, in variance, that the effects explain."""
        above = self.before**2 - self.floor**2
        return float(np.clip((self.before**2 - self.after**2) / above, 0.0, 1.0)) if above > 0 else 0.0

    def as_dict(self) -> dict[str, str | float]:
        """Plain containers, for JSON."""
        out = asdict(self) | {"explained": self.explained}
        del out["name"]
        return out


def channel_residuals(before: Regression, after: Regression) -> list[ChannelResidual]:
    """Residuals of every dynamic channel without and with effects."""
    window = bump(before.physics.steps.dt)
    steps = before.physics.steps
    out = []
    for channel in before.rows:
        measured, first, second = (
            smooth_rate(values[:, [channel]], steps.segments, window, steps.dt)
            for values in (
                before.physics.measured,
                before.physics.residual(before.theta),
                after.physics.residual(after.theta),
            )
        )
        unit = before.physics.units[channel]
        out.append(
            ChannelResidual(
                name=before.physics.names[channel],
                unit=per_second(unit),
                measured=float(measured.std()) if len(measured) else 0.0,
                before=_rms(first),
                after=_rms(second),
                floor=min(_floor(after, int(channel), window), _rms(second)),
            )
        )
    return out


def spectrum(regression: Regression, channel: int) -> tuple[Array, Array]:
    """Frequencies [Hz] (M,) and mean power per step (M,) of a channel's residual."""
    residual = regression.physics.residual(regression.theta)[:, channel]
    steps = regression.physics.steps
    longest = max(b - a for a, b in steps.segments)
    part = min(_PART, longest)
    total: Array = np.zeros(part // 2 + 1)
    weight = 0
    for a, b in steps.segments:
        if b - a >= part:
            _, power = welch(residual[a:b], nperseg=part, detrend=False, return_onesided=False)
            total += (b - a) * power[: part // 2 + 1]
            weight += b - a
    frequency: Array = np.arange(part // 2 + 1) / (part * steps.dt)
    return frequency, total / max(weight, 1)


def white_parts(regression: Regression, channel: int) -> tuple[float, float]:
    """Variances per step of what pushes and of the sensor, from the upper half of the band."""
    frequency, power = spectrum(regression, channel)
    high = frequency >= _FROM * frequency[-1]
    curve = 4.0 * np.sin(np.pi * frequency * regression.physics.steps.dt) ** 2
    level = np.maximum(power[high], 1e-300)
    columns = np.stack((1.0 / level, curve[high] / level), 1)
    size = columns.max(0)
    found, _ = nnls(columns / size, np.ones(int(high.sum())))
    return float(found[0] / size[0]), float(found[1] / size[1])


def _floor(regression: Regression, channel: int, window: Array) -> float:
    push, sensor = white_parts(regression, channel)
    dt = regression.physics.steps.dt
    bend = np.square(np.diff(window, prepend=0.0, append=0.0)).sum()
    return float(np.sqrt(push * np.square(window).sum() + sensor * bend) / dt)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean())) if values.size else 0.0
