"""Rows in which a machine with dry friction moves, and those in which it stands.

Where it stands, friction is whatever holds it, and no function of the speed; and where its speed changes sign within a
step, a few values do not show how long it went which way. So rows whose speed, averaged over a few of them, is within
the noise of the speed and what it changes by in a step are left out of the regression, and so is what is too short
between them (docs/content/theory/identification.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from nsde_torch.arrays import Array, Mask
from nsde_torch.data import Run
from nsde_torch.data.raw import holes
from nsde_torch.effects import Effect
from nsde_torch.effects.law import Law
from nsde_torch.systems import System

WITHIN = 3.0  # standard deviations of the noise of a speed, within which its direction is not known
SHARE = 0.02  # share of the rows that must be at a standstill to be left out; fewer turn nothing
_AVERAGED = 5  # rows; their mean at a standstill is within `WITHIN` almost surely
_SHORTEST = 5  # rows between two standstills; fewer say little and cost the start of a stretch


def slowest(
    system: System, sensor_std: Array, runs: Sequence[Run], effects: Sequence[type[Effect]] | None = None
) -> dict[int, float]:
    """Speeds whose direction is not known, of coordinates with dry friction, by column of the state.

    Dry frictions are looked for among the effects, or among those of the machine.
    """
    out: dict[int, float] = {}
    own = [type(e) for e in system.effects if isinstance(e, Effect)]
    for effect in own if effects is None else effects:
        if issubclass(effect, Law) and effect.dry:
            column = effect.at.velocity
            if not any(system.state_names[column] in run.inferred for run in runs):
                out[column] = WITHIN * float(sensor_std[column])
    return out


def moving(runs: Sequence[Run], slowest: Mapping[int, float]) -> tuple[tuple[Run, ...], float]:
    """Runs without the rows in which a coordinate stands, and the share of the rows that were left out."""
    out, all_rows, left = [], 0, 0
    for run in runs:
        segments: list[tuple[int, int]] = []
        for a, b in run.segments:
            kept = holes(_moves(run.x[a:b], slowest))
            segments += [(a + i, a + j) for i, j in kept if j - i >= _SHORTEST]
            all_rows += b - a
        segments = segments or list(run.segments)  # a run that stands throughout stays, as runs are numbered
        left += sum(b - a for a, b in segments)
        out.append(replace(run, segments=tuple(segments), unbroken=run.segments))
    return tuple(out), 1.0 - left / max(all_rows, 1)


def in_words(share: float) -> list[str]:
    """What was left out, as a sentence; none where nothing was."""
    told = f"{share:.0%} of the rows were left out: the machine stands or turns round in them, and dry friction is "
    return [told + "whatever holds it there."] if share else []


def _moves(x: Array, slowest: Mapping[int, float]) -> Mask:
    """Whether all of the coordinates move, by row (n,)."""
    out = np.ones(len(x), dtype=bool)
    for column, speed in slowest.items():
        mean = uniform_filter1d(np.asarray(x[:, column], dtype=np.float64), _AVERAGED, mode="nearest")
        change = np.gradient(mean) if len(mean) > 1 else np.zeros_like(mean)
        out &= np.abs(mean) >= speed + np.abs(change)
    return out
