"""Effects that the data could not have shown: absence of evidence that is no evidence of absence.

The screening of a candidate gives the standard error s of its size (one linearised step, noise model of the round).
A size below about 4 s goes unnoticed among tens of candidates at alpha = 0.01; where that is a good part of the
size that such an effect usually has, "not found" says nothing of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.diagnosis.joint_selection import JointSelection
from nsde_torch.effects import effect_class
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name


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
