"""Inputs that hold a few levels, and were logged with noise that does not move the machine.

A force of two levels that a load cell measured is, as a regressor, these levels and noise. A function that flattens it,
a saturation just below the level or a dead band, removes the noise and explains the motion better, surely: a level of
0.55 for a force of 0.6 that nothing cut, with a gain of 1.31 for 1.2. So the noise goes first. Where an input is mostly
near a few levels,

    x' = f(x, l(u)),    l(u): the level that u is near, or u where it is near none,

is fitted beside x' = f(x, u), and l(u) is used where the log is likelier with it by `NATS`: 10 to 2,600 of noise of
springs, pendulums and arms, -403 where a controller moved what is near a level.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from nsde_torch.arrays import Array
from nsde_torch.data import DataSet, Finding, Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.inference import fit
from nsde_torch.sysid.rough import beginnings
from nsde_torch.systems import System

NATS = 5.0  # by which a log must be likelier without noise about levels; where that does nothing: 0 +- 1
_PART_S, _FEWEST = 120.0, 600  # of the log that is looked at [s], and rows of each run at least
_NEAR = 4.0  # standard deviations of the noise, within which an input is at a level
_MOST_LEVELS, _SAME = 8, 0.2  # levels at most, and share of the rows that stay at theirs at least
_FEW, _BETWEEN = 0.03, 0.4  # shares of the rows: at a level, at least, and between levels, at most
_TIGHT = 0.85  # share of those at a level that are within two standard deviations: normal 0.95, of waves 0.5


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


def without_input_noise(data: DataSet, system: System) -> DataSet:
    """A data set without noise about the levels of its inputs that surely does not act.

    Its summary has a finding `input_noise` for each of these inputs.
    """
    around = [one for j in range(system.nu) if (one := around_levels(data.runs, j)) is not None]
    if not around:
        return data
    some = beginnings(data.runs, data.clock_scale, seconds=_PART_S, fewest=_FEWEST)
    runs, findings = list(data.runs), list(data.summary.findings)
    try:
        likely = fit(system, some, clock=data.clock_scale).likelihood
        for one in around:
            other = [one.on_levels(run) for run in some]
            likelier = fit(system, other, clock=data.clock_scale).likelihood
            if likelier - likely > NATS:
                findings.append(_finding(one, system, likelier - likely))
                runs, some, likely = [one.on_levels(run) for run in runs], other, likelier
    except (ConfigError, DataError, NonFiniteError, np.linalg.LinAlgError):
        return data  # whoever fits these data next says why
    return data.changed(runs, findings)


def around_levels(runs: Sequence[Run], column: int) -> NoisyInput | None:
    """An input that is mostly near a few levels, and noisy; None for another.

    A fifth of the rows at least follow one of the same level, so that their changes are those of the noise. Levels are
    where most values are within a few standard deviations of it, one after another.
    """
    parts = [np.asarray(run.u[a:b, column]) for run in runs for a, b in run.segments]
    changes = np.abs(np.concatenate([np.diff(u) for u in parts]))
    std = float(np.quantile(changes, _SAME)) / (norm.ppf(0.5 + 0.5 * _SAME) * 2.0**0.5)
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


def _finding(one: NoisyInput, system: System, nats: float) -> Finding:
    name, unit = system.input_names[one.column], system.input_units[one.column]
    digits = max(0, 1 - int(np.floor(np.log10(one.std))))
    levels = ", ".join(f"{round(level, digits) + 0.0:g}" for level in one.levels.tolist())
    return Finding(
        "input_noise",
        "",
        1,
        f"{name} holds noise of {one.std:.2g} {unit} about the levels {levels} that does not move the machine (the log "
        f"is likelier by {nats:.0f} nats without it); values near a level are read as this level. "
        "`data.state_smoothing=keep` leaves them as they are",
        "taken out",
        {"input": name, "levels": one.levels.tolist(), "noise": one.std, "nats": nats},
    )
