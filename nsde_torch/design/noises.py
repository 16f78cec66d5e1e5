"""The law of the residuals of steps, split into what acts on the machine and what the sensors add.

    r_k = w_k + s_{k+1} - s_k,      spectrum S(f) = Q + R |1 - exp(-i f)|^2,      so that Q = S(0), Q + 2 R = mean of S

whatever orders the law (`sysid.noise`) has found for it: a long autoregression may stand for the differences
of a sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]
_ROOM = 1e-10
_GRID = np.exp(-1j * np.pi * (np.arange(512) + 0.5) / 512)


@dataclass(frozen=True)
class Noises:
    """Variances of what acts on a step (nx,) and of the sensors (nx,)."""

    pushes: Array
    sensors: Array


def noises_of(fit: Regression) -> Noises:
    """Noise as a regression found it, that of the machine as white as it is over long times."""
    pushes, sensors = np.zeros(fit.vector.system.nx), np.square(fit.physics.sensor_std)
    for law, channel in zip(fit.noises, fit.rows, strict=True):
        lasting, sensor = split(law)
        pushes[channel] = lasting / fit.box
        sensors[channel] = sensor
    return Noises(pushes, np.maximum(sensors, _ROOM))


def split(law: Noise) -> tuple[float, float]:
    """Variances of what acts on a step and of the sensor, from the law of one channel."""
    shape = np.abs(1.0 - law.carry * _GRID) ** 2 / np.abs(np.polyval(law.polynomial[::-1], _GRID)) ** 2
    lasting = law.std**2 * ((1.0 - law.carry) / float(law.polynomial.sum())) ** 2
    whole = law.std**2 * float(shape.mean())
    lasting = min(lasting, whole)
    return lasting, 0.5 * (whole - lasting)
