"""What is left, explained as far as it can be: in words, by a fault of the columns.

A declared parameter may well stand at its bound. It indicates a fault where the data pull beyond: the step
without bounds

    d = argmin |e - X d|

leads out of the bound by several standard errors: a gain of an input that wants to be negative, as of a force that was
logged the wrong way round. Which column it is says the guard (`nsde_torch.sysid.guard`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import log10

import numpy as np

from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.decisions import Decisions
from nsde_torch.diagnosis.feedback_bias import unmeasured_gains
from nsde_torch.diagnosis.outcome import Estimate, Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.residual_tests import PhysicsResiduals
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import ChannelResidual, Shape, channel_residuals, shape
from nsde_torch.diagnosis.text import with_space
from nsde_torch.effects import effect_class
from nsde_torch.evaluation.report import number
from nsde_torch.sysid.guard import Guarded
from nsde_torch.sysid.standstill import moving
from nsde_torch.systems import System

_AT_BOUND = 1e-5  # typical sizes from the bound; values are kept a millionth off it


@dataclass(frozen=True)
class Warned:
    """A declared parameter that indicates a fault."""

    parameter: str  # its name
    kind: str  # `at_bound`, `far_off`, or `not_shown` where it ran off unseen
    sentence: str  # what is odd about it
    remedy: str  # what may be the cause, and what to look at


def declared(outcome: Outcome) -> dict[str, Estimate]:
    """Parameters that the system declared, fitted with everything that was found, by name.

    A gain at nothing that the loop may hide has no interval: it was not measured.
    """
    r = outcome.final
    found = {f.name for f in outcome.found}
    columns = [j for j, label in enumerate(r.vector.labels) if label.partition(".")[0] not in found]
    hidden = unmeasured_gains(outcome)
    return {
        e.name: replace(e, low=None, high=None, bound=None) if e.name in hidden else e
        for e in outcome.estimated(columns)
    }


def warnings(outcome: Outcome, system: System) -> list[Warned]:
    """Declared parameters at a bound that the data pull beyond, and orders of magnitude from their first values."""
    r, decisions = outcome.final, outcome.decisions
    v, basis = r.vector, r.shown.basis
    flat = r.slopes.reshape(-1, len(v))
    pull = basis @ np.linalg.lstsq(flat @ basis, r.white.reshape(-1), rcond=None)[0]
    error = np.sqrt(np.clip(np.diag(basis @ outcome.spread.covariance @ basis.T), 0.0, None))
    firsts: dict[str, float] = {}
    for name, (first_value, _) in system.all_declared().items():
        values = first_value.reshape(-1).tolist()
        firsts |= {name: values[0]} if len(values) == 1 else {f"{name}[{i}]": x for i, x in enumerate(values)}
    remedy = _remedy(system)
    out = []
    for name in declared(outcome):
        j = v.labels.index(name)
        value, unit = float(r.theta[j]), with_space(v.units[j])
        beyond = abs(pull[j]) > max(decisions.bound_errors * error[j], decisions.bound_sizes * v.scale[j])
        for bound, word, outward in ((v.low[j], "lower", pull[j] < 0), (v.high[j], "upper", pull[j] > 0)):
            there = abs(value - bound) <= _AT_BOUND * v.scale[j]
            if there and outward and beyond and not _nothing(name, bound):
                said = (
                    f"{name} stands at its {word} bound, {number(bound)}{unit}: freely, the data would make it about "
                    f"{number(value + pull[j])}{unit}"
                )
                out.append(Warned(name, "at_bound", said, remedy))
                break
        else:
            held = min(abs(value - v.low[j]), abs(value - v.high[j])) <= _AT_BOUND * v.scale[j]
            known = bool(r.shown.known[j])
            # physics that explains all may be of any size
            if not held and (not known or outcome.verdict == "unexplained"):
                first = firsts.get(name, 0.0)
                out += _apart(name, value, first, unit, remedy, known=known, decisions=decisions)
    return out


def _apart(
    name: str, value: float, first: float, unit: str, remedy: str, *, known: bool, decisions: Decisions
) -> list[Warned]:
    """The warning about a value that is orders of magnitude from its first one, or none."""
    powers = abs(log10(value / first)) if value * first > 0 else 0.0
    if powers <= (decisions.far_powers if known else decisions.lost_powers):
        return []
    times = f"{10**powers:.2g} times {'above' if abs(value) > abs(first) else 'below'}"
    ran = "" if known else ", and the data do not show it: it ran off"
    sentence = f"{name} is {number(value)}{unit}, {times} its first value {number(first)}{unit}{ran}"
    kind = "far_off" if known else "not_shown"
    return [Warned(name, kind, sentence, f"right if the machine is like that; otherwise {remedy}")]


def _nothing(label: str, bound: float) -> bool:
    """Whether an effect does nothing at this bound: that there is no friction is no fault."""
    effect, dot, own = label.partition(".")
    return bool(dot) and bound == 0.0 and own.partition("[")[0] in effect_class(effect).null


def _remedy(system: System) -> str:
    inputs = ", ".join(repr(n) for n in system.input_names) or "none"
    return (
        f"check signs, units and order of the inputs ({inputs}), and signs and origins of the states, against what the "
        "system declares; or something that acts is missing from the log"
    )


# ---- all of it -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Explanation:
    """What is left, and what may explain it."""

    channels: list[ChannelResidual]  # residuals before and after
    shapes: tuple[Shape, ...] = ()  # what the residual still depends on, in words
    warned: tuple[Warned, ...] = ()  # declared parameters that indicate a fault of the columns
    guard: Guarded = field(default_factory=Guarded)
    """How the final physics stands beside simple fits, and what speaks against it."""
    # share of the rows that were left out because what has dry friction stands in them
    standstill: float = 0.0
    ceiling: Ceiling = field(default_factory=Ceiling)  # what functions could still explain


def explained(log: Log, search: Search, outcome: Outcome, guard: Guarded, most: Ceiling) -> Explanation:
    """Describe what is left."""
    regression, left = outcome.final, outcome.structured
    attempt = log.stages.attempt

    def shaped() -> tuple[Shape, ...]:
        joint = outcome.joint
        if not left or joint is None:
            return ()
        residuals = PhysicsResiduals(search, joint.final, regression)
        return tuple(
            shape(residuals, d, outcome.rates, tuple(run.name for run in log.runs))
            for d in left[: log.budgets.shapes]
        )

    shapes = attempt("the shape of what is left", shaped, ())
    return Explanation(
        channel_residuals(outcome.declared, regression),
        shapes=shapes,
        warned=attempt("odd declared values", lambda: tuple(warnings(outcome, log.system)), ()),
        guard=guard,
        standstill=moving(log.runs, log.slowest)[1] if log.slowest else 0.0,
        ceiling=most,
    )
