"""What a diagnosis leaves open, and whether an experiment may close it.

    tied         two laws explain the runs as well, and an input may tell them apart
    leads        what was found only provisionally
    wide         parameters of what was found whose 90 % interval is wider than the parameter is large
    confounded   the same where feedback or smoothing widens the interval, which no further run of the kind changes
    suspected    effects that the runs lean to, by 3 nats or more, and could not show at their usual size
    beyond       ties that no input breaks: an effect and a fault of the recording chain

Experiments ask for the ties one after another, then for the leads and wide parameters together, and then for what is
suspected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nsde_torch.design.experiment import SURE
from nsde_torch.design.questions import MOST, Question, able_ties, confounded, of_parameters, of_ties, wide
from nsde_torch.systems import System

LATE = ("input_delay", "motor_lag", "actuator_lag")
"""Effects that make inputs act late."""


@dataclass(frozen=True)
class Standing:
    """What a diagnosis found, and what it leaves open.

    Args:
        found: Names of the effects that were found.
        tied: Names that cannot be told apart, the one that was found first.
        beyond: The same, where no input tells them apart.
        leads: Effects that are found provisionally.
        wide: Labels of the parameters that are not well known, and that more data would show better.
        confounded: Labels of those that are not well known because feedback or smoothing may have bent them.
        suspected: Effects that were not found, and that the runs lean to.
    """

    found: tuple[str, ...]
    tied: tuple[tuple[str, ...], ...]
    beyond: tuple[tuple[str, ...], ...]
    leads: tuple[str, ...]
    wide: tuple[str, ...]
    confounded: tuple[str, ...]
    suspected: tuple[str, ...]

    @property
    def settled(self) -> bool:
        """Whether there is nothing that an experiment may close."""
        return not (self.tied or self.leads or self.wide or self.suspected)

    def content(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
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
        """One line."""
        said = [f"found: {', '.join(self.found) or 'nothing'}"]
        said += [f"tied: {' or '.join(t)}" for t in self.tied]
        said += [f"tied whatever the input: {' or '.join(t)}" for t in self.beyond]
        if self.leads:
            said.append(f"no more than leads: {', '.join(self.leads)}")
        if self.wide:
            said.append(f"not well known: {', '.join(self.wide)}")
        if self.confounded:
            said.append(f"wide by what feedback may hide: {', '.join(self.confounded)}")
        if self.suspected:
            said.append(f"suspected: {', '.join(self.suspected)}")
        return "; ".join(said)


def standing_of(content: Mapping[str, Any]) -> Standing:
    """What the content of a `diagnosis.json` leaves open."""
    effects = [f for f in content["findings"] if f["kind"] != "recording"]
    found = tuple(f["name"] for f in effects)
    tied, beyond = able_ties(content)
    own = {label: p for label, p in content.get("parameters", {}).items() if label.partition(".")[0] in found}
    leads = tuple(f["name"] for f in effects if f.get("lead"))
    return Standing(found, tied, beyond, leads, tuple(wide(own)), tuple(confounded(own)), suspected(content))


def suspected(content: Mapping[str, Any]) -> tuple[str, ...]:
    """Effects that the last look leans to and that were not found, the likeliest first.

    Only those that the runs could not show at their usual size: of the others the runs have said what they say.
    """
    looks = content.get("ranking", ())
    last = max((r["round"] for r in looks), default=0)
    hidden = {n["effect"] for n in content.get("not_shown", ())}
    leant = {
        r["effect"]: r["evidence_nats"]
        for r in looks
        if r["round"] == last
        and not r["chosen"]
        and r["effect"] in hidden
        and (r.get("evidence_nats") or 0) > SURE
    }
    return tuple(sorted(leant, key=lambda name: -leant[name]))


def open_questions(content: Mapping[str, Any], system: System) -> list[Question]:
    """What experiments are to be asked, the most urgent first: each tie, what is not well known, what is suspected.

    Lateness comes last: controllers that look ahead need to know it least.

    Args:
        content: Content of `diagnosis.json`.
        system: Declared system.
    """
    now = standing_of(content)
    out = of_ties(content)
    # of a lead every parameter is to be known better, and of what is wide the parameter itself
    labels = [label for label in content.get("parameters", {}) if label.partition(".")[0] in now.leads]
    labels = list(dict.fromkeys([*labels, *now.wide]))
    few = now.suspected[:MOST]
    for asked in (
        [label for label in labels if label.partition(".")[0] not in LATE],
        [n["parameter"] for n in content.get("not_shown", ()) if n["effect"] in few],
        [label for label in labels if label.partition(".")[0] in LATE],
    ):
        if asked:
            out.append(of_parameters(system, now.found, asked))
    return out
