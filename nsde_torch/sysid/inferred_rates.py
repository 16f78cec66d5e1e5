"""Rates that no sensor measured, inferred from positions with the physics in the loop.

A state observer follows the positions (`observer`). Its estimate of a row knows that row and those before it, and none
after: what it lacks of the true rate is then independent of the noise that comes, and physics fitted at it, averaged
over what it lacks (`Physics`), is not bent by noise in its regressors. A smoother, which knows rows on both sides,
would be nearer to the truth and bend friction.

Gains are those of the smallest e, one pair for each position, never slower than `SLOWEST_S`: in that time rates forget
what the physics says of them, so that wrong physics hardly counts. Pieces of the runs are followed side by side.

The rates hang a little on the parameters: they are inferred again until these have settled (`in_turn`).
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.inference.steps import inferred_columns
from nsde_torch.sysid.observer import Observer
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System

Array = NDArray[np.float64]

TURNS = 4
"""Times that rates are inferred, at most."""
SETTLED = 0.2
"""Standard errors that parameters may still move by."""
_PIECE_S = 2.0
_DIVERGED = 1e3  # times all that a position moves, between two rows


def with_rates(system: System, runs: Sequence[Run], clock: float = 1.0) -> list[Run]:
    """Runs with inferred rates as the physics of a system foretells them; the runs themselves where none are inferred.

    Args:
        system: The machine with its values; it is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.

    Raises:
        DataError: the physics diverges between rows.
    """
    columns = inferred_columns(system, runs) if runs else {}
    if not columns:
        return list(runs)
    dt = runs[0].dt * clock
    observer = Observer(system, runs, columns=list(columns), dt=dt, piece_s=_PIECE_S)
    chosen, square, rates = observer.best()
    for c, (j, at) in enumerate(zip(observer.rates, observer.positions, strict=True)):
        most = _DIVERGED * max(float(np.ptp(run.x[:, at])) for run in runs)
        v = rates[:, :, c][np.isfinite(rates[:, :, c])]
        if not len(v) or np.abs(v).max() * dt > most:
            raise DataError(
                f"{system.state_names[j]} cannot be inferred from {system.state_names[at]}: over steps of {dt:.3g} s "
                "the declared physics diverges. Log the rate, record at a higher rate, or give first values nearer to "
                "those of the machine (system.parameters.NAME=...)."
            )
    states = [np.array(run.x) for run in runs]
    for p, (n, first, end, start) in enumerate(observer.pieces):
        part = rates[first - start : end - start, p]
        for c, j in enumerate(observer.rates):
            good = np.isfinite(part[:, c])
            states[n][first:end][good, j] = part[good, c]
    told = {
        system.state_names[j]: gain.unknown(float(own), dt)
        for j, gain, own in zip(observer.rates, chosen, square, strict=True)
    }
    return [replace(run, x=x, inferred=told) for run, x in zip(runs, states, strict=True)]


def in_turn(
    system: System,
    runs: Sequence[Run],
    clock: float,
    identified: Callable[[System, Sequence[Run]], Identification],
) -> Identification:
    """What an identification finds at rates that its own physics foretells.

    Args:
        system: The machine; its values are where the iteration starts. It is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.
        identified: Identifies a system from runs.
    """
    if not (runs and runs[0].inferred):
        return identified(system, runs)
    machine = copy.deepcopy(system)
    found = identified(machine, with_rates(machine, runs, clock))
    for _ in range(TURNS - 1):
        before = found.values
        found.vector.write(machine, before)
        found = identified(machine, with_rates(machine, runs, clock))
        error = np.sqrt(np.diag(found.covariance).clip(0.0))
        if (np.abs(found.values - before) <= SETTLED * error)[found.shown.known].all():
            break
    return found
