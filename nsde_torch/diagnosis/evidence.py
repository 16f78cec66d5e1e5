"""How sure a finding is: log likelihoods by channel and block of time, chances, and what the data could not have shown.

Scores s_b of B blocks of time with informations I_b, 1 in all, ask for the coefficients b = sum s_b. Whatever the noise
inside a block of time looks like, these scatter as those of leaving a block out do,

    b_-b = (1 - I_b)^-1 (b - s_b),      T = b' V^-1 b (B - q) / (q (B - 1)) ~ F(q, B - q),      V from their scatter

(jackknife). A finding that is the best of M comparisons has Bonferroni's correction, stage by stage
(docs/content/theory/evidence.md):

    p_corrected = min(1, p M),      found where p_corrected < level of the stage (`recording.fault`)

The screening of a candidate gives the standard error s of its size (one linearised step, noise model of the round). A
size below about 4 s goes unnoticed: where that is a good part of its usual size, "not found" says nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.effects import effect_class
from nsde_torch.inference.steps import Steps
from nsde_torch.sysid.feedback_test import FilteredLog
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name

if TYPE_CHECKING:
    from nsde_torch.diagnosis.joint_selection import FittedPhysics, JointSelection


def folds_of(decisions: Decisions, owners: Labels, firsts: Labels, *, of_each_run: bool = False) -> Labels:
    """Fold of each block: whole runs, or groups of them; of one run or two, stretches of each.

    One run alone does not say what lasts from run to run: what falls with time over two would have to be predicted.
    `owners` are the numbers of the runs of blocks, `firsts` those of their first steps. `of_each_run`: for what has
    numbers for each run, which no other run knows.
    """
    d = decisions
    _, number = np.unique(owners, return_inverse=True)
    count = int(number.max()) + 1
    if count >= d.fewest_runs and not of_each_run:
        return np.asarray(number * min(count, d.folds) // count)
    out = np.zeros(len(number), dtype=np.int64)
    for run in range(count):
        own = np.flatnonzero(number == run)
        own = own[np.argsort(firsts[own], kind="stable")]
        out[own] = d.folds_stretches * run + np.arange(len(own)) * d.folds_stretches // len(own)
    return out


def by_blocks(difference: Array) -> float:
    """Chance of so large a sum over blocks if its mean were 0."""
    squares = float(np.square(difference).sum())
    if not squares > 0 or len(difference) < 2:
        return 1.0
    counting = float(np.abs(difference).sum()) ** 2 / squares
    return float(stdtr(max(counting - 1.0, 1.0), -float(difference.sum()) / sum_error(difference)))


@np.errstate(over="ignore")  # of a step that leaves the finite numbers in one block
def sum_error(difference: Array) -> float:
    """Standard error of a sum over blocks, from their scatter."""
    return float(difference.std(ddof=1)) * len(difference) ** 0.5


def nats_by_channel(before: Regression, after: Regression) -> dict[str, float]:
    """Log-likelihood, as fitted, that one regression has beyond another, by channel [nats]."""

    def fitted(r: Regression) -> dict[str, float]:
        rows = r.white.shape[1]
        return {
            r.physics.names[c]: -0.5 * float(w @ w) + law.likelihood(rows)
            for c, w, law in zip(r.rows, r.white, r.noises, strict=True)
        }

    first, second = fitted(before), fitted(after)
    return {name: second[name] - first[name] for name in first}


_RUN = 2**40  # rows, more than any log has


def filtered_log(place: FittedPhysics, regression: Regression) -> FilteredLog | None:
    """What the filter of a likelihood at its optimum says of the steps of a regression; None of channels it lacks.

    A regression takes states as they were measured. Of a stiff tyre, whose slip is mostly noise, the right physics left
    it 1,500 nats less than wrong ones, and a lag was what feedback may hide
    (tests/diagnosis/test_feedback_bias.py::test_noise_of_one_state_in_another_is_no_feedback). Of a machine that moves
    in its own axes channels are others.
    """
    names = [regression.physics.names[c] for c in regression.rows]
    own, system, pass_ = place.best.channels, place.system, place.at.at
    theirs, steps = place.at.of.space.steps, regression.physics.steps
    # a rate that no sensor measured is known from its position
    positions = {rate: position for position, rate, _ in system.position_derivatives}
    seen = {name: name if name in own else positions.get(name, "") for name in names}
    if not {*seen.values()} <= {*own}:
        return None
    # stretches that are too short for a likelihood have none: of a servo that friction holds for most of the time those
    # of the regression, in which noise of the speed moves the voltage, were taken for what its controller knew
    _, at, before = np.intersect1d(_rows(steps), _rows(theirs), assume_unique=True, return_indices=True)

    def aligned(values: Array) -> Array:
        out = np.zeros((len(steps), values.shape[1]))
        out[at] = values[before]
        return out

    innovations = aligned(place.at.innovations)
    straight = [name for name in own if name in system.state_names and not _of_attitude(system, name)]
    columns = [system.error_names.index(name) for name in straight]
    moved = pass_.gain[..., columns, :] @ pass_.errors[..., None]
    left = pass_.errors[..., [own.index(name) for name in straight]] - moved[..., 0]
    states = [system.state_names.index(name) for name in straight]
    return FilteredLog(
        {name: innovations[:, own.index(channel)] for name, channel in seen.items()},
        logged=np.asarray(steps.seen1[:, states]),
        noise=aligned(place.at.by_step(left)),
        known=aligned(np.ones((len(theirs), 1)))[:, 0] > 0,
    )


def _of_attitude(system: System, name: str) -> bool:
    q = system.quaternion
    return q is not None and q.start <= system.state_names.index(name) < q.stop


def _rows(steps: Steps) -> Labels:
    """The run and the row of the log of each step, as one number (N,)."""
    runs = np.repeat(steps.runs, [b - a for a, b in steps.segments])
    return np.rint(steps.t.numpy() / steps.logged_dt).astype(np.int64) + runs * _RUN


def joint_nats_by_channel(
    before: FittedPhysics, after: FittedPhysics, names: Sequence[str]
) -> dict[str, float]:
    """Log likelihood that physics have beyond others, by channel [nats], a position's with its rate's; see above."""
    own = after.best.channels
    if not set(names) <= set(own):
        return {}
    gained = dict(zip(own, (after.at.by_channel - before.at.by_channel).tolist(), strict=True))
    positions = {rate: place for place, rate, _ in after.system.position_derivatives}
    return {name: gained[name] + gained.get(positions.get(name, ""), 0.0) for name in names}


# ---- chances -------------------------------------------------------------------------------------------

_WHOLE = 0.999  # share of the information on a direction that one block may bring, for it to be left out


def chance(
    pulls: Array, grams: Array, fold: Labels, draws: int = 0, *, decisions: Decisions = DECISIONS
) -> float:
    """p value of scores in directions of unit information: twice the smaller one of two tests.

    The one is the larger of that under the noise that is known and of that by their scatter over blocks of time, the
    other that of folds left out. Of scores by block (B, q) with information (B, q, q), 1 in all, known from so many
    draws (0: exactly).
    """
    q, squares = pulls.shape[1], float(np.square(pulls.sum(0)).sum())
    known = of_draws(squares, q, draws) if draws else float(chdtrc(q, squares))
    steady = max(known, jackknife(pulls, grams, decisions))
    return min(1.0, 2.0 * min(steady, left_out(pulls, grams, fold)))


def of_draws(squares: float, q: int, draws: int) -> float:
    """Chance of the squares of q scores whose information is that of so many draws (Hotelling)."""
    return float(fdtrc(q, draws - q + 1, squares * (draws - q + 1) / (q * draws)))


def left_out(pulls: Array, grams: Array, fold: Labels) -> float:
    """Chance of the log likelihood that functions, fitted without a fold, gain on it, from its scatter over blocks."""
    each = np.zeros(len(pulls))
    for number in np.unique(fold):
        own = fold == number
        step = _fitted(pulls.sum(0) - pulls[own].sum(0), grams.sum(0) - grams[own].sum(0))
        each[own] = pulls[own] @ step - 0.5 * np.einsum("i,bij,j->b", step, grams[own], step)
    return by_blocks(each)


def jackknife(pulls: Array, grams: Array, decisions: Decisions = DECISIONS) -> float:
    """p value of coefficients whose scatter is that of leaving a block out: with everything explained.

    (Quenouille's and Tukey's jackknife; Bell, McCaffrey, Survey Methodology 28 (2002), for what it does to blocks
    that decide by themselves.)
    """
    count, q = pulls.shape
    if not enough(count, q, decisions):
        return 0.0
    pull, whole = pulls.sum(0), grams.sum(0)
    without = np.linalg.solve(whole - _WHOLE * grams, (pull - pulls)[..., None])[..., 0]
    step, centred = _fitted(pull, whole), without - without.mean(0)
    scatter = centred.T @ centred * (count - 1) / count
    t2 = float(step @ np.linalg.pinv(scatter, rcond=1e-10, hermitian=True) @ step)
    return float(fdtrc(q, count - q, t2 * (count - q) / (q * (count - 1))))


def dispersion(pulls: Array, grams: Array) -> float:
    """How many times what scores (B, q) leave of blocks is what their information (B, q, q) says, at least 1.

    Of few blocks, of which some decide alone, the scatter of each direction (`jackknife`) is not known.
    """
    whole = np.linalg.pinv(grams.sum(0), hermitian=True)
    left = pulls - grams @ (whole @ pulls.sum(0))
    expected = np.trace((grams - grams @ whole @ grams) @ whole, axis1=1, axis2=2).sum()
    return max(float(np.einsum("bi,ij,bj->", left, whole, left)) / max(float(expected), 1e-300), 1.0)


def enough(blocks: int, functions: int, decisions: Decisions = DECISIONS) -> bool:
    """Whether blocks say something of the scatter of the scores of functions."""
    return blocks >= decisions.blocks_per_function * functions + decisions.blocks_beyond


def _fitted(pull: Array, whole: Array) -> Array:
    return np.asarray(np.linalg.lstsq(whole, pull, rcond=1e-10)[0])


def bonferroni(p: float, comparisons: float) -> float:
    """p value of the best of so many comparisons."""
    return min(1.0, p * comparisons)


# ---- what the data could not have shown ----------------------------------------------------------------


@dataclass(frozen=True)
class NotShown:
    """A parameter of an effect whose usual size these data would not show."""

    effect: str  # name of the effect
    parameter: str  # label of the parameter, with an index where there are axes
    smallest: float | None
    """Smallest size that would be noticed; None where nothing in the data depends on it."""
    usual: float  # size that it usually has
    unit: str  # unit of both
    experiment: str  # the experiment that would show it
    declared: bool = False  # whether it is not seen because declared parameters do the same in these data


def not_shown(
    joint: JointSelection,
    *,
    found: Sequence[str],
    alpha: float,
    decisions: Decisions = DECISIONS,
    system: System | None = None,
) -> list[NotShown]:
    """Effects that were not significant and could not have been, of a declared system or of the simplest machine."""
    significant = {p.name for r in joint.rounds for p in r.look if p.p < alpha} | set(found)
    contained = {simple for name in significant for simple in effect_class(name).includes}
    out = []
    for name, errors in joint.errors.items():
        if name in significant | contained:
            continue
        cls = effect_class(name) if system is None else system.effect_class(name)
        for label, (error, alone) in errors.items():
            key = own_name(label)
            usual = cls().scale_of(key)
            least, never = decisions.detectable_errors * error, decisions.detectable_never * usual
            level = abs(cls.null.get(key, 0.0)) > never  # does nothing when it is large: no size
            if level or least <= decisions.detectable_share * usual:
                continue
            size = least if isfinite(error) and least < never else None
            if size is None and cls.local:
                continue
            by_declared = size is None and decisions.detectable_errors * alone < never
            unit = cls.PARAMETERS[key].unit
            out.append(NotShown(name, label, size, usual, unit, cls.separate, by_declared))
    return sorted(out, key=lambda n: -(n.smallest / n.usual if n.smallest is not None else inf))
