"""Runs as steps: both ends of every interval between samples, with the input held over it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.data.denoise import denoised
from nsde_torch.errors import DataError
from nsde_torch.systems import System

Array = NDArray[np.float64]

MOST = 300_000
"""Steps that are looked at; of longer data, stretches spread evenly."""
_STRETCH = 5_000


@dataclass(frozen=True)
class Steps:
    """Steps of some runs, segment after segment (float64).

    Args:
        t: Logged time of the start of each step (N,) [s].
        x0, x1: States at both ends (N, nx).
        u: Inputs and exogenous channels held over the step (N, nu + n).
        logged_dt: Length of a step [s] on the clock of the log.
        dt: The same in physical seconds.
        segments: Ranges (first, last + 1) of steps without a gap.
        runs: Number of the run of each segment.
    """

    t: Tensor
    x0: Tensor
    x1: Tensor
    u: Tensor
    logged_dt: float
    dt: float
    segments: tuple[tuple[int, int], ...]
    runs: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.t)

    @property
    def starts(self) -> Tensor:
        """Row at which the segment of each step starts (N,)."""
        out = torch.empty(len(self), dtype=torch.long)
        for a, b in self.segments:
            out[a:b] = a
        return out


def steps_of(system: System, runs: Sequence[Run], *, clock: float, smooth: bool, shortest: int = 1) -> Steps:
    """Cut runs into steps.

    Args:
        system: The machine.
        runs: Its runs, all on one step.
        clock: Physical seconds per logged second.
        smooth: Whether white sensor noise is taken out of the states.
        shortest: Segments of fewer steps are left out.

    Raises:
        DataError: no run, or no segment that is long enough.
    """
    if not runs:
        raise DataError("no run to identify the physics from.")
    states = denoised(runs)[0] if smooth else [np.asarray(run.x) for run in runs]
    parts: dict[str, list[Array]] = {key: [] for key in ("t", "x0", "x1", "u")}
    segments, owners, at = [], [], 0
    for number, a, b in _stretches(runs):
        if b - 1 - a < shortest:
            continue
        run, x = runs[number], states[number]
        parts["t"].append(run.t[a : b - 1])
        parts["x0"].append(x[a : b - 1])
        parts["x1"].append(x[a + 1 : b])
        parts["u"].append(run.u[a : b - 1])
        segments.append((at, at + b - 1 - a))
        owners.append(number)
        at += b - 1 - a
    if not segments:
        raise DataError(f"no stretch of {shortest} steps without a gap; identify from longer runs.")
    joined = {key: torch.from_numpy(np.concatenate(rows)) for key, rows in parts.items()}
    joined |= {key: system.project(joined[key]) for key in ("x0", "x1")}
    dt = runs[0].dt
    return Steps(**joined, logged_dt=dt, dt=dt * clock, segments=tuple(segments), runs=tuple(owners))


def _stretches(runs: Sequence[Run]) -> Iterator[tuple[int, int, int]]:
    """Run and rows of every stretch to look at: the segments, or of very long data some parts of them."""
    whole = [(number, a, b) for number, run in enumerate(runs) for a, b in run.segments]
    total = sum(b - a for _, a, b in whole)
    if total <= MOST:
        yield from whole
        return
    cut = [(n, c, min(c + _STRETCH, b)) for n, a, b in whole for c in range(a, b, _STRETCH)]
    cut = [(n, a, b) for n, a, b in cut if b - a >= 2]
    for i in np.linspace(0, len(cut) - 1, max(1, MOST // _STRETCH)).round().astype(int):
        yield cut[i]
