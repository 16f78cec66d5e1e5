"""How much each effect that was found matters: the error on runs left out that returns when it is left out.

Everything that was found is fitted to the other runs with the effect and, all parameters again, without it
(`cross_validation`). The gain of the effect is, over the channels that it moves,

    g = max(log p(with) - log p(without), 0)                 where inputs are what acted: log-likelihood of each step
    g = max(sum_c log(rms_without_c^2 / rms_with_c^2), 0)    where they were restored from an average, and know the
                                                             future: residual force and moment alone

and its share is g over the sum of all g. Of two that can stand in for each other neither brings much. The few that
matter are the first that together reach `Wording.few_share`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log
from typing import Any

from nsde_torch.diagnosis.cross_validation import Own
from nsde_torch.diagnosis.decisions import Wording

BY_STEPS, BY_RESIDUAL = "log-likelihood", "residual"  # what effects are ordered by


@dataclass(frozen=True)
class Importance:
    """What one effect brings on runs left out."""

    effect: str  # its name
    gain: float  # g [nats], by which effects are ordered
    share: float  # g over the sum of g of all effects; 0 where no effect brings anything
    nats: float  # gain in log-likelihood of one-step predictions, on the channels that it moves
    channel: str = ""
    """The channel in which most returns without it; empty where no stretch is long enough to say."""
    unit: str = ""  # of the residual of that channel
    error_with: float | None = None
    # error_with, error_without: root mean square of its mean residual rates over a quarter of a second [unit]
    error_without: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        return {
            "nats": self.nats,
            "share": self.share,
            "channel": self.channel or None,
            "unit": self.unit or None,
            "error_with": self.error_with,
            "error_without": self.error_without,
        }


def effect_importance(own: Mapping[str, Own], *, inputs: bool) -> dict[str, Importance]:
    """How much effects matter, the most important first.

    `inputs` says whether the inputs are what acted, and not restored from an average.
    """
    gains = {name: _gain(one, inputs=inputs) for name, one in own.items()}
    whole = sum(gains.values())
    out = {}
    for name in sorted(own, key=lambda n: -gains[n]):
        one = own[name]
        share = gains[name] / whole if whole > 0 else 0.0
        if not one.residual:
            out[name] = Importance(name, gains[name], share, one.nats)
            continue
        channel = max(one.residual, key=lambda c: _returns(one, c))
        unit, without, with_it = one.residual[channel]
        out[name] = Importance(name, gains[name], share, one.nats, channel, unit, with_it, without)
    return out


@dataclass(frozen=True)
class ShownEffects:
    """The order in which effects are shown."""

    few: tuple[str, ...]  # names of those that matter, the most important first
    rest: tuple[str, ...]  # names of the others
    share: float  # what the others bring together, of what all bring


def shown_effects(
    names: Sequence[str], importance: Mapping[str, Importance], wording: Wording
) -> ShownEffects:
    """The effects that matter, and the others.

    An effect of which runs left out say nothing matters, and so do all where none brings anything.
    """
    order = sorted(names, key=lambda n: -importance[n].gain if n in importance else 0.0)
    few, rest, reached = list[str](), list[str](), 0.0
    for name in order:
        if name in importance and reached >= wording.few_share:
            rest.append(name)
            continue
        few.append(name)
        reached += importance[name].share if name in importance else 0.0
    return ShownEffects(tuple(few), tuple(rest), sum(importance[n].share for n in rest))


def _gain(one: Own, *, inputs: bool) -> float:
    if inputs or not one.residual:
        return max(one.nats, 0.0)
    return max(sum(_returns(one, channel) for channel in one.residual), 0.0)


def _returns(one: Own, channel: str) -> float:
    """Log of the residual power of a channel without the effect, over that with it."""
    _, without, with_it = one.residual[channel]
    return 2.0 * log(max(without, 1e-300) / max(with_it, 1e-300))
