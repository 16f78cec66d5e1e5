"""How much a flexible model could win, and how much of that the effects win: the ceiling, on runs left out.

    explained = G_effects / max(G_flexible, G_effects + G_left)

with gains in held-out log-likelihood over the declared physics: of the effects, of a flexible model in their place, and
of a flexible model of what they leave (counted where it is more than chance). It is told with a 90 % interval from
blocks of time. Where no flexible model wins more than the effects, these explain at least all that one can.

The ceiling is that of this flexible model (`flexible`): functions of one variable and of two, of inputs up to eight
boxes before, each run foretold from the others. What hangs on three variables at once, on a longer past, or on
what was not logged is not in it: as such it is a lower bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import INTERVAL_LEVEL, Decisions
from nsde_torch.diagnosis.flexible import Flexible, flexible
from nsde_torch.diagnosis.flexible_gain import Telling, flexible_gain
from nsde_torch.diagnosis.innovations import blocks_of_steps
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.evaluation.bootstrap import (
    FEWEST_BLOCKS,
    Blocks,
    function_bootstrap,
    mean_bootstrap,
)
from nsde_torch.sysid.explained import per_second

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ChannelGain:
    """What a flexible model wins in one channel.

    Args:
        unit: Of its rate.
        physics, effects, flexible: Held-out residual of mean rates (rms): of the declared physics, with the effects,
            with a flexible model of what they leave beside them.
        nats: Log-likelihood that the flexible model brings beside the effects.
    """

    unit: str
    physics: float
    effects: float
    flexible: float
    nats: float


@dataclass(frozen=True)
class Ceiling:
    """What a flexible model could win.

    Args:
        why_not: Why nothing was measured; empty where it was.
        effects, alone, left: Gains in held-out log-likelihood [nats]: of the effects, of a flexible model in their
            place, of one beside them.
        interval: 90 % interval of `left`; None where there are too few blocks.
        p: Chance of `left` if there were nothing.
        left_by: What of `left` is in each channel; of channels that count.
        more: Whether it is more than chance and feedback may make.
        explained: Share of what a flexible model can that the effects explain; None where nothing can be explained.
        explained_interval: Its 90 % interval; None where there are too few blocks.
        channels: By channel.
        telling: What the flexible model beside the effects needs, the most important first.
        pairs: Whether functions of two variables were tried.
        model: The flexible model beside the effects; None where nothing was measured.
    """

    why_not: str = ""
    effects: float = 0.0
    alone: float = 0.0
    left: float = 0.0
    interval: tuple[float, float] | None = None
    p: float = 1.0
    left_by: Mapping[str, float] = field(default_factory=dict)
    more: bool = False
    explained: float | None = None
    explained_interval: tuple[float, float] | None = None
    channels: Mapping[str, ChannelGain] = field(default_factory=dict)
    telling: tuple[Telling, ...] = ()
    pairs: bool = True
    model: Flexible | None = None


def ceiling(log: Log, outcome: Outcome) -> Ceiling:
    """Measure what a flexible model wins, over the declared physics and beside the effects.

    Args:
        log: The log.
        outcome: What was concluded.
    """
    blocks = _blocks(outcome, log.decisions)
    why_not = _why_not(log, outcome, blocks)
    if why_not:
        return Ceiling(why_not)
    log.say("what a flexible model could win", 0, 1)
    won = outcome.beside
    if won is None or won.base is not outcome.final:
        won = flexible_gain(outcome.final, outcome.variables, outcome.test, log.decisions, log.budgets)
    beside, gains, left = won.model, won.gains, won.left
    declared, variables = outcome.declared, outcome.declared_variables
    first = flexible(declared, variables, log.budgets) if outcome.found else beside
    found = _gain(first, beside) if outcome.found else np.zeros(len(left))
    alone = (first.flexible - first.plain).sum(1)
    sums = np.stack((found, alone, left if won.more else np.zeros(len(left))), 1)
    explained = bounds = None
    if outcome.found:
        explained, bounds = _share(sums, blocks, log.options.seed)
    interval = _ends(left[:, None], blocks, log.options.seed)
    return Ceiling(
        effects=float(found.sum()),
        alone=float(alone.sum()),
        left=float(left.sum()),
        interval=interval,
        p=won.p,
        left_by=won.by_channel,
        more=won.more,
        explained=explained,
        explained_interval=bounds,
        channels=_channels(outcome, first, beside, gains),
        telling=won.telling,
        pairs=beside.pairs,
        model=beside,
    )


# ---- pieces -------------------------------------------------------------------------------------------


def _why_not(log: Log, outcome: Outcome, blocks: Blocks) -> str:
    """Why a flexible model would not tell, in words; empty where it does."""
    if not log.budgets.flexible_turns:
        return "not asked for"
    if outcome.doubted:
        return "the fit is not believed"
    if log.recorded.inputs_restored:
        return "the inputs were logged as an average and know the future"
    if any(run.band for run in log.runs):
        return (
            "the states were smoothed before they were logged, and what that did to them looks like physics"
        )
    if outcome.final.regression.arithmetic:
        return "what is left is what arithmetic leaves"
    if blocks.count < FEWEST_BLOCKS:
        return "the log is too short"
    return ""


def _blocks(outcome: Outcome, decisions: Decisions) -> Blocks:
    """Blocks of time of the whitened rows, whole runs where there are ten."""
    r = outcome.final.regression
    place = r.whitened_rows(np.arange(len(r.series), dtype=np.int64))
    return blocks_of_steps(r.owners[place], outcome.variables.t[place], decisions)


def _gain(before: Flexible, after: Flexible) -> Array:
    """Gain of each whitened row (N,) by effects, over the channels that both physics have."""
    both = [n for n in before.names if n in after.names]
    first, second = ([f.names.index(n) for n in both] for f in (before, after))
    return np.asarray(after.plain[:, second].sum(1) - before.plain[:, first].sum(1))


def _share(sums: Array, blocks: Blocks, seed: int) -> tuple[float | None, tuple[float, float] | None]:
    """Share of the ceiling that effects explain, and its interval.

    Args:
        sums: Gains of rows (N, 3): of the effects, of a flexible model alone, of one beside the effects.
        blocks: What is resampled.
        seed: Seed of the resamples.
    """

    def share(means: torch.Tensor) -> torch.Tensor:
        effects, alone, left = means.unbind(-1)
        most = torch.maximum(alone, effects + left)
        return torch.where(most > 0, effects / most.clamp_min(1e-300), nan).clamp(0.0, 1.0)[..., None]

    found = function_bootstrap(
        torch.from_numpy(sums),
        share,
        blocks,
        generator=torch.Generator().manual_seed(seed),
        level=INTERVAL_LEVEL,
    )
    value = float(found.value[0])
    ends = float(found.low[0]), float(found.high[0])
    return (None if np.isnan(value) else value), (None if np.isnan(ends).any() else ends)


def _ends(gain: Array, blocks: Blocks, seed: int) -> tuple[float, float] | None:
    """90 % interval of a sum over rows (N, 1)."""
    generator = torch.Generator().manual_seed(seed)
    found = mean_bootstrap(torch.from_numpy(gain), blocks, generator=generator, level=INTERVAL_LEVEL)
    ends = len(gain) * float(found.low[0]), len(gain) * float(found.high[0])
    return None if np.isnan(ends).any() else ends


def _channels(outcome: Outcome, first: Flexible, beside: Flexible, gains: Array) -> dict[str, ChannelGain]:
    """Held-out residuals by channel; none where no stretch is long enough."""
    if not len(beside.plain_squares):
        return {}
    r = outcome.final.regression
    rms = {
        key: dict(zip(f.names, np.sqrt(squares.mean(0)).tolist(), strict=True))
        for key, f, squares in (
            ("physics", first, first.plain_squares),
            ("effects", beside, beside.plain_squares),
            ("flexible", beside, beside.flexible_squares),
        )
    }
    return {
        name: ChannelGain(
            per_second(r.physics.units[c]),
            rms["physics"].get(name, rms["effects"][name]),
            rms["effects"][name],
            rms["flexible"][name],
            float(gains[:, i].sum()),
        )
        for i, (name, c) in enumerate(zip(beside.names, r.rows, strict=True))
    }
