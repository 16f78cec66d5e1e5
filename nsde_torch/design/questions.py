"""What an experiment is asked, and what a diagnosis leaves open for it to close.

    tied         two laws explain the runs as well, and an input may distinguish them
    leads        what was found only provisionally
    wide         parameters of found effects whose 90 % interval is wider than the parameter is large
    confounded   the same where feedback or smoothing widens the interval, which no further run of the kind changes
    suspected    effects that the runs favour, by 3 nats or more, and could not show at their usual size
    beyond       ties that no input breaks: an effect and a fault of the recording chain

Experiments ask for the ties one after another, then for the leads and wide parameters together, and then for what is
suspected.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from nsde_torch.design.options import DesignOptions
from nsde_torch.effects import EFFECTS, effect_class
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import AND, split_name
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System

SURE = 3.0  # evidence from which a tie counts as broken: odds of 20 to 1 [nats]
MOST = 3  # effects that are not shown of which an experiment is to show the sizes
_WIDE = 0.5  # half-width of an interval over its value above which a parameter is to be shown


@dataclass(frozen=True)
class Question:
    """What an experiment is asked."""

    members: tuple[tuple[str, ...], ...]
    """Effects of each member beside the declared physics; one where parameters are asked for."""
    parameters: tuple[str, ...] = ()  # labels of the parameters to show; empty where members are
    notes: tuple[str, ...] = ()  # what was left out, in words

    @property
    def kind(self) -> str:
        """`tie`, or `parameters`."""
        return "parameters" if self.parameters else "tie"

    def content(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "members": [list(m) for m in self.members],
            "names": list(self.names),
            "parameters": list(self.parameters),
            "notes": list(self.notes),
        }

    @property
    def names(self) -> tuple[str, ...]:
        """What the members are called: their effects, without those that all have."""
        shared = set.intersection(*(set(m) for m in self.members)) if len(self.members) > 1 else set()
        return tuple(
            AND.join(e for e in m if e not in shared) or "nothing beside what all have" for m in self.members
        )


def question_of(content: Mapping[str, Any], system: System, options: DesignOptions) -> Question:
    """What is asked: what the options say, or the first tie of a diagnosis, or what it does not show.

    A ConfigError where nothing is tied and everything is shown, or the system does not know a name.
    """
    found = _found(content)
    if options.members is not None:
        return Question(tuple(tuple(_known(system, e) for e in member) for member in options.members))
    if options.parameters is not None:
        return of_parameters(system, found, options.parameters)
    ties = of_ties(content)
    if ties:
        return ties[0]
    notes = tie_notes(content)
    lacking = [n["parameter"] for n in content.get("not_shown", ())]
    effects = list(dict.fromkeys(label.partition(".")[0] for label in lacking))[:MOST]
    labels = [label for label in lacking if label.partition(".")[0] in effects]
    if not labels:
        labels = wide({**content.get("parameters", {}), **content.get("declared_parameters", {})})
    if not labels:
        raise ConfigError(
            "the diagnosis ties nothing, and shows every parameter it asks for: there is nothing to plan. Name what "
            "may be true, members=[[EFFECT,...],[EFFECT,...]], or what is to be known better, parameters=[EFFECT.NAME]."
        )
    out = of_parameters(system, found, labels)
    why = "what it leaves open" if not lacking else "what its runs cannot show"
    notes += (f"the diagnosis holds no tie that an input may break: this is a plan for the sizes of {why}",)
    return Question(out.members, out.parameters, notes)


def of_ties(content: Mapping[str, Any]) -> list[Question]:
    """The ties of a diagnosis that inputs may break, as questions."""
    found = _found(content)
    out = []
    for first, *others in able_ties(content)[0]:
        swapped = [tuple(e for f in found for e in (o.split(AND) if f == first else [f])) for o in others]
        out.append(Question((tuple(found), *swapped), notes=tie_notes(content)))
    return out


def able_ties(content: Mapping[str, Any]) -> tuple[tuple[tuple[str, ...], ...], tuple[tuple[str, ...], ...]]:
    """Ties of a diagnosis, each with what was found first: those that inputs may break, and the others."""
    found = _found(content)
    able, beyond = list[tuple[str, ...]](), list[tuple[str, ...]]()
    for tie in content.get("ties", ()):
        first, *others = tie["effects"]
        rivals = [o for o in others if is_effect(o)] if first in found else []
        (able if rivals else beyond).append((first, *(rivals or others)))
    return tuple(able), tuple(beyond)


def tie_notes(content: Mapping[str, Any]) -> tuple[str, ...]:
    """What no input distinguishes, in words, up to the first tie that inputs may break."""
    notes: list[str] = []
    for tie in content.get("ties", ()):
        first, *others = tie["effects"]
        faults = [o for o in others if not is_effect(o)]
        notes += [f"{o} is a fault of the recording chain: no input tells it from {first}" for o in faults]
        if first in _found(content) and len(faults) < len(others):
            break
    return tuple(notes)


def _found(content: Mapping[str, Any]) -> list[str]:
    return [f["name"] for f in content.get("findings", ()) if f["kind"] != "recording"]


def of_parameters(system: System, found: Sequence[str], labels: Sequence[str]) -> Question:
    """How large parameters are, beside what was found."""
    effects = [label.partition(".")[0] for label in labels if "." in label]
    beside = [e for e in dict.fromkeys(effects) if e not in found and e not in system.effect_names]
    return Question(((*found, *(_known(system, e) for e in beside)),), tuple(labels))


def wide(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Labels of the parameters of a diagnosis that are not well known, and that more data would show better.

    The half of an interval is held against the largest value of its vector: a weak motor is well known where the five
    others are nothing within a hundredth. What widens an interval beyond chance (`widened_by`: what feedback and
    smoothing may hide) does not count, because no further run makes it smaller.
    """
    return [label for label, (by_chance, _) in _relative_widths(parameters).items() if by_chance > 2 * _WIDE]


def confounded(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Labels of the parameters that are not well known, and that no further run of the same kind shows better."""
    widths = _relative_widths(parameters)
    return [label for label, (by_chance, whole) in widths.items() if by_chance <= 2 * _WIDE < whole]


def _relative_widths(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Widths of intervals over the largest value of their vector, by chance alone and whole; inf without interval."""
    largest: dict[str, float] = {}
    for label, p in parameters.items():
        vector = label.partition("[")[0]
        largest[vector] = max(largest.get(vector, 0.0), abs(p["value"]))
    out = {}
    for label, p in parameters.items():
        if "." in label and not is_effect(label.partition(".")[0]):
            continue  # what sensors do is known by no input
        size, interval = largest[label.partition("[")[0]], p.get("interval_90")
        if interval is None and p["value"] == 0.0 < size:
            continue  # held at nothing, beside another of its vector that is not
        if interval is None or size == 0.0:
            out[label] = (inf, inf)
            continue
        below, above = p["value"] - interval[0], interval[1] - p["value"]
        by_chance = max(below, above) - p.get("widened_by", 0.0)
        out[label] = ((min(below, by_chance) + min(above, by_chance)) / size, (below + above) / size)
    return out


def is_effect(name: str) -> bool:
    """Whether a name of a tie is physics, and no fault of the recording chain."""
    return all(split_name(e)[0] in EFFECTS or ":" in e or is_law(e) for e in name.split(AND))


def _known(system: System, name: str) -> str:
    try:
        effect_class(key := system.effect_key(name))
    except ConfigError as error:
        raise ConfigError(
            f"{name!r} is no effect that {system.name!r} can have: `nsde effects system={system.name}` lists them."
        ) from error
    return key


# effects that make inputs act late
LATE = (
    "input_delay",
    "motor_lag",
    "actuator_lag",
    "asymmetric_lag",
    "actuator_rate_limit",
    "actuator_resonance",
)


@dataclass(frozen=True)
class Standing:
    """What a diagnosis found, and what it leaves open."""

    found: tuple[str, ...]  # names of the effects that were found
    tied: tuple[tuple[str, ...], ...]  # names that cannot be distinguished, the one that was found first
    beyond: tuple[tuple[str, ...], ...]  # the same, where no input distinguishes them
    leads: tuple[str, ...]  # effects that are found provisionally
    # labels of parameters that are not well known, and that more data would show better
    wide: tuple[str, ...]
    confounded: tuple[str, ...]  # labels of those that feedback or smoothing may have biased
    suspected: tuple[str, ...]  # effects that were not found, and that the runs favour

    @property
    def settled(self) -> bool:
        """Whether there is nothing that an experiment may close."""
        return not (self.tied or self.leads or self.wide or self.suspected)

    def content(self) -> dict[str, Any]:
        return {
            "found": list(self.found),
            "tied": [list(t) for t in self.tied],
            "tied_whatever_the_input": [list(t) for t in self.beyond],
            "leads": list(self.leads),
            "wide": list(self.wide),
            "confounded": list(self.confounded),
            "suspected": list(self.suspected),
            "words": self.words,
        }

    @property
    def words(self) -> str:
        said = [f"found: {', '.join(self.found) or 'nothing'}"]
        said += [f"indistinguishable: {' or '.join(t)}" for t in self.tied]
        said += [f"indistinguishable whatever the input: {' or '.join(t)}" for t in self.beyond]
        lists = {
            "provisional": self.leads,
            "not well known": self.wide,
            "wide by what feedback may hide": self.confounded,
            "suspected": self.suspected,
        }
        return "; ".join([*said, *(f"{what}: {', '.join(names)}" for what, names in lists.items() if names)])


def standing_of(content: Mapping[str, Any]) -> Standing:
    """What the content of a `diagnosis.json` leaves open."""
    effects = [f for f in content["findings"] if f["kind"] != "recording"]
    found = tuple(f["name"] for f in effects)
    tied, beyond = able_ties(content)
    own = {label: p for label, p in content.get("parameters", {}).items() if label.partition(".")[0] in found}
    leads = tuple(f["name"] for f in effects if f.get("lead"))
    return Standing(found, tied, beyond, leads, tuple(wide(own)), tuple(confounded(own)), suspected(content))


def suspected(content: Mapping[str, Any]) -> tuple[str, ...]:
    """Effects that the last look favours and that were not found, the likeliest first.

    Only those that the runs could not show at their usual size: of the others the runs have said what they say.
    """
    looks = content.get("ranking", ())
    last = max((r["round"] for r in looks), default=0)
    hidden = {n["effect"] for n in content.get("not_shown", ())}
    open_ = [r for r in looks if r["round"] == last and not r["chosen"] and r["effect"] in hidden]
    leant = {r["effect"]: r["evidence_nats"] for r in open_ if (r.get("evidence_nats") or 0) > SURE}
    return tuple(sorted(leant, key=lambda name: -leant[name]))


def open_questions(content: Mapping[str, Any], system: System) -> list[Question]:
    """What experiments are to be asked, the most urgent first: each tie, what is not well known, what is suspected.

    Lateness comes last: controllers that look ahead need to know it least.
    """
    now = standing_of(content)
    out = of_ties(content)
    # of a lead every parameter is to be known better; of a wide interval, the parameter itself
    labels = [label for label in content.get("parameters", {}) if label.partition(".")[0] in now.leads]
    labels = list(dict.fromkeys([*labels, *now.wide]))
    late = [label for label in labels if split_name(label.partition(".")[0])[0] in LATE]
    few = now.suspected[:MOST]
    for asked in (
        [label for label in labels if label not in late],
        [n["parameter"] for n in content.get("not_shown", ()) if n["effect"] in few],
        late,
    ):
        if asked:
            out.append(of_parameters(system, now.found, asked))
    return out
