"""Rates that no sensor measured, inferred from positions with the physics in the loop.

A Kalman filter follows the positions (`nsde_torch.inference`). Its estimate of a row knows that row and those before
it, and none after: what it lacks of the true rate is then independent of the noise that comes, and physics fitted at
it, averaged over what it lacks (`Physics`), is not biased by noise in its regressors. A smoother, which knows rows on
both sides, would be nearer to the truth and bias friction. What the physics leaves counts as a gust that lasts, so that
wrong physics hardly biases rates.

The rates hang a little on the parameters: they are inferred again until these have settled (`in_turn`).
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from nsde_torch.data import Run
from nsde_torch.data.system_info import rate_pairs
from nsde_torch.errors import DataError
from nsde_torch.inference.estimate import LogLikelihood
from nsde_torch.inference.states import filtered_at
from nsde_torch.inference.steps import inferred_columns
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System

TURNS = 4
"""Times that rates are inferred, at most."""
SETTLED = 0.2
"""Standard errors that parameters may still move by."""
_DIVERGED = 1e3  # times all that a position moves, between two rows


def with_rates(system: System, runs: Sequence[Run], clock: float = 1.0) -> list[Run]:
    """Runs with inferred rates as the physics of a system predicts them; the runs themselves where none are inferred.

    Rows too few for a filter keep their rates.

    Raises:
        DataError: the physics diverges between rows.
    """
    columns = inferred_columns(system, runs) if runs else {}
    if not columns:
        return list(runs)
    try:
        likelihood = LogLikelihood(system, runs, clock, states=True)
    except DataError:
        return list(runs)
    found = filtered_at(likelihood)
    states, unknown, square = found.states(runs), found.unknown(), found.square()
    names, channels, told = system.state_names, list(likelihood.vector.system.error_names), dict[str, float]()
    for i, j in ((i, j) for i, j in rate_pairs(system) if j in columns):
        most = _DIVERGED * max(float(np.ptp(run.x[:, i])) for run in runs)
        if not all(np.abs(x[:, j]).max() * runs[0].dt * clock <= most for x in states):
            raise DataError(
                f"{names[j]} cannot be inferred from {names[i]}: over steps of {runs[0].dt * clock:.3g} s the declared "
                "physics diverges. Log the rate, record at a higher rate, or give first values nearer to those of the "
                "machine (system.parameters.NAME=...)."
            )
        # innovations that are larger than their covariance says have states that are known less
        larger = float(square[likelihood.channels.index(names[i])]) ** 0.5
        told[names[j]] = larger * float(unknown[channels.index(names[j])])
    out = []
    for run, x in zip(runs, states, strict=True):
        own = np.array(run.x)
        own[:, list(columns)] = x[:, list(columns)]
        out.append(replace(run, x=own, inferred=told))
    return out


def in_turn(
    system: System,
    runs: Sequence[Run],
    clock: float,
    identified: Callable[[System, Sequence[Run]], Identification],
) -> Identification:
    """What an identification finds at rates that its own physics predicts."""
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
