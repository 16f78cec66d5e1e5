"""Declared physics by plain least squares on means over 0.15 s, or five rows: slow, robust, no model of the noise.

    sum over a box of (x_{k+1} - x_k) = sum over it of int f(x, u; theta) dt + noise

Both sides of the equation go through the same filter, the mean over a box, which ends near 3 Hz: what a smoother took
away above does not count, and no noise model can learn the physics. It errs in its own way: noise of the states, and
feedback that answers what the physics lacks, pull it towards gains that are too small.
"""

import copy
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from math import log
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.inference.steps import steps_of
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.texts import rendered

MEANS_S = 0.15  # length of the boxes [s]
# or rows: of the changes from row to row of a heat exchanger that is logged every second most is noise, and its
# physics seemed to explain nothing
_FEWEST = 5
ITERATIONS = 10


def rough_fit(
    system: System,
    runs: Sequence[Run],
    clock: float = 1.0,
    *,
    iterations: int = ITERATIONS,
    levels: bool = True,
    start: Array | None = None,
) -> Regression | None:
    """The declared physics fitted to means over `MEANS_S`, or five rows; None where that cannot be done.

    Starts from theta (k,), or the system's values. With `levels`, steady pushes are left out: the mean of each channel
    over each run.
    """
    box = max(_FEWEST, round(MEANS_S * runs[0].pace / (runs[0].dt * clock)))
    vector = ParameterVector(copy.deepcopy(system))
    try:
        steps = steps_of(vector.system, runs, clock=clock, shortest=box, differences=0)
        physics = Physics(vector, steps, foresee=False)
        regression = Regression(physics, box=box, plain=True, levels=levels, start=start)
        regression.run(iterations)
    except (ConfigError, DataError, NonFiniteError):
        return None
    return regression


@dataclass(frozen=True)
class Objection:
    """What speaks against a fit, or for a fault of the log that it is of."""

    kind: str
    """`reading`, `shifted_stream`, `odd_run`, `unexplained_run`, `least_squares`, `first_values`, `gone` or `poor`."""
    sentence: str
    remedy: str
    channels: tuple[str, ...] = ()  # those that it speaks of; empty: all
    share: float = 0.0  # of another reading: sum over channels of log(left / measured) in that

    def __str__(self) -> str:
        return f"{self.sentence}; {self.remedy}"

    def as_dict(self) -> dict[str, Any]:
        out = {**asdict(self), "channels": list(self.channels)}
        del out["share"]
        return out


def objection(kind: str, *, of: tuple[str, ...] = (), **values: Any) -> Objection:
    """An objection of a kind in the words of `templates/objections.txt`, of some channels; of all if none are named."""
    sentence, remedy = rendered(__file__, "objections.txt", kind=kind, **values).splitlines()
    return Objection(kind, sentence, remedy, of)


@dataclass(frozen=True)
class Left:
    """What is left of one channel in means over `MEANS_S`, without the mean over each run."""

    name: str
    unit: str
    measured: float  # standard deviation of the measured rate
    left: float  # root mean square of its residual
    predicted: float  # root mean square of its prediction by the physics
    noise: float
    """Root mean square of what the noise of the sensor leaves: of one box it is in the next one with the other sign."""

    @property
    def share(self) -> float:
        """log(left / measured), without unit."""
        return log_share(self.left, self.measured)


def log_share(left: float, measured: float) -> float:
    """log(left / measured) of root mean squares, of nothing too."""
    return log(max(left, 1e-12) / max(measured, 1e-12))


def left_at(rough: Regression, theta: Array, *, damped: bool = False) -> list[Left]:
    """What the physics leaves at some parameters by the end of each box, channel by channel.

    With `damped`, without what goes with a channel's own state, as a damping would that nobody declared.
    """
    physics = rough.physics
    states = physics.turn(physics.steps.seen0, physics.attitude).numpy()
    residual, measured, own = (
        rough.single.summed(values, rough.box) / rough.dt
        for values in (physics.residual(theta) * _to_the_end(rough, theta), physics.measured, states)
    )
    for values, run in product((residual, measured, own), np.unique(rough.owners)):
        values[rough.owners == run] -= values[rough.owners == run].mean(0)
    if damped:
        share = (residual * own).sum(0) / np.square(own).sum(0).clip(1e-300)
        residual = residual - share * own
    out, same = [], rough.owners[1:] == rough.owners[:-1]
    for c in rough.rows:
        each = (measured[:, c], residual[:, c], measured[:, c] - residual[:, c])
        size, left, predicted = (float(np.sqrt(np.square(values).mean())) for values in each)
        beside = residual[1:, c][same] * residual[:-1, c][same]
        noise = float(np.sqrt(max(-2.0 * beside.sum() / max(len(residual), 1), 0.0)))
        out.append(Left(physics.names[c], physics.units[c], size, left, predicted, noise))
    return out


def _to_the_end(rough: Regression, theta: Array) -> Array:
    """What is left by the end of its box of what a step is off by (N, channels), by the state's own mean damping.

    Of a pressure that settles within a row nothing is left but the last row's; the sum, 15 errors of a level for a
    change between two, was more than had been measured, and physics without gains looked better: a cylinder's valve
    was to change its sign (tests/sysid/test_guard.py).
    """
    left = rough.physics.left_after_a_step(theta)
    rows = np.concatenate([np.arange(b - a) % rough.box for a, b in rough.single.edges])
    return np.power(left, (rough.box - 1 - rows)[:, None])


def share_left(rough: Regression) -> float:
    """Sum over channels of log(left / measured) at the optimum, without unit: how much the physics leaves."""
    return sum(c.share for c in left_at(rough, rough.theta))


def beginnings(runs: Sequence[Run], clock: float, *, seconds: float, fewest: int) -> list[Run]:
    """Runs of which the beginning of the longest stretch is left, for fits that are compared with each other.

    All together they last so many `seconds` at the usual pace, each of at least the `fewest` rows.
    """
    out = []
    for run in runs:
        a, b = max(run.segments, key=lambda s: s[1] - s[0])
        rows = max(fewest, round(seconds * run.pace / len(runs) / (run.dt * clock)))
        out.append(replace(run, segments=((a, min(b, a + rows)),)))
    return out
