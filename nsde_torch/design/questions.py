"""What an experiment is asked: which of several members is true, or how large parameters are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nsde_torch.design.options import DesignOptions
from nsde_torch.effects import EFFECTS, effect_class
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import AND, split_name
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System

_MOST = 3
"""Effects that are not shown of which an experiment is to show the sizes."""
_WIDE = 0.5
"""Half-width of an interval over its value above which a parameter is to be shown."""


@dataclass(frozen=True)
class Question:
    """What an experiment is asked.

    Args:
        members: Effects of each member beside the declared physics; one where parameters are asked for.
        parameters: Labels of the parameters to show; empty where members are.
        notes: What was left out, in words.
    """

    members: tuple[tuple[str, ...], ...]
    parameters: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """What the members are called: their effects, without those that all have."""
        shared = set.intersection(*(set(m) for m in self.members)) if len(self.members) > 1 else set()
        return tuple(
            AND.join(e for e in m if e not in shared) or "nothing beside what all have" for m in self.members
        )


def question_of(content: Mapping[str, Any], system: System, options: DesignOptions) -> Question:
    """What is asked: what the options say, or the first tie of a diagnosis, or what it does not show.

    Args:
        content: Content of `diagnosis.json`; empty without a diagnosis.
        system: Declared system.
        options: Settings.

    Raises:
        ConfigError: nothing is tied and everything is shown, or a name that the system does not know.
    """
    found = [f["name"] for f in content.get("findings", ()) if f["kind"] != "recording"]
    if options.members is not None:
        return Question(tuple(tuple(_known(system, e) for e in member) for member in options.members))
    if options.parameters is not None:
        return _of_parameters(system, found, options.parameters)
    notes: list[str] = []
    for tie in content.get("ties", ()):
        first, *others = tie["effects"]
        able = [o for o in others if _is_effect(o)]
        notes += [
            f"{o} is a fault of the recording chain: no input tells it from {first}"
            for o in others
            if o not in able
        ]
        if first in found and able:
            swapped = [tuple(e for f in found for e in (o.split(AND) if f == first else [f])) for o in able]
            return Question((tuple(found), *swapped), notes=tuple(notes))
    lacking = [n["parameter"] for n in content.get("not_shown", ())]
    effects = list(dict.fromkeys(label.partition(".")[0] for label in lacking))[:_MOST]
    labels = [label for label in lacking if label.partition(".")[0] in effects]
    if not labels:
        both = {**content.get("parameters", {}), **content.get("declared_parameters", {})}
        labels = [name for name, p in both.items() if _is_wide(p) and name.partition(".")[0] not in notes]
    if not labels:
        raise ConfigError(
            "the diagnosis ties nothing, and shows every parameter it asks for: there is nothing to plan. Name what "
            "may be true, members=[[EFFECT,...],[EFFECT,...]], or what is to be known better, parameters=[EFFECT.NAME]."
        )
    out = _of_parameters(system, found, labels)
    return Question(out.members, out.parameters, tuple(notes))


def _of_parameters(system: System, found: Sequence[str], labels: Sequence[str]) -> Question:
    effects = [label.partition(".")[0] for label in labels if "." in label]
    beside = [e for e in dict.fromkeys(effects) if e not in found and e not in system.effect_names]
    return Question(((*found, *(_known(system, e) for e in beside)),), tuple(labels))


def _is_wide(p: Mapping[str, Any]) -> bool:
    if p.get("interval_90") is None:
        return True
    low, high = p["interval_90"]
    return bool(high - low > 2 * _WIDE * abs(p["value"]))


def _is_effect(name: str) -> bool:
    return all(split_name(e)[0] in EFFECTS or ":" in e or is_law(e) for e in name.split(AND))


def _known(system: System, name: str) -> str:
    try:
        effect_class(system.effect_key(name))
    except (KeyError, ConfigError) as error:
        raise ConfigError(
            f"{name!r} is no effect that {system.name!r} can have: `nsde effects system={system.name}` lists them."
        ) from error
    return system.effect_key(name)
