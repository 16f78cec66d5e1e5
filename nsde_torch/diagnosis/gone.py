"""Effects selected from gains that have not gone to nothing.

In a closed loop inputs cancel what the physics lacks. Where they cancel nearly all of it (a moment of the blades that
grows with the speed, a trim that follows the battery), what they do is seen in the fast band alone; and where a lag is
lacking too, not even there. Then the likelihood has two optima. In the one gains are nothing and the noise explains
what is left, and no effect alone leads out of it: without gains a lag does nothing, and a moment explains nothing.
In the other one gains are there, and one or two effects besides. So, where a declared parameter is a small part of its
first value (`GONE` of the guard), effects are selected once more with such parameters held at their first values. A
first value is only roughly that of the machine, and each effect that is added beside it takes up what the value lacks.
So the likeliest candidates of each round are compared with the parameters freed beside them. Those that go again where
others stay are held: these data do not show them, and their first values are no estimates. The first physics in which
one stays, and whose held-out log-likelihood is surely above that of the declared physics, is what the selection goes on
from; else effects are selected as ever.
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass

from nsde_torch.diagnosis.evidence import sum_error
from nsde_torch.diagnosis.fitted import fitted_system
from nsde_torch.diagnosis.outcome import undecided
from nsde_torch.diagnosis.rounds import Round, look
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection, choice, forward_selection
from nsde_torch.diagnosis.trials import Trial, accept
from nsde_torch.sysid.guard import GONE
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

DEPTH = 3
"""Effects that are added with parameters held: beyond, what was added explains the values that they are held at."""
FREED = 3
"""Candidates of a round beside which parameters are freed, the likeliest first."""


def select(search: Search, system: System) -> Selection:
    """Effects that the declared physics lacks, selected from parameters that are there.

    Args:
        search: Data and settings.
        system: Declared physics with its first values.
    """
    declared = search.base(system)
    search.so_far(undecided(search, declared, declared))
    vector = ParameterVector(system)
    first = {k: v for k, v in zip(vector.labels, vector.start.tolist(), strict=True) if "." not in k}
    gone = _gone(declared.regression, first)
    out = _from_first_values(search, declared, system, first, gone) if gone else None
    return forward_selection(search, declared) if out is None else out


def _gone(regression: Regression, first: Mapping[str, float]) -> set[str]:
    """Declared parameters that are a small part of their first values; those of effects may well be nothing."""
    now = dict(zip(regression.vector.labels, regression.theta.tolist(), strict=True))
    return {label for label, value in first.items() if GONE * abs(now[label]) < abs(value)}


def _from_first_values(
    search: Search, declared: Base, system: System, first: Mapping[str, float], gone: set[str]
) -> Selection | None:
    """What is selected from parameters held at their first values; None where none of them comes to stay."""
    held = copy.copy(search)
    held.held = search.held | gone
    base = held.base(system)
    rounds: list[Round] = []
    for _ in range(min(DEPTH, search.decisions.most_effects)):
        now = look(held, base, called=f"round {len(rounds) + 1}, gains held")
        there = set(base.system.effect_names) - set(declared.system.effect_names)
        if choice(held, now.trials, sorted(there)) is None:
            return None
        likeliest = [trial for trial in now.trials if accept(held, trial)][:FREED]
        freed = [_freed(held, trial, first, gone) for trial in likeliest]
        best = max(freed, key=lambda one: (one.stays, one.nats))
        rounds.append(now)
        now.chosen = best.trial
        held.held = held.held | set(best.trial.held)
        if best.stays and _surely_above(search, best.final, declared):
            names = [n for n in best.final.system.effect_names if n not in declared.system.effect_names]
            search.held = best.held
            return forward_selection(
                search, declared, after=Selection(declared, best.final, names, rounds, ())
            )
        base = held.grown(best.trial.regression)
    return None


@dataclass(frozen=True)
class _Freed:
    """A candidate beside which what had gone is free."""

    trial: Trial  # the candidate, with what had gone held
    final: Base  # the physics with it, fitted
    held: set[str]  # labels of parameters that are held still
    stays: bool  # whether one that had gone stays

    @property
    def nats(self) -> float:
        """Held-out log-likelihood."""
        return float(self.final.score.blocks.sum())


def _freed(held: Search, trial: Trial, first: Mapping[str, float], gone: set[str]) -> _Freed:
    """The physics of a candidate with what had gone free.

    A parameter that goes again where others stay is held: beside this physics, too, the data do not show it.
    """
    free = copy.copy(held)
    free.held = {*held.held, *trial.held} - gone
    start = fitted_system(trial.regression)
    final = free.base(start, warm=True, like=trial.regression)
    again = gone & _gone(final.regression, first)
    if again and again < gone:
        free.held = free.held | again
        final = free.base(start, warm=True, like=trial.regression)
        again |= gone & _gone(final.regression, first)
    return _Freed(trial, final, free.held, again < gone)


def _surely_above(search: Search, final: Base, declared: Base) -> bool:
    difference = final.score.blocks - declared.score.blocks
    return float(difference.sum()) > search.decisions.alike_errors * sum_error(difference)
