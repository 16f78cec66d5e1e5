"""What a flexible model wins beside physics on runs left out, whether it is more than chance, and what it needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import Budgets, Decisions
from nsde_torch.diagnosis.evidence import by_blocks
from nsde_torch.diagnosis.flexible import Flexible, flexible
from nsde_torch.diagnosis.flexible_part import Foretold, Part
from nsde_torch.diagnosis.hidden import allowances_of_tests
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.search import Base
from nsde_torch.sysid.loop_test import LoopTest
from nsde_torch.sysid.noise import Noise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Telling:
    """What a flexible model needs.

    Args:
        row: Row of a port, `force`, or `rate of CHANNEL`.
        variable: Name of a variable, `force before` of an input as it was, `q over time` of one whose part drifts.
        nats: Held-out log-likelihood that is lost without it.
    """

    row: str
    variable: str
    nats: float


@dataclass(frozen=True)
class FlexibleGain:
    """What a flexible model wins beside physics.

    Args:
        base: The physics.
        model: The flexible model.
        gains: Gain of each whitened row (N, channels) [nat].
        left: Their sum over channels that count (N,): in which more is won than feedback may hide, and the residual
            falls.
        p: Chance of it if there were nothing.
        more: Whether it is more than chance.
        by_channel: Gain in each channel that counts [nat].
        telling: What the flexible model needs, the most important first; empty where it wins no more than chance.
    """

    base: Base
    model: Flexible
    gains: Array
    left: Array
    p: float
    more: bool
    by_channel: Mapping[str, float]
    telling: tuple[Telling, ...]

    @property
    def noises(self) -> dict[int, Noise]:
        """Noise models of what it leaves, by number of the channel among the rows of the regression."""
        return {c: law for _, foretold in self.model.parts for c, law in foretold.noises.items()}


def flexible_gain(
    base: Base, variables: Regressors, tested: LoopTest, decisions: Decisions, budgets: Budgets
) -> FlexibleGain:
    """Fit a flexible model beside physics, and judge it on runs left out.

    Args:
        base: The physics at its optimum.
        variables: What its residual may depend on.
        tested: What the data say of the loop.
        decisions: What is more than chance.
        budgets: How much is tried.
    """
    model = flexible(base, variables, budgets)
    gains = model.flexible - model.plain
    allowed = allowances_of_tests(tested)
    smaller = model.flexible_squares.sum(0) <= model.plain_squares.sum(0)
    by_channel = {
        name: float(gains[:, i].sum())
        for i, name in enumerate(model.names)
        if smaller[i] and gains[:, i].sum() > 0.5 * allowed.get(name, 0.0)
    }
    left = gains[:, [name in by_channel for name in model.names]].sum(1)
    p = _chance(left, base)
    more = p < decisions.flexible_alpha
    telling = _telling(model, decisions) if more else ()
    return FlexibleGain(base, model, gains, left, p, more, by_channel, telling)


def _chance(gain: Array, base: Base) -> float:
    """Chance of a gain (N,) on folds left out if there were nothing: twice the smaller of two tests.

    By the scatter over blocks of time (`evidence.by_blocks`). And by what is left without the fold that says most: the
    density of a fold, foretold from the others, over that of the physics alone is a likelihood ratio whose mean is 1
    where the physics is right, and exceeds 1 / p with a chance of p at most (Ville; Wasserman, Ramdas and Balakrishnan,
    PNAS 117 (2020)), whatever the number of functions.
    """
    folds = np.sort(np.bincount(base.fold, weights=gain))
    second = len(folds) * float(np.exp(-max(folds[-2], 0.0))) if len(folds) > 1 else 1.0
    of_block = np.bincount(base.block, weights=gain).astype(np.float64)
    return min(1.0, 2.0 * min(by_blocks(of_block), second))


def _telling(found: Flexible, decisions: Decisions) -> tuple[Telling, ...]:
    """Variables without any function of which the flexible model foretells surely less, by row of a port."""
    out: list[Telling] = []
    for part, foretold in found.parts:
        which = [(name, row) for row, names in _variables(part, foretold).items() for name in names]
        if not which:
            continue
        whole = part.again(foretold)
        for (name, row), left in zip(which, part.without(foretold, which), strict=True):
            if whole - left > decisions.alike_nats:
                out.append(Telling(row, name, whole - left))
    return tuple(sorted(out, key=lambda t: -t.nats))


def _variables(part: Part, foretold: Foretold) -> dict[str, list[str]]:
    out: dict[str, list[str]] = {}
    for k in foretold.used:
        own = out.setdefault(part.terms[k].row, [])
        own += [v for v in part.terms[k].group.variables if v not in own]
    return out
