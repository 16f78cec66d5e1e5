"""How sure a finding is: log likelihoods by channel and block of time, chances, and what the data could not have shown.

The chance that columns explain a whitened residual by accident holds whatever the noise inside a block of time looks
like. With scores s_b = Z_b' w_b of B blocks of time, whose mean is 0 if nothing is missing,

    T = S' V^-1 S (B - q) / (q (B - 1)) ~ F(q, B - q),      S = sum s_b,  V from their scatter

(Hotelling, Annals of Mathematical Statistics 2 (1931)). A finding that is the best of M comparisons (candidates of the
catalogue times the starts of each, tests of structure, frequencies of a spectrum) has Bonferroni's correction, stage by
stage (docs/content/theory/evidence.md):

    p_corrected = min(1, p M),      found where p_corrected < level of the stage (`recording.fault`)

Absence of evidence is no evidence of absence: the screening of a candidate gives the standard error s of its size (one
linearised step, noise model of the round). A size below about 4 s goes unnoticed among tens of candidates at alpha =
0.01; where that is a good part of the size that such an effect usually has, "not found" says nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc, stdtr

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.effects import effect_class
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name

if TYPE_CHECKING:
    from nsde_torch.diagnosis.joint_selection import JointSelection


def folds(regression: Regression, decisions: Decisions = DECISIONS) -> Labels:
    """Fold of each whitened row."""
    owners = regression.owners
    return regression.whitened_rows(folds_of(decisions, owners, np.arange(len(owners))))


def folds_of(decisions: Decisions, owners: Labels, firsts: Labels) -> Labels:
    """Fold of each block: whole runs, or groups of them; of one run or two, stretches of each.

    One run alone does not say what lasts from run to run: what falls with time over two would have to be predicted.
    `owners` are the numbers of the runs of blocks, `firsts` those of their first steps.
    """
    d = decisions
    _, number = np.unique(owners, return_inverse=True)
    count = int(number.max()) + 1
    if count >= d.fewest_runs:
        return np.asarray(number * min(count, d.folds) // count)
    out = np.zeros(len(number), dtype=np.int64)
    for run in range(count):
        own = np.flatnonzero(number == run)
        own = own[np.argsort(firsts[own], kind="stable")]
        out[own] = d.folds_stretches * run + np.arange(len(own)) * d.folds_stretches // len(own)
    return out


def fitted_nats(regression: Regression) -> float:
    """Log likelihood of all rows as fitted, less one for each parameter of the noise [nats]."""
    log_std = float(np.log([n.std for n in regression.noises]).sum())
    price = sum(n.parameters for n in regression.noises)
    white = regression.white
    return float(-0.5 * np.square(white).sum()) - log_std * white.shape[1] - price


def by_blocks(difference: Array) -> float:
    """Chance of so large a sum over blocks if its mean were 0."""
    squares = float(np.square(difference).sum())
    if not squares > 0:
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


# ---- chances -------------------------------------------------------------------------------------------

_NOTHING = 1e-9  # of the largest column: shorter is rounding
_NEW = 0.03  # of a column's length: what is left beside the others, below which it is one of them


def nats_of(z: Array, white: Array) -> float:
    """Log-likelihood that orthonormal columns (N, q) bring to whitened residuals (N,) [nats]."""
    return 0.5 * float(np.square(z.T @ white).sum())


def chance(
    z: Array,
    white: Array,
    fold: Labels,
    block: Labels,
    *,
    strong: bool = False,
    decisions: Decisions = DECISIONS,
) -> float:
    """p value of orthonormal columns (N, q): twice the smaller one of a test by blocks, and of folds left out.

    Args:
        z: The columns.
        white: What they are to explain (N,).
        fold, block: Labels of rows.
        strong: Whether they may explain so much that their own scatter over blocks hides it.
        decisions: How many blocks are enough.
    """
    by_block = jackknife if strong else hotelling
    steady = max(float(chdtrc(z.shape[1], 2.0 * nats_of(z, white))), by_block(z, white, block, decisions))
    return min(1.0, 2.0 * min(steady, left_out(z, white, fold, block)))


def left_out(z: Array, white: Array, fold: Labels, block: Labels) -> float:
    """Chance of the log likelihood that functions, fitted without a fold, gain on it, from its scatter over blocks."""
    each = np.zeros(len(white))
    whole, pull = z.T @ z, z.T @ white
    for f in range(int(fold.max()) + 1):
        rows = fold == f
        part = z[rows]
        weights = np.linalg.lstsq(whole - part.T @ part, pull - part.T @ white[rows], rcond=1e-8)[0]
        guess = part @ weights
        each[rows] = guess * (white[rows] - 0.5 * guess)
    return by_blocks(np.bincount(block, weights=each).astype(np.float64))


def hotelling(z: Array, white: Array, block: Labels, decisions: Decisions = DECISIONS) -> float:
    """p value of the sum of scores of blocks, whose scatter is taken with nothing explained."""
    scores: Array = np.zeros((int(block.max()) + 1, z.shape[1]))
    np.add.at(scores, block, z * white[:, None])
    centred = scores - scores.mean(0)
    factor = len(scores) / max(len(scores) - 1, 1)  # of a single block nothing is said
    return _of_scatter(scores.sum(0), centred.T @ centred, len(scores), factor, decisions)


def jackknife(z: Array, white: Array, block: Labels, decisions: Decisions = DECISIONS) -> float:
    """p value of coefficients whose scatter is that of leaving a block out: with everything explained.

    (Quenouille's and Tukey's jackknife; Bell, McCaffrey, Survey Methodology 28 (2002), for what it does to blocks
    that decide by themselves.)
    """
    pull, eye = z.T @ white, np.eye(z.shape[1])
    without = []
    for b in range(int(block.max()) + 1):
        part = z[block == b]
        rest = pull - part.T @ white[block == b]
        without.append(np.linalg.lstsq(eye - part.T @ part, rest, rcond=1e-10)[0])
    centred = np.array(without) - np.mean(without, 0)
    return _of_scatter(pull, centred.T @ centred, len(without), (len(without) - 1) / len(without), decisions)


def enough(blocks: int, functions: int, decisions: Decisions = DECISIONS) -> bool:
    """Whether blocks say something of the scatter of the scores of functions."""
    return blocks >= decisions.blocks_per_function * functions + decisions.blocks_beyond


def _of_scatter(total: Array, scatter: Array, count: int, factor: float, decisions: Decisions) -> float:
    """Hotelling's test of a total whose covariance is `factor` times a scatter of `count` blocks."""
    q = len(total)
    if not enough(count, q, decisions):
        return 0.0
    t2 = float(total @ np.linalg.pinv(scatter * factor, rcond=1e-10) @ total)
    return float(fdtrc(q, count - q, t2 * (count - q) / (q * (count - 1))))


def orthonormal(x: Array) -> Array:
    """Orthonormal columns (N, r) that span those of x (N, k)."""
    u, s, _ = np.linalg.svd(x, full_matrices=False)
    return (
        np.asarray(u[:, s > _NOTHING * max(float(s[0]), 1e-300)])
        if len(s) and s[0] > 0
        else np.zeros((len(x), 0))
    )


def independent(z: Array) -> tuple[Array, NDArray[np.int64]]:
    """Orthonormal columns in order (odd functions first keep their share), and which columns they came from."""
    size = np.linalg.norm(z, axis=0)
    kept: list[int] = []
    basis = np.zeros((len(z), 0))
    for k in range(z.shape[1]):
        if not size[k] > _NOTHING * max(float(size.max()), 1e-300):
            continue
        rest = z[:, k] - basis @ (basis.T @ z[:, k])
        rest = rest - basis @ (basis.T @ rest)
        length = float(np.linalg.norm(rest))
        if length > _NEW * size[k]:
            basis = np.column_stack((basis, rest / length))
            kept.append(k)
    return basis, np.array(kept, dtype=np.int64)


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


def not_shown(
    joint: JointSelection,
    *,
    found: Sequence[str],
    alpha: float,
    decisions: Decisions = DECISIONS,
    system: System | None = None,
) -> list[NotShown]:
    """Effects that were not significant and could not have been.

    Args:
        joint: What was selected.
        found: Names of the effects that were added.
        alpha: Chance below which a candidate is significant.
        decisions: What size is noticed, and what is a good part of the usual one.
        system: Declared system, which knows units; None: those of the simplest machine.
    """
    significant = {p.name for r in joint.rounds for p in r.look.proposals if p.p < alpha} | set(found)
    contained = {simple for name in significant for simple in effect_class(name).includes}
    smallest: dict[tuple[str, str], float] = {}
    for name, errors in joint.errors.items():
        if name not in significant | contained:
            smallest |= {(name, label): error for label, error in errors.items()}
    out = []
    for (name, label), error in smallest.items():
        cls = effect_class(name) if system is None else system.effect_class(name)
        key = own_name(label)
        spec = cls.PARAMETERS[key]
        usual = cls().scale_of(key)
        least, never = decisions.detectable_errors * error, decisions.detectable_never * usual
        level = abs(cls.null.get(key, 0.0)) > never  # does nothing when it is large: no size
        if level or least <= decisions.detectable_share * usual:
            continue
        size = least if isfinite(error) and least < never else None
        out.append(NotShown(name, label, size, usual, spec.unit, cls.separate))
    return sorted(out, key=lambda n: -(n.smallest / n.usual if n.smallest is not None else inf))
