"""The four models of thrust that NanoBench compares: a gain of the sum of squared commands, or a regression.

    m (a + g) = k sum_i u_i^2,     k constant, of the second degree in time, or of the second degree in the voltage
    a + g     = w [u_1 ... u_4, V, 1]

The gain of each row, m (a + g) / sum u^2, is averaged or fitted by a polynomial; the mass is that of the set. Here
both sides hold gravity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nsde_torch.arrays import Array

GRAVITY = 9.81
SAMPLES, DEGREE = 15, 3
"""Of the filter of Savitzky and Golay that differentiates the height twice."""
POLYNOMIAL = 2
SMALLEST = 1e-9


@dataclass(frozen=True)
class VerticalRecord:
    """What the models read of a flight.

    Args:
        t: Times (n,) [s].
        u: Commands (n, 4) in [0, 1].
        voltage: (n,) [V].
        vertical: Vertical acceleration and gravity (n,) [m/s2].
    """

    t: Array
    u: Array
    voltage: Array
    vertical: Array

    @property
    def squares(self) -> Array:
        """Sum of the squared commands (n,)."""
        return np.asarray((self.u**2).sum(1))

    @property
    def gain(self) -> Array:
        """Acceleration per squared command (n,) [m/s2]."""
        return self.vertical / (self.squares + SMALLEST)


ThrustModel = Callable[[VerticalRecord, int], Array]
"""From a flight and the first row of its test to the accelerations of the test rows (m,)."""


def vertical_acceleration(t: Array, height: Array) -> Array:
    """Second derivative of the height, and gravity (n,) [m/s2].

    Args:
        t: Times (n,) [s].
        height: (n,) [m].
    """
    from scipy.signal import savgol_filter

    dt = float(np.median(np.diff(t)))
    return np.asarray(savgol_filter(height, SAMPLES, DEGREE, deriv=2, delta=dt) + GRAVITY)


def constant_gain(record: VerticalRecord, split: int) -> Array:
    """One gain."""
    return float(record.gain[:split].mean()) * record.squares[split:]


def time_indexed(record: VerticalRecord, split: int) -> Array:
    """A gain that is a polynomial of the time."""
    return _polynomial(record, record.t, split)


def linear_regression(record: VerticalRecord, split: int) -> Array:
    """Least squares on commands and voltage."""
    columns = np.column_stack((record.u, record.voltage, np.ones(len(record.t))))
    weights = np.linalg.lstsq(columns[:split], record.vertical[:split], rcond=None)[0]
    return np.asarray(columns[split:] @ weights)


def voltage_conditioned(record: VerticalRecord, split: int) -> Array:
    """A gain that is a polynomial of the voltage."""
    return _polynomial(record, record.voltage, split)


def _polynomial(record: VerticalRecord, of: Array, split: int) -> Array:
    middle = float(of[:split].mean())
    weights = np.polyfit(of[:split] - middle, record.gain[:split], POLYNOMIAL)
    return np.asarray(np.polyval(weights, of[split:] - middle) * record.squares[split:])


THRUST_MODELS: dict[str, ThrustModel] = {
    "constant gain": constant_gain,
    "time-indexed": time_indexed,
    "linear regression": linear_regression,
    "voltage-conditioned": voltage_conditioned,
}
