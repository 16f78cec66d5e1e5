"""Interventions: times from which on the inputs of a log were set from outside, whatever the state was.

A further column `intervention` is 0 where the inputs were those of whoever flew, and 1 from the row on at which they no
longer depend on the state or on what disturbs it. From such a row on

    E[x(t + h) | x(t), u(t ... t + h)]  =  E[x(t + h) | x(t), do(u(t ... t + h))]

(Pearl, Causality, 2009, section 3.2: nothing but the past of t leads to the inputs), so that errors of predictions from
there show what an input does. Under feedback the two differ: inputs answer the disturbances between t and t + h.

Evaluation of data that have the column starts at these rows and nowhere else. The rows before are kept: they hold the
inputs before the start, which lags and delays remember.
"""

from collections.abc import Sequence

import numpy as np

from nsde_torch.data.raw import Finding, RawRun, Report, holes
from nsde_torch.data.run import Run
from nsde_torch.errors import DataError

COLUMN = "intervention"


def check(runs: Sequence[RawRun]) -> None:
    """Refuse a column that is not what it says, or that only some of the runs have."""
    having = [run for run in runs if COLUMN in run.extra]
    if not having:
        return
    lacking = [run.name for run in runs if COLUMN not in run.extra]
    if lacking:
        raise DataError(
            f"the column {COLUMN!r} is in run {having[0].name!r} and not in {lacking[0]!r}; errors are those of "
            "interventions in all runs, or in none. Add the column (0 where inputs are those of the log), or keep the "
            "two kinds in folders of their own."
        )
    for run in having:
        column = run.extra[COLUMN]
        odd = np.flatnonzero((column != 0) & (column != 1))
        if len(odd):
            raise DataError(
                f"{run.where(int(odd[0]))}: the column {COLUMN!r} holds {column[odd[0]]:g}; it takes 0, and 1 from the "
                "row on at which the inputs were set from outside."
            )


def report_of(runs: Sequence[Run], report: Report) -> None:
    """Tell how many interventions there are; refuse a column that is 1 somewhere and never changes from 0 to 1."""
    if not interventional(runs):
        return
    count = sum(len(stretches(run) or ()) for run in runs)
    if not count:
        raise DataError(
            f"the column {COLUMN!r} never changes from 0 to 1 inside a stretch without a gap, so that there is no "
            "start with the inputs before it. Keep some rows before each intervention, or leave the column out."
        )
    message = f"{count} interventions, from which on inputs do not depend on the state"
    report(Finding("interventions", "", count, message, "evaluated from there"))


def interventional(runs: Sequence[Run]) -> bool:
    """Whether predictions are to start at interventions: there is the column, and it is not zero throughout."""
    return any(COLUMN in run.extra and bool((run.extra[COLUMN] > 0.5).any()) for run in runs)


def stretches(run: Run) -> list[tuple[int, int]] | None:
    """Rows (start, stop) of each intervention, its end state included; None where the run has no such column.

    A row counts where its column is above one half (interpolation to another step leaves shares), and a start where
    the row before it, in the same segment, does not.
    """
    if COLUMN not in run.extra:
        return None
    on = np.asarray(run.extra[COLUMN]) > 0.5
    out = []
    for a, b in run.segments:
        # the state of the row at which it ends is still the work of the inputs before
        out += [(a + c, min(a + d + 1, b)) for c, d in holes(on[a:b]) if c > 0]
    return [(c, d) for c, d in out if d - c >= 2]


def longest_stretch(runs: Sequence[Run]) -> float:
    """Longest time over which a prediction can run [s]: inside a segment, or from an intervention on."""
    there_are = interventional(runs)
    every = [(run, (stretches(run) or ()) if there_are else run.segments) for run in runs]
    return max((float(run.t[b - 1] - run.t[a]) for run, some in every for a, b in some), default=0.0)
