"""Where a run changes: something begins, ends or becomes stronger at a moment, and stays so; or is there for a while.

    e = J theta + 1[t0 < t < t1] J_c d + noise,      J_c the columns of a parameter, or of an effect not there yet

A load that is dropped, a motor that loses a blade, a bearing that seizes; t1 is the end of the run. Steady forces may
end before: a gust, a push. The Gram matrices by block of time say what each candidate would explain from any block on,
or to any other, and the whitened rows of the best one say at which row (Andrews, Econometrica 61 (1993): the largest of
the score tests over moments). The run is then parted there, and what differs between its parts is found as between any
runs (`between_runs`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import log as ln

import numpy as np
import torch
from scipy.special import chdtrc

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.evidence import bonferroni
from nsde_torch.diagnosis.joint_selection import FittedPhysics
from nsde_torch.diagnosis.possible_differences import ColumnsBeside, PossibleDifference
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects.by_run import OF_EACH_RUN
from nsde_torch.effects.law import split_name
from nsde_torch.inference.sensitivity import inverted, rows_of

_EDGE = 4  # blocks of time on either side of a moment, so that both sides show what differs
_NEAR = 2  # blocks around the best one in which the moment is looked for
# a gain that fell while the force was small was cut 0.6 s late, and the residual depended on time
_AS_LIKELY = 3.0  # nats below the likeliest moment that others may be; rows between them are in neither part
_ENDS = 150  # most moments of a run between which a while is looked for
_SHOWN = 1e-3  # least share of what a column does after a moment that no other column does


@dataclass(frozen=True)
class ChangeWithinRuns:
    """What a candidate would explain if it changed at a moment of some runs."""

    of: PossibleDifference
    steps: Mapping[int, tuple[int, ...]]  # by number of the run: first steps of the blocks after its moments
    of_runs: float  # log likelihood that a number of their own for these runs would bring
    nats: float  # that which it would bring beyond, less the price of numbers and moments (Schwarz)


def cut_where_it_changes(
    log: Log, search: Search, place: FittedPhysics, columns: ColumnsBeside, otherwise: Mapping[str, float]
) -> Log:
    """The log with each run cut where something in it surely changes; the log itself where nothing does.

    Or where that explains no more than differences between whole runs would: of a run whose encoder's zero was off,
    some stiffness would change. `otherwise` has the nats of these by what differs.
    """

    def whole(change: ChangeWithinRuns) -> float:
        return max(otherwise.get(change.of.target, 0.0), change.of_runs) + change.nats

    found = [one for c in columns.candidates if (one := _change(search, place, columns, c)) is not None]
    best = max(found, key=whole, default=None)
    if best is None or whole(best) <= max(otherwise.values(), default=0.0):
        return log
    names = [run.name for run in log.runs]
    return log.cut({names[run]: at for run, at in _moments(place, columns, best).items()})


def _change(
    search: Search, place: FittedPhysics, columns: ColumnsBeside, one: PossibleDifference
) -> ChangeWithinRuns | None:
    """The moments of the runs at which a candidate most surely changes; None where that is not beyond chance."""
    owner, firsts = place.at.of.space.chunks.places()
    count, among = one.turn.shape[1], len(columns.candidates) * len(owner)
    price = 0.5 * count * ln(len(owner)) + ln(len(owner))
    steps: dict[int, tuple[int, ...]] = {}
    nats = of_runs = 0.0
    for run in np.unique(owner):
        blocks = np.flatnonzero(owner == run)
        blocks = blocks[np.argsort(firsts[blocks], kind="stable")]
        if len(blocks) <= 2 * _EDGE:
            continue
        best: tuple[list[int], float, float] | None = None
        least = search.decisions.alike_nats
        for windows in _windows(one, len(blocks)):
            gained, of_run = _gains(place, columns, one, blocks, windows)
            at = int(gained.argmax())
            # another moment, another price
            ends = [int(k) for k in windows[at] if k < len(blocks)]
            own = float(gained[at]) - price - (len(ends) - 1) * ln(len(owner))
            p = bonferroni(float(chdtrc(count, 2.0 * gained[at])), among * len(windows) // len(blocks))
            if own > least and p < search.level("effects"):
                best, least = (ends, own, of_run), own + search.decisions.alike_nats
        if best is not None:
            steps[int(run)] = tuple(int(firsts[blocks[k]]) for k in best[0])
            nats, of_runs = nats + best[1], of_runs + best[2]
    return ChangeWithinRuns(one, steps, of_runs, nats) if steps else None


def _windows(one: PossibleDifference, count: int) -> Iterator[Labels]:
    """Blocks from which to which a candidate may be another one, among so many of a run (W, 2).

    From one on, and of a steady force for a while: a gust of 8 s in one run of three was noise
    (tests/diagnosis/test_between_runs.py).
    """
    begin = np.arange(_EDGE, count - _EDGE)
    yield np.stack((begin, np.full_like(begin, count)), 1)
    if split_name(one.target)[0] in OF_EACH_RUN.values() and count > 3 * _EDGE:
        apart = max(1, count // _ENDS)
        each = np.arange(_EDGE, count - _EDGE + 1, apart)
        first, last = (k.ravel() for k in np.meshgrid(each, each, indexing="ij"))
        yield np.stack((first, last), 1)[last - first >= _EDGE]


def _gains(
    place: FittedPhysics, columns: ColumnsBeside, one: PossibleDifference, blocks: Labels, windows: Labels
) -> tuple[Array, float]:
    """What a change within each window of blocks of a run would bring beyond a number of its own for the run (W,), and
    what that brings [nats].

    Where all runs change, each at another moment, what they have in common is neither side; and a run that is another
    one from its start to its end does not change.
    """
    kept, moved = 1 + place.best.free, 1 + np.flatnonzero(one.turn.any(1))
    turn, grams = one.turn[moved - 1], columns.blocks
    inverse = inverted(grams[:, kept[:, None], kept].sum(0))

    def within(values: Array) -> Array:
        """Sums over all of the run and over each window."""
        sums = np.concatenate((np.zeros_like(values[:1]), values.cumsum(0)))
        return np.concatenate((sums[-1:], sums[windows[:, 1]] - sums[windows[:, 0]]))

    inner = within(turn.T @ grams[blocks][:, moved[:, None], moved] @ turn)
    across = within(turn.T @ grams[blocks][:, moved[:, None], kept])
    pulls = within(grams[blocks][:, moved, 0] @ turn)
    left = inner - across @ inverse @ across.transpose(0, 2, 1)

    def shown(information: Array) -> Array:
        whole = np.diagonal(inner, axis1=1, axis2=2)
        return np.asarray((np.diagonal(information, axis1=1, axis2=2) > _SHOWN * whole).all(1))

    of_run = 0.0
    if shown(left)[0]:  # else the run is the only one. That of the run is a change before its first block
        shared = inner - across @ inverse @ across[0].T
        turned, whole = shared @ inverted(left[0]), pulls[0]
        of_run = float(0.5 * whole @ inverted(left[0]) @ whole) / place.best.inflation
        pulls, left = pulls - turned @ whole, left - turned @ shared.transpose(0, 2, 1)
    found = np.where(shown(left), 0.5 * np.einsum("bi,bij,bj->b", pulls, inverted(left), pulls), 0.0)
    return found[1:] / place.best.inflation, of_run


def _moments(
    place: FittedPhysics, columns: ColumnsBeside, change: ChangeWithinRuns
) -> dict[int, tuple[tuple[float, float], ...]]:
    """Logged times between which the moments are, by number of the run."""
    space, kept, turn = place.at.of.space, place.best.free, torch.from_numpy(change.of.turn).float()
    table = torch.cat((columns.table[..., kept], columns.table @ turn), -1)
    steps, rows = rows_of((space, place.at.levels, place.at.about, place.at.at), table, ()).by_step()
    owner = np.repeat(np.array(space.steps.runs), [b - a for a, b in space.steps.segments])[steps]
    e, physics, column = np.split(rows, [1, 1 + len(kept)], -1)
    block = np.median(np.diff(np.sort(space.chunks.places()[1])))
    times = {}
    for run, ends in change.steps.items():
        mine = owner == run
        known = np.concatenate((physics, column * mine[:, None, None]), -1)
        last = ends[1] if len(ends) > 1 else len(owner)
        inside = ((steps[mine] >= ends[0]) & (steps[mine] < last))[:, None, None]
        of_run, changed = known[mine], inside * column[mine]
        inverse = inverted(np.einsum("nmi,nmj->ij", known, known))
        left = e[mine, :, 0] - of_run @ (inverse @ np.einsum("nmi,nmj->i", known, e))
        across = np.einsum("nmi,nmj->ij", of_run, changed)
        inner = np.einsum("nmi,nmj->ij", changed, changed) - across.T @ inverse @ across
        size = inverted(inner) @ np.einsum("nmi,nm->i", changed, left)
        beside = of_run @ (inverse @ across @ size)
        outside, within = (
            (left * moved - 0.5 * moved * moved).sum(1) for moved in (-beside, column[mine] @ size - beside)
        )
        between = []
        for end, sign in zip(ends, (1.0, -1.0), strict=False):
            # log likelihood of a moment before each row, but for a constant
            value = sign * ((outside - within).cumsum() - (outside - within))
            near = np.flatnonzero(np.abs(steps[mine] - end) <= _NEAR * block)
            able = steps[mine][near[value[near] > value[near].max() - _AS_LIKELY]]
            between.append((float(space.steps.t[able[0]]), float(space.steps.t[able[-1]])))
        times[run] = tuple(between)
    return times
