"""What a flown experiment told: the evidence that it brought each member, beside what was expected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nsde_torch.data import Run
from nsde_torch.design.designing import check_runs, members_of
from nsde_torch.design.experiment import SURE
from nsde_torch.design.members import Member
from nsde_torch.design.questions import Question
from nsde_torch.design.rehearsal import fit_all
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.systems import System

STRANGE = 2.0
"""Mean square of what the best member leaves of an experiment, in units of the noise, from which it is another
machine's."""
FAR = 8.0
"""Standard errors that the best member's parameters may be from what the runs before say."""


@dataclass(frozen=True)
class Obtained:
    """What an experiment told.

    Args:
        question: What it was asked.
        members: What may be true, as the runs before the experiment had them.
        nats: Evidence that it brought each member against the best of the others (M,) [nats].
        excess: Mean square of what the best member leaves of it, in units of the noise.
        expected: What was expected where each member is true, as `design.json` has it; empty where nothing was.
    """

    question: Question
    members: tuple[Member, ...]
    nats: tuple[float, ...]
    excess: float
    expected: tuple[Mapping[str, Any], ...] = ()

    @property
    def best(self) -> int:
        """Number of the member that it speaks for."""
        return int(np.argmax(self.nats))

    @property
    def broken(self) -> bool:
        """Whether the tie is broken."""
        return self.nats[self.best] > SURE

    def content(self) -> dict[str, Any]:
        """What `obtained.json` holds."""
        names = self.question.names
        expected = self.expected[self.best]["nats"]["mean"] if self.expected else None
        return {
            "schema": "nsde_torch.obtained/1",
            "question": {"members": [list(m) for m in self.question.members], "names": list(names)},
            "nats": dict(zip(names, self.nats, strict=True)),
            "speaks_for": names[self.best],
            "broken": self.broken,
            "expected_nats": expected,
            "excess": self.excess,
        }

    @property
    def report(self) -> str:
        """What it told, in words."""
        content = self.content()
        name, nats = content["speaks_for"], self.nats[self.best]
        said = (
            f"the experiment speaks for {name}: {nats:.1f} nats against what else may be true"
            if self.broken
            else f"still tied: {nats:.1f} nats for {name}, where {SURE:g} would break the tie"
        )
        if content["expected_nats"] is not None:
            said += f" ({content['expected_nats']:.1f} were expected)"
        return said


def obtained(
    system: System,
    runs: Sequence[Run],
    flown: Sequence[Run],
    question: Question,
    *,
    clock: float = 1.0,
    values: Mapping[str, Any] | None = None,
    expected: Sequence[Mapping[str, Any]] = (),
) -> Obtained:
    """What an experiment told.

    Args:
        system: Declared system.
        runs: The runs there were before.
        flown: The experiment.
        question: What it was asked.
        clock: Physical seconds per logged second.
        values: First values of effects.
        expected: What was expected (`design.json`).

    Raises:
        DataError: the log is not of this machine.
        ConfigError: the question is not between members.
    """
    if len(question.members) < 2:
        raise ConfigError(
            "a flown experiment is read where members were tied; where parameters were asked for, run `nsde diagnose` "
            "with it among the runs."
        )
    check_runs(system, [*runs, *flown])
    members = members_of(system, runs, question, values or {}, clock=clock)
    each = fit_all(system, members, flown, clock=clock)
    for log, fit in zip(flown, each, strict=True):
        if fit.excess > STRANGE or fit.moved > FAR:
            raise DataError(
                f"{log.source or log.name} is not of this machine, or the machine has changed: where it is explained "
                f"best, parameters are {fit.moved:.1f} standard errors from the runs before, and {fit.excess**0.5:.1f} "
                "times the noise is left. Look whether columns, units and payload are those of the diagnosis."
            )
    excess = max(f.excess for f in each)
    nats = [sum(f.against(i) for f in each) for i in range(len(members))]
    return Obtained(question, tuple(members), tuple(nats), excess, tuple(expected))
