"""Faults of the recording chain, which need no dynamics to show: looked for, and undone, before any physics.

Each is a file of `nsde_torch.recording.faults`; they are asked in the order in which they act. Some can look like
something else, and are undone only where the declared physics fits better for it: what is half a step late may be how
a simulator steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.recording.faults.registry import in_order
from nsde_torch.recording.log import NATS, LoggedRuns, Misfits, Recorded


def undo(
    data: DataSet,
    runs: Sequence[Run],
    system: SystemInfo,
    *,
    alpha: float,
    misfit: Callable[[Sequence[Run], float], float],
) -> Recorded:
    """Find the faults of a recording chain and undo them.

    Args:
        data: Where the runs are from; it knows the clock.
        runs: Those to look at.
        system: The machine.
        alpha: Chance that any stage of a diagnosis finds something in a sound log (`levels`).
        misfit: Negative log likelihood per row [nats] of the declared physics in runs, at a clock.
    """
    log = LoggedRuns(data, runs, system, alpha=alpha, misfit=misfit)
    found = []
    for fault in in_order():
        seen = fault.detect(log)
        if seen is not None:
            log.take_out(fault, seen)
            found.append(seen)
    for suspect in sorted((s for fault in in_order() for s in fault.suspects(log)), key=lambda s: s.order):
        there = log.misfit_with(suspect.fault, suspect.found.plain)
        back = log.misfit_with(suspect.fault, suspect.against)
        if there < back - NATS / sum(len(run) for run in log.runs):
            log.take_out(suspect.fault, suspect.found)
            found.append(suspect.found)
    return Recorded(tuple(log.runs), log.clock, tuple(found))


def instead_of_effects(
    found: Recorded, system: SystemInfo, misfits: Misfits, *, rows: int, other: float
) -> Recorded | None:
    """The log with a further fault undone that explains what effects do not; None where there is none.

    Args:
        found: The recording chain, undone as far as it is known.
        system: The machine.
        misfits: Negative log likelihood per row [nats] of the declared physics in runs, by channel.
        rows: Number of rows.
        other: The misfit of physics with effects, all channels together.
    """
    for fault in in_order():
        better = fault.instead_of_effects(found, system, misfits, rows=rows, other=other)
        if better is not None:
            return better
    return None
