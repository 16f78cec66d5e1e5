"""Biases of rates whose integral is logged too: p(t + T) - p(t) - integral of v dt = -b T on average."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from nsde_torch.data.quaternion import increments
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns

Array = NDArray[np.float64]

_INTERVAL_S = 0.5
_FEWEST = 12
_LEAST_SHARE = 0.02  # of the rate's own rms: a bias below that is of no consequence


@dataclass(frozen=True)
class Bias:
    """What a rate reads too much, with its standard error, degrees of freedom and chance; and what would matter."""

    value: float
    error: float
    degrees: int
    p: float
    least: float


def rate_biases(system: SystemInfo, runs: Sequence[Run], clock: float) -> dict[str, Bias]:
    """Biases of the rates whose integral is logged too, by name of the state."""
    parts: dict[str, list[tuple[Array, Array]]] = {}
    for run in runs:
        for a, b in run.segments:
            x = run.x[a:b]
            for name, change, rate in _pairs(system, x):
                step = run.dt * clock
                gap = change - 0.5 * step * (rate[1:] + rate[:-1])
                length = max(2, round(_INTERVAL_S / step))
                count = len(gap) // length
                if count:
                    means = gap[: count * length].reshape(count, length).sum(1) / (length * step)
                    parts.setdefault(name, []).append((means, rate))
    out = {}
    for name, pieces in parts.items():
        means = np.concatenate([m for m, _ in pieces])
        if len(means) < _FEWEST:
            continue
        size = float(np.sqrt(np.mean(np.concatenate([np.square(r) for _, r in pieces]))))
        # the error of a mean of telescoping sums is below that of independent ones: this one is safe
        error = max(float(means.std(ddof=1)) / len(means) ** 0.5, 1e-12)
        value = -float(means.mean())
        p = 2.0 * float(stdtr(len(means) - 1, -abs(value) / error))
        out[name] = Bias(value, error, len(means) - 1, p, _LEAST_SHARE * size)
    return out


def _pairs(system: SystemInfo, x: Array) -> list[tuple[str, Array, Array]]:
    """Rates, and what their integrals changed by over each step."""
    out = []
    for i, j in derivative_columns(system).values():
        out += [(system.state_names[b], np.diff(x[:, a]), x[:, b]) for a, b in zip(i, j, strict=True)]
    rates = rate_columns(system)
    if rates is not None and system.quaternion is not None:
        turns = increments(x[:, system.quaternion])
        out += [
            (system.state_names[c], turns[:, k], x[:, c])
            for k, c in enumerate(range(len(system.state_names))[rates])
        ]
    return out
