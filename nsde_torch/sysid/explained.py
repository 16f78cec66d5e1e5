"""How much of each measured rate the physics explains, in means over test functions.

    mean rate = sum_k phi_k (x_{k+1} - x_k) / (h sum_k phi_k),        phi a smooth bump (Hann)

Over single steps sensor noise hides everything; over a quarter of a second it mostly does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.physics import Physics

Array = NDArray[np.float64]

BUMP_S, FEWEST = 0.25, 8


@dataclass(frozen=True)
class Channel:
    """How well one channel is explained, in means over test functions (bumps) of `width_s`."""

    name: str
    unit: str
    measured: float  # standard deviation of the measured rate
    residual: float  # root mean square of what the physics leaves of it
    sensor: float  # what white sensor noise alone leaves
    r2: float  # share of the variance that is explained
    noise: Noise | None  # law of the noise over single steps; None where the method has none

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        out: dict[str, Any] = {
            "unit": self.unit,
            "measured_std": self.measured,
            "residual_rms": self.residual,
            "sensor_rms": self.sensor,
            "r2": self.r2,
        }
        if self.noise is not None:
            out["noise"] = {"carry": self.noise.carry, "order": len(self.noise.reflection)}
        return out


def bump(dt: float) -> Array:
    """The test function over steps of `dt` [s], of sum 1."""
    n = max(FEWEST, round(BUMP_S / dt))
    window = np.hanning(n + 2)[1:-1]
    return np.asarray(window / window.sum())


def smooth_rate(change: Array, segments: Sequence[tuple[int, int]], window: Array, dt: float) -> Array:
    """Mean rates (M, n) of changes over steps (N, n), wherever the test function fits into a segment."""
    parts = [
        np.stack([np.convolve(column, window, "valid") for column in change[a:b].T], 1) / dt
        for a, b in segments
        if b - a >= len(window)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, change.shape[1]))


def explained(physics: Physics, residual: Array, rows: NDArray[np.int64], window: Array) -> list[Channel]:
    """Figures of the channels `rows`, of their residual changes over steps (N, len(rows)), in means over a window."""
    s = physics.steps
    measured = smooth_rate(physics.measured[:, rows], s.segments, window, s.dt)
    left = smooth_rate(residual, s.segments, window, s.dt)
    bend = np.sqrt(np.square(np.diff(window, prepend=0.0, append=0.0)).sum()) / s.dt
    out = []
    for i, channel in enumerate(rows):
        std, rms = (
            (0.0, 0.0) if not len(left) else (measured[:, i].std(), np.sqrt(np.square(left[:, i]).mean()))
        )
        unit = physics.units[channel]
        out.append(
            Channel(
                name=physics.names[channel],
                unit=per_second(unit),
                measured=float(std),
                residual=float(rms),
                sensor=float(bend * physics.sensor_std[channel]),
                r2=float(1.0 - (rms / std) ** 2) if std > 0 else 0.0,
                noise=None,
            )
        )
    return out


def per_second(unit: str) -> str:
    """Unit of a rate of something."""
    return f"{unit}2" if unit.endswith("/s") else f"{unit}/s"
