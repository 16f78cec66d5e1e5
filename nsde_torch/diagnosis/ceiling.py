"""The share of the explainable evidence that the effects have: the ceiling, on blocks of time left out.

    explained = G_effects / (G_effects + G_left)

with gains in held-out log likelihood: of the effects over the declared physics, and of functions of all that was
measured beside the effects. These are the functions that residual networks of `nsde train` learn
(`nsde_torch.inference.functions`), and may be of inputs and places too: what a diagnosis says can be won is what
training reaches. The 90 % interval is from the scatter of both over blocks of time. What hangs on three variables at
once or on what was not logged is in no function: the ceiling is a lower bound.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.evidence import sum_error
from nsde_torch.diagnosis.feedback_bias import allowances_of_tests
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.regressors import machine_variables, moved_channels_of
from nsde_torch.effects import Port
from nsde_torch.evaluation.bootstrap import FEWEST_BLOCKS
from nsde_torch.inference import Optimum, nearly_maximised
from nsde_torch.inference.functions import Functions, Variables, held_out_density, learned
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import named_inputs, vocabulary


@dataclass(frozen=True)
class RowGain:
    """What functions on one row of a port explain."""

    row: str  # its name, `body_force[z]`
    unit: str  # of a force there
    port: int  # number of the disturbance of the likelihood
    size: float  # root mean square of the functions over the data
    nats: float  # held-out log likelihood that they bring
    error: float  # its standard error
    variables: Mapping[str, float]
    """What they are of, with the log likelihood that is lost without these [nats], the most first."""
    channels: frozenset[str]  # those that the row moves


@torch.no_grad()
def functions_beside(at: Optimum, most: int) -> Functions | None:
    """Functions beside the physics of an optimum; None where they would say nothing.

    `most` is the largest number of groups of functions of one row.
    """
    space, system = at.of.space, at.of.vector.system
    if not most or len(at.blocks) < FEWEST_BLOCKS:
        return None
    ports = [k for k, (port, _) in enumerate(space.disturbances) if port in system.residual_ports]
    return learned(at, _variables(at), ports, most=most)


@torch.no_grad()
def row_gains(at: Optimum, found: Functions, outcome: Outcome) -> tuple[RowGain, ...]:
    """What functions explain beyond what feedback may hide, by row of a port, the most first."""
    space, system, variables = at.of.space, at.of.vector.system, _variables(at)
    counted = space.chunks.counted
    table = variables.values(at.x[counted], space.chunks.u[counted]).numpy()
    values = {name: table[:, k] for k, name in enumerate(variables.names)}
    moved = moved_channels_of(outcome.final, space.disturbances)
    allowed = allowances_of_tests(outcome.test, outcome.known)
    rows = []
    for port, nats in found.nats.items():
        if outcome.doubted_channels & {*moved[port]}:
            continue
        # the best of many groups wins a few nats beside physics of which nothing is missing: of 30 right answers of the
        # fifth tester five were said to leave up to 7 nats
        sure = nats - _HALF * found.error[port] > outcome.decisions.alike_nats
        if sure and nats > 0.5 * max((allowed.get(name, 0.0) for name in moved[port]), default=0.0):
            name, unit = _row(system, *space.disturbances[port])
            size = float(np.sqrt(np.square(found.force(values, port)[0]).mean()))
            error, importance = found.error[port], found.importance(port)
            rows.append(RowGain(name, unit, port, size, nats, error, importance, frozenset(moved[port])))
    return tuple(sorted(rows, key=lambda r: -r.nats))


def optimum_of(system: System, near: Optimum) -> Optimum:
    """The optimum of a machine on the rows of another one; that itself where it is of the same physics."""
    if near.of.vector.system.effect_names == system.effect_names:
        return near
    return nearly_maximised(near.of.of(system), near)[1]


def _variables(at: Optimum) -> Variables:
    """All that the machine measures; an angle whose sine and cosine are there is not one of them."""
    system, chunks = at.of.vector.system, at.of.space.chunks
    some = machine_variables(system, at.x[0], chunks.u[0], inputs=True)
    names = [n for n in some if not {f"sin_{n}", f"cos_{n}"} <= some.keys()]

    def values(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        known = machine_variables(system, x, u, inputs=True)
        return torch.stack([known[name] for name in names], 1)

    return Variables(tuple(names), values, lambda u: named_inputs(system, u))


def _row(system: System, port: Port, column: int) -> tuple[str, str]:
    """Name and unit of the row of a port."""
    rows = dict(vocabulary(type(system)).ports)[port.value]
    return rows.written(port.value)[column], rows.units[column]


# ---- the ceiling ---------------------------------------------------------------------------------------

_HALF = 1.645  # standard errors of a 90 % interval


@dataclass(frozen=True)
class Ceiling:
    """What functions of all that was measured explain beside the effects."""

    why_not: str = ""  # why nothing was measured; empty where it was
    effects: float = 0.0  # held-out log likelihood of the effects [nats]
    left: float = 0.0  # what the functions bring beside them [nats]
    interval: tuple[float, float] | None = None  # 90 % interval of it
    explained: float | None = None
    """Share of the explainable evidence that the effects have; None without effects."""
    explained_interval: tuple[float, float] | None = None
    """Its 90 % interval; None where there are too few blocks."""
    rows: tuple[RowGain, ...] = ()
    """What is left, by row of a port, the most first; empty where it is no more than chance."""
    functions: Functions | None = None  # None where nothing was measured


def ceiling(log: Log, outcome: Outcome) -> Ceiling:
    """Measure what functions of all that was measured explain beside the effects."""
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
    rows = row_gains(at, found, outcome)
    before, after = found.blocks
    nats = sum(row.nats for row in rows)
    left = (after - before) * (nats / max(float((after - before).sum()), 1e-300) if rows else 0.0)
    out = Ceiling(left=float(left.sum()), rows=rows, functions=found)
    if rows:
        out = replace(out, interval=_ends(out.left, sum_error(left)))
    if not outcome.found:
        return out
    won = before - _declared(outcome, at)
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
    if outcome.doubted and log.budgets.function_groups:
        return "the fit is rejected"
    if not (why := silent(log)) and outcome.final.arithmetic:
        return "what is left is what arithmetic leaves"
    return why


def silent(log: Log) -> str:
    """Why functions say nothing of a log, whatever its physics is; empty where they may."""
    if not log.budgets.function_groups:
        return "not asked for"
    if log.recorded.inputs_restored:
        return "the inputs were logged as an average and know the future"
    if any(run.band for run in log.runs):
        return (
            "the states were smoothed before they were logged, and what that did to them looks like physics"
        )
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
