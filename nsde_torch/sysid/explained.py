"""How much of each measured rate the physics explains, in means over test functions.

    mean rate = sum_k phi_k (x_{k+1} - x_k) / (h sum_k phi_k),        phi a smooth bump (Hann)

Over single steps sensor noise hides everything; over a quarter of a second it mostly does not.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.result import Channel

Array = NDArray[np.float64]

BUMP_S, FEWEST = 0.25, 8


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
