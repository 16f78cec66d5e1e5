"""The evidence of a flown experiment, beside what was expected.

Between members it is the evidence that the experiment brought each. Of parameters it is how much smaller their standard
errors became: ln(before / after) nats of each, the information gained about a number with normal errors (Lindley, On a
measure of the information provided by an experiment, Annals of Mathematical Statistics 27 (1956)).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.design.designing import check_runs
from nsde_torch.design.experiment import LEVELS
from nsde_torch.design.members import Member, members_of
from nsde_torch.design.questions import SURE, Question
from nsde_torch.design.rehearsal import Fits, against, density, fit_all
from nsde_torch.errors import DataError
from nsde_torch.systems import System
from nsde_torch.texts import rendered

STRANGE = 2.0
"""Mean square of the best member's residual of an experiment, in units of the noise, from which it is another
machine's."""
FAR = 8.0  # standard errors that the best member's parameters may be from what the runs before say


@dataclass(frozen=True)
class KnownBetter:
    """A parameter that an experiment was to show."""

    value: float  # with the experiment
    before: float  # standard error before it
    after: float  # standard error with it
    expected: float | None  # what was expected of that; None where nothing was
    unit: str  # of all

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        said = f"{self.value:.3g} +- {self.after:.2g}{unit} (standard error), {self.before:.2g} before"
        return said if self.expected is None else f"{said}, {self.expected:.2g} expected"

    def content(self) -> dict[str, Any]:
        """Plain containers, for JSON, with the information that was gained, and was to be gained [nats]."""
        return {
            "value": self.value,
            "unit": self.unit,
            "standard_error_before": self.before,
            "standard_error": self.after,
            "expected_standard_error": self.expected,
            "nats": float(np.log(self.before / self.after)),
            "expected_nats": None if self.expected is None else float(np.log(self.before / self.expected)),
        }


@dataclass(frozen=True)
class Obtained:
    """The evidence of an experiment."""

    question: Question  # what it was asked
    members: tuple[Member, ...]  # what may be true, as the runs before the experiment had them
    nats: tuple[float, ...]  # evidence that it brought each against the best of the others; of parameters 0
    excess: float  # mean square of the best member's residual, in units of the noise
    expected: tuple[Mapping[str, Any], ...] = ()
    """What was expected where each member is true, as `design.json` has it; empty where nothing was."""
    parameters: Mapping[str, KnownBetter] = field(default_factory=dict)
    """Those that were asked for, by label; empty where members were."""
    doubt: str | None = None  # why no member explains it; None where one does

    @property
    def best(self) -> int:
        """Number of the member that it speaks for."""
        return int(np.argmax(self.nats))

    @property
    def broken(self) -> bool:
        """Whether the tie is broken."""
        return self.nats[self.best] > SURE

    @property
    def expected_nats(self) -> Mapping[str, float] | None:
        """Evidence that was expected where the member that it speaks for is true (`PlannedRun.nats`)."""
        return self.expected[self.best]["nats"] if self.expected and not self.parameters else None

    @property
    def surprise(self) -> str | None:
        """That it brought far less or more than was expected, in words; None where it did not."""
        planned, nats = self.expected_nats, self.nats[self.best]
        # plans of older versions lack the range
        if planned is None or f"low_{LEVELS[-1]}" not in planned:
            return None
        low, high = planned[f"low_{LEVELS[-1]}"], planned[f"high_{LEVELS[-1]}"]
        if low <= nats <= high:
            return None
        return (
            f"{nats:.1f} nats are far {'less' if nats < low else 'more'} than what was expected ({low:.1f} to "
            f"{high:.1f} in {LEVELS[-1]} %): the flight, the noise or the machine were not as in the runs before, or "
            "none of what was thought possible is true. Look at the log, and run `nsde diagnose` with it among the runs"
        )

    def content(self) -> dict[str, Any]:
        """What `obtained.json` holds."""
        q, names, expected = self.question, self.question.names, self.expected_nats
        if self.parameters:
            each = {label: p.content() for label, p in self.parameters.items()}
            known = [p["expected_nats"] for p in each.values()]
            own: dict[str, Any] = {
                "question": {"kind": "parameters", "parameters": list(q.parameters)},
                "parameters": each,
                "nats": sum(p["nats"] for p in each.values()),
                "expected_nats": None if None in known else sum(known),
            }
        else:
            own = {
                "question": {"kind": "tie", "members": [*map(list, q.members)], "names": list(names)},
                "nats": dict(zip(names, self.nats, strict=True)),
                "speaks_for": names[self.best],
                "broken": self.broken,
                "expected_nats": None if expected is None else expected["mean"],
                "expected_90": None if expected is None else [expected["low_90"], expected["high_90"]],
                "surprise": self.surprise,
            }
        return {"schema": "nsde_torch.obtained/1", **own, "excess": self.excess, "doubt": self.doubt}

    @property
    def report(self) -> str:
        return rendered(__file__, "obtained.txt", o=self, sure=SURE)


def obtained(
    system: System,
    runs: Sequence[Run],
    flown: Sequence[Run],
    question: Question,
    *,
    clock: float = 1.0,
    values: Mapping[str, Any] | None = None,
    expected: Sequence[Mapping[str, Any]] = (),
    trusted: bool = False,
) -> Obtained:
    """The evidence of an experiment.

    Args:
        clock: Physical seconds per logged second.
        values: First values of effects.
        expected: What was expected (`design.json`).
        trusted: Whether the log is known to be of this machine: what no member explains is reported (`doubt`), not
            refused, by a DataError.
    """
    check_runs(system, [*runs, *flown])
    members = members_of(system, runs, question, values or {}, clock=clock)
    each = fit_all(members, flown)
    doubts = [
        f"no member explains {log.source or log.name}: where one explains it best, parameters are {fit.moved:.1f} "
        f"standard errors from the runs before, and {fit.excess**0.5:.1f} times the noise is left"
        for log, fit in zip(flown, each, strict=True)
        if fit.excess > STRANGE or fit.moved > FAR
    ]
    if doubts and not trusted:
        raise DataError(
            f"{doubts[0]}. It is not of this machine, or the machine has changed (look whether columns, units and "
            "payload are those of the diagnosis), or something else is true: `nsde diagnose` with it among the runs "
            "names a run of another machine, and else finds what explains them all."
        )
    excess, doubt = max(f.excess for f in each), next(iter(doubts), None)
    brought = evidence(system, members, each, runs, flown, question, values or {}, clock=clock)
    nats = tuple(against(brought, i) for i in range(len(members)))
    asked = _parameters(members[0], question, each, expected) if question.parameters else {}
    return Obtained(question, tuple(members), nats, excess, tuple(expected), asked, doubt)


def evidence(
    system: System,
    members: Sequence[Member],
    each: Sequence[Fits],
    runs: Sequence[Run],
    flown: Sequence[Run],
    question: Question,
    values: Mapping[str, Any],
    *,
    clock: float,
) -> Array:
    """Logarithm of the density that the experiments had under each member (M,) [nats].

    What gentle flights say of parameters is no quadratic: a wind is known as its product with a drag. So members
    that fly are fitted to all runs together, once before and once with the experiments.
    """
    if system.quaternion is None or len(members) == 1:
        return np.sum([f.brought for f in each], axis=0)
    named = [replace(run, name=f"experiment_{i}") for i, run in enumerate(flown)]
    after = members_of(system, [*runs, *named], question, values, clock=clock, noise=members[0].noise)
    return np.array([density(b.nats - a.nats, a.known, b.known) for a, b in zip(members, after, strict=True)])


def _parameters(
    member: Member, question: Question, each: Sequence[Fits], expected: Sequence[Mapping[str, Any]]
) -> dict[str, KnownBetter]:
    """What was asked for, before and after; of several experiments by the sum of what each adds to 1 / error^2."""
    v, before = member.vector, np.sqrt(np.diag(member.covariance))
    planned = expected[0]["parameters"] if expected else {}
    weight = np.sum([1.0 / np.square(f.errors[0]) for f in each], axis=0)
    weight -= (len(each) - 1) / np.square(before)
    after = 1.0 / np.sqrt(np.maximum(weight, 1e-6 / np.square(before)))
    value = np.mean([f.thetas[0] for f in each], axis=0)
    out = {}
    for i, label in enumerate(v.labels):
        if any(label == asked or label.startswith(f"{asked}[") for asked in question.parameters):
            error = planned.get(label, {}).get("expected_standard_error")
            out[label] = KnownBetter(float(value[i]), float(before[i]), float(after[i]), error, v.units[i])
    return out
