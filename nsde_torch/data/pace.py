"""How slow a machine is beside drives and vehicles, by whose pace times in seconds are set.

A time typical of a channel is the lag at which it has changed by half of what it changes by in the long run: where its
structure function E (x(t + T) - x(t))^2 reaches its variance. Noise of less than that variance does not move it.

Measured: 0.2 to 1 s of springs, carts, hydraulics, joints and multirotors, 0.02 to 0.08 s of a voice coil, 36 to 340 s
of heated plates, tanks and reactors. Between 0.1 and 0.5 s the pace is 1.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.run import Run

_ORDINARY_S = (0.1, 0.5)
_LAGS = 60  # that are tried, up to a third of a stretch
_KNOWN = 0.2  # share of a stretch up to which it shows a typical time; of a straight line that is 0.29 of any stretch


def at_their_pace(runs: Sequence[Run]) -> list[Run]:
    """The runs, each with the `pace` of all of them.

    A machine is slow where whatever moves is slower than usual, inputs too, and fast where most of its states are.
    """
    fast, slow = _ORDINARY_S
    slowest = min((at_least for name in ("x", "u") for at_least, _ in _typical(runs, name)), default=slow)
    pace = max(1.0, slowest / slow) * min(1.0, typical_time(runs) / fast)
    return [replace(run, pace=pace) for run in runs]


def typical_time(runs: Sequence[Run]) -> float:
    """The median of those of the states [s]; infinite where stretches are too short for one, or none moves."""
    return float(np.median([known for _, known in _typical(runs, "x")] or [np.inf]))


def _typical(runs: Sequence[Run], name: str) -> Iterable[tuple[float, float]]:
    """Least and known typical time of each column that moves and is no white noise [s], the medians over the runs."""
    for j in range(getattr(runs[0], name).shape[1]):
        found = []
        for run in runs:
            a, b = max(run.segments, key=lambda s: s[1] - s[0])
            rows = _rows(
                getattr(run, name)[a:b, j].copy()
            )  # in one piece, of two hours at 100 Hz six times as fast
            if rows > 1:
                found.append((rows * run.dt, rows * run.dt if rows < _KNOWN * (b - a) else np.inf))
        if found:
            at_least, known = np.median(found, 0).tolist()
            yield at_least, known


def _rows(x: Array) -> int:
    """Rows after which a column (n,) has changed by half; 0 where it stands."""
    size = float(x.var())
    if not size > 0:
        return 0
    lags = np.unique(np.geomspace(1, max(2, len(x) // 3), _LAGS).astype(int))
    return next((int(n) for n in lags if np.square(x[n:] - x[:-n]).mean() >= size), int(lags[-1]))
