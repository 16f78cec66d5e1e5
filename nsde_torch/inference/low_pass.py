"""Logs whose states were smoothed before they were logged, and restored up to a frequency f_r (`Run.low_pass`).

    x_L = P x,    P a low pass at f_r:      x_L(k+1) - x_L(k) = P [step(x, u) - x](k)

What lies above f_r is removed from the states, and not from the inputs. So what a step does, and what parameters do to
a step, goes through P as well (it commutes with differences in time; of the state itself what lies above f_r is small
beside what the inputs do). And x_L is no new measurement in each row: it is one in every 1 / (f_r dt) rows. Taken at
f_r and not at twice that, what moves between half of f_r and f_r is folded back, which makes the increments of x_L
nearly white, as they are of a state itself.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.systems import System

_INSIDE = 0.85  # of the band that was restored: its end gives way to noise
_FADES = 0.15  # of the frequency of a low pass, over which it fades
_AROUND = 20.0  # periods of that frequency by which a stretch is prolonged


def band_of(runs: Sequence[Run]) -> dict[str, float]:
    """Frequencies up to which states hold what was measured [Hz], of those with louder noise above."""
    names = {name for run in runs for name in run.low_pass}
    return {name: _INSIDE * min(run.low_pass[name] for run in runs if name in run.low_pass) for name in names}


def rows_apart(runs: Sequence[Run], band: Mapping[str, float], dt: float) -> dict[str, int]:
    """Rows from one measurement of a state to the next, of states that are not measured anew in each row.

    Args:
        runs: Runs, some states of which have noise that is correlated from row to row (`Run.apart`).
        band: Frequencies up to which states hold what was measured [Hz].
        dt: Step [s].
    """
    out = {name: max(1, round(1.0 / (hz * dt))) for name, hz in band.items()}
    for run in runs:
        out |= {name: max(rows, out.get(name, 1)) for name, rows in run.apart.items()}
    return out


def low_passed_states(system: System, run: Run, clock: float) -> Array:
    """States (n, nx) of a run without what stands above the bands of those that were smoothed."""
    x = torch.from_numpy(np.array(run.x))
    for name, hz in band_of([run]).items():
        j = system.state_names.index(name)
        for a, b in run.unbroken or run.segments:
            x[a:b, j] = low_passed(x[a:b, j : j + 1], hz, run.dt * clock, level=True)[:, 0]
    return np.asarray(system.project(x).numpy())


def low_passed(values: Tensor, hz: float, dt: float, *, level: bool = False) -> Tensor:
    """Values (n, ...) of one stretch below a frequency.

    Args:
        hz: The frequency [Hz].
        dt: Step [s].
        level: Whether they go on beyond the ends as a line through these, as states do; else as they come, mirrored.
    """
    n, some = len(values), max(1, int(1.0 / (hz * dt)))
    around = min(n - 1, int(_AROUND / (hz * dt)))
    before, behind = values[1 : around + 1].flip(0), values[n - 1 - around : n - 1].flip(0)
    line = torch.zeros_like(values[:1])
    if level:
        # about the mean of some rows at each end, so that neither values nor slopes jump there
        before = 2.0 * values[:some].mean(0) - before
        behind = 2.0 * values[-some:].mean(0) - behind
    longer = torch.cat((before, values, behind))
    if level:
        share = torch.linspace(0.0, 1.0, len(longer), dtype=values.dtype).view(-1, *(1,) * (values.dim() - 1))
        line = longer[:some].mean(0) + share * (longer[-some:].mean(0) - longer[:some].mean(0))
        longer = longer - line
    size = next_fast_len(len(longer), real=True)  # a prime takes five times as long
    f = torch.fft.rfftfreq(size, dt, dtype=torch.float64)
    keep = 0.5 * (1.0 + torch.cos(torch.pi * ((f - hz) / (_FADES * hz) + 1.0).clamp(0.0, 1.0)))
    spectrum = torch.fft.rfft(longer, size, dim=0) * keep.to(values.dtype).view(
        -1, *(1,) * (values.dim() - 1)
    )
    out = torch.fft.irfft(spectrum, size, dim=0)[: len(longer)] + line
    return out[around : around + n]
