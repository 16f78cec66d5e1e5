"""The recording chain undone, with the declared physics as its judge where kinematics cannot tell."""

from collections.abc import Sequence
from dataclasses import replace
from math import log

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.decisions import Budgets, Decisions
from nsde_torch.diagnosis.fitted import at_bounds
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import search_in
from nsde_torch.recording.chain import Recorded, instead_of_effects, undo
from nsde_torch.recording.unmeasured_rates import measured_part
from nsde_torch.systems import System

Array = NDArray[np.float64]


def undone(
    data: DataSet,
    runs: Sequence[Run],
    system: System,
    options: Options,
    decisions: Decisions,
    budgets: Budgets,
) -> Recorded:
    """The recording chain undone as far as kinematics and spectra tell.

    Args:
        data: Where the runs are from.
        runs: Those to look at.
        system: Declared system.
        options: Settings.
        decisions: What is decided by.
        budgets: How much is tried.
    """

    def misfit(some: Sequence[Run], clock: float) -> float:
        search = search_in(system, some, clock, options, decisions=decisions, budgets=budgets)
        return sum(log(noise.std) for noise in search.quick(system).noises)

    seen = measured_part(system, {name for run in runs for name in run.inferred})
    return undo(data, runs, seen, alpha=decisions.alpha, misfit=misfit)


def with_a_late_sensor(read: Log, outcome: Outcome) -> Log | None:
    """The log with a sensor moved that is late as a whole, where that explains more than effects do.

    Args:
        read: The log.
        outcome: What the search in it concluded.
    """

    def misfits(some: Sequence[Run]) -> Array:
        return np.log([noise.std for noise in read.search(some).quick(read.system).noises])

    final = outcome.final.regression
    with_effects = sum(log(noise.std) for noise in final.noises)
    recorded = replace(read.recorded, runs=read.runs)
    moved = instead_of_effects(recorded, read.system, misfits, rows=len(final.series), other=with_effects)
    return None if moved is None else replace(read, recorded=moved, runs=tuple(moved.runs))


def explains_more(moved: Outcome, outcome: Outcome) -> bool:
    """Whether a late sensor leaves little structure, and no parameter at a bound, of what the log as it is leaves.

    Else something else looks like it: an input of the other sign, say.
    """
    at_a_bound = bool(at_bounds(moved.declared.regression).any())
    return _structure(moved) < outcome.decisions.late_sensor_share * _structure(outcome) and not at_a_bound


def _structure(outcome: Outcome) -> float:
    """Log-likelihood that what is left over would bring [nats]."""
    return sum(max(d.excess, 0.0) for d in outcome.structured)
