"""How much of what can be explained the effects explain: the ceiling, on blocks of time left out.

    explained = G_effects / (G_effects + G_left)

with gains in held-out log likelihood: of the effects over the declared physics, and of functions of all that was
measured (`learned_functions`) beside the effects. Its 90 % interval is from the scatter of both over blocks of time.
What hangs on three variables at once or on what was not logged is in no function: the ceiling is a lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.evidence import sum_error
from nsde_torch.diagnosis.learned_functions import (
    FunctionGain,
    RowGain,
    function_gain,
    functions_beside,
    optimum_of,
)
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.evaluation.bootstrap import FEWEST_BLOCKS
from nsde_torch.inference import Optimum
from nsde_torch.inference.functions import held_out_density

Array = NDArray[np.float64]

_HALF = 1.645  # standard errors of a 90 % interval


@dataclass(frozen=True)
class Ceiling:
    """What functions of all that was measured explain beside the effects."""

    why_not: str = ""  # why nothing was measured; empty where it was
    effects: float = 0.0  # held-out log likelihood of the effects [nats]
    left: float = 0.0  # what the functions bring beside them [nats]
    interval: tuple[float, float] | None = None  # 90 % interval of it
    explained: float | None = None
    """Share of what can be explained that the effects explain; None without effects."""
    explained_interval: tuple[float, float] | None = None
    """Its 90 % interval; None where there are too few blocks."""
    rows: tuple[RowGain, ...] = ()
    """What is left, by row of a port, the most first; empty where it is no more than chance."""
    gain: FunctionGain | None = None  # the functions; None where nothing was measured


def ceiling(log: Log, outcome: Outcome) -> Ceiling:
    """Measure what functions of all that was measured explain beside the effects.

    Args:
        log: The log.
        outcome: What was concluded.
    """
    at = outcome.optimum
    why_not = _why_not(log, outcome)
    if at is None or why_not:
        return Ceiling(why_not or "the likelihood of the log could not be computed")
    log.say("what functions could still explain", 0, 1)
    found = None if outcome.joint is None else outcome.joint.functions
    if found is None:
        at = optimum_of(outcome.system, at)
        found = functions_beside(at, log.budgets.function_groups)
    if found is None:
        return Ceiling("the log is too short")
    gain = function_gain(at, found, outcome.test)
    before, after = gain.functions.blocks
    left = (after - before) * (gain.nats / max(float((after - before).sum()), 1e-300) if gain.rows else 0.0)
    out = Ceiling(left=float(left.sum()), rows=gain.rows, gain=gain)
    if gain.rows:
        out = replace(out, interval=_ends(out.left, sum_error(left)))
    if not outcome.found:
        return out
    won = before - _declared(outcome, gain.at)
    effects = float(won.sum())
    share = float(np.clip(effects / max(effects + out.left, 1e-300), 0.0, 1.0)) if effects > 0 else 0.0
    ends = None
    if len(won) >= FEWEST_BLOCKS and effects > 0:
        error = sum_error(won * (1.0 - share) - share * left) / (effects + out.left)
        low, high = _ends(share, error)
        ends = max(low, 0.0), min(high, 1.0)
    return replace(out, effects=effects, explained=share, explained_interval=ends)


def _why_not(log: Log, outcome: Outcome) -> str:
    """Why functions would say nothing, in words; empty where they do."""
    if not log.budgets.function_groups:
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
    return ""


def _declared(outcome: Outcome, at: Optimum) -> Array:
    """Held-out log density of each block of time (B,) by the declared physics."""
    near = None if outcome.joint is None else outcome.joint.declared.at
    # rows that bring up memory first are not counted, which shifts blocks
    if near is None or not torch.equal(near.of.space.chunks.counted, at.of.space.chunks.counted):
        near = at
    with torch.no_grad():
        return held_out_density(optimum_of(outcome.declared_system, near))


def _ends(value: float, error: float) -> tuple[float, float]:
    return value - _HALF * error, value + _HALF * error
