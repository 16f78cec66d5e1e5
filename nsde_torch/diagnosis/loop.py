"""Look, add, look again: the loop from a declared model to one whose residual is noise, and what it concludes.

An effect that was added first may have stood in for two that came later: at the end each is left out in turn, dropped
if it is no longer needed, and compared with every other candidate in its place. Candidates whose evidence differs
from the chosen one's by less than two standard errors are a tie.

A time shorter than a step of the log (inputs that act a millisecond late) is nothing that data can name, but left out
it makes other effects look likely. Where it explains more than any of them, it joins what is declared.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.estimates import Estimate, by_instruments, estimated
from nsde_torch.diagnosis.evidence import gained_by_channel
from nsde_torch.diagnosis.hidden import Hidden, allowances, chance_beyond
from nsde_torch.diagnosis.regressors import Regressors, regressors
from nsde_torch.diagnosis.search import (
    Base,
    Round,
    Search,
    Trial,
    effect_of,
    fitted_system,
    moved_channels,
    surely_above,
)
from nsde_torch.diagnosis.specification import dependences
from nsde_torch.effects import effect_class
from nsde_torch.errors import NsdeError
from nsde_torch.learning.identify.identify import Regression
from nsde_torch.learning.identify.in_loop import hidden_bias, largest_bias
from nsde_torch.learning.identify.loop_test import LoopTest
from nsde_torch.learning.identify.result import Identification
from nsde_torch.learning.identify.spread import Spread
from nsde_torch.systems import System

Array = NDArray[np.float64]
Verdict = Literal["no_effect", "effect_found", "unexplained"]

_NOTHING = 0.03  # of the structure that is left over: effects that explain less are no leads either
_LEAD = 0.1  # of what the effects explain of the channels of one: structure there beyond that makes it a lead
_FEWER = 2.0  # nats by which two effects must be better than one that stands in for both


@dataclass(frozen=True)
class Found:
    """An effect that was added.

    Args:
        name: Of the effect.
        trial: Its fit, with all other effects that were added present.
        ties: Effects that explain the data as well in its place.
        moves: Names of the channels that its parameters move.
        lead: Why it is a lead (provisional) and not the last word; empty where it is.
    """

    name: str
    trial: Trial
    ties: tuple[str, ...]
    moves: tuple[str, ...] = ()
    lead: str = ""


@dataclass
class Outcome:
    """What the loop concluded.

    Args:
        verdict: `no_effect`, `effect_found` or `unexplained`.
        declared: The declared physics, fitted.
        final: The physics with everything that was added, fitted.
        found: Effects, in the order in which they were added.
        rounds: Every look at the catalogue.
        declared_variables, variables: What the residuals without and with the effects may depend on.
        before, after: What the residual depends on without and with the effects, all tests.
        structured: The tests that are left over after correction for their number, what explains most first.
        aside: Effects that joined what is declared because they are shorter than a step.
        hidden: Effects that are not named because feedback may have made them.
        test: What the data say of the loop that they were recorded in, by `final`.
        printed: Estimates by signals from outside the loop, where these are the ones to print.
    """

    verdict: Verdict
    declared: Base
    final: Base
    found: list[Found]
    rounds: list[Round]
    declared_variables: Regressors
    variables: Regressors
    before: list[Dependence]
    after: list[Dependence]
    structured: list[Dependence] = field(default_factory=list)
    aside: tuple[str, ...] = ()
    hidden: tuple[Hidden, ...] = ()
    test: LoopTest = field(default_factory=LoopTest)
    printed: Identification | None = None

    @cached_property
    def system(self) -> System:
        """The physics with everything that was added and its values."""
        out = fitted_system(self.final.regression)
        if self.printed is not None:
            self.printed.vector.write(out, self.printed.values)
        return out

    @cached_property
    def declared_system(self) -> System:
        """The declared physics and its fitted values; `system` where nothing was added."""
        return fitted_system(self.declared.regression) if self.found else self.system

    def without(self, effect: str) -> System:
        """The physics with everything that was added but one effect; the declared physics where that is all."""
        if len(self.found) == 1:
            return self.declared_system
        return _without(self.system, self.declared.system, effect)

    def estimates(self, effect: str) -> list[Estimate]:
        """Parameters of an effect that was added or joined what is declared, all others fitted with it."""
        return self.estimated(self.final.regression.vector.of(effect))

    def estimated(self, columns: Sequence[int]) -> list[Estimate]:
        """Parameters of `final` with 90 % intervals, which feedback widens where it may hide something.

        Args:
            columns: Numbers of the parameters.
        """
        if self.printed is None:
            return estimated(self.final.regression, self.sure, columns, self.doubt)
        return by_instruments(self.printed, [self.final.regression.vector.labels[j] for j in columns])

    @cached_property
    def doubt(self) -> Array:
        """By how much feedback may have bent each parameter of `final` (k,); nan for by anything.

        Effects that were found are bent by what was made from other sensors alone, as in `hidden.allowances`.
        """
        r, found = self.final.regression, {f.name for f in self.found}
        of_effects = np.array([label.partition(".")[0] in found for label in r.vector.labels], dtype=bool)
        return np.where(of_effects, largest_bias(r, self.test.hidden_by_sensors), hidden_bias(r, self.test))

    @cached_property
    def sure(self) -> Spread:
        """Covariance of the parameters of `final`."""
        return self.final.regression.spread()


def loop(
    search: Search,
    system: System,
    *,
    max_effects: int,
    test: Callable[[Regression], LoopTest] = lambda regression: LoopTest(),
    shown: Callable[[System, str], bool] = lambda system, effect: False,
) -> Outcome:
    """Add effects until none helps.

    Args:
        search: Data and settings.
        system: Declared physics.
        max_effects: Most effects to add.
        test: Tests the loop by a regression that has settled.
        shown: Whether signals from outside the loop show an effect of a system with fitted values.
    """
    search.say("fitting the declared physics", 0, 1)
    declared = base = search.base(system)
    rounds: list[Round] = []
    names: list[str] = []
    aside: list[str] = []
    lent: set[str] = set()
    while len(names) < max_effects:
        now = search.look(base)
        short = search.fraction(now.trials)
        if short is not None:
            aside.append(short.name)
            base = search.grown(short)
            with_it = declared.system.with_effects(effect_of(base.system, short.name))
            declared = search.base(with_it, warm=True, like=declared.regression) if names else base
            continue
        chosen = choice(search, now.trials, names)
        if chosen is not None and chosen.name not in lent:
            lent.add(chosen.name)
            better = _lent(search, base, chosen, names)
            if better is not None:
                base = better
                continue
        rounds.append(now)
        now.chosen = chosen
        if now.chosen is None:
            break
        replaced = effect_class(now.chosen.name).includes
        names = [*(n for n in names if n not in replaced), now.chosen.name]
        search.held |= set(now.chosen.held)
        base = search.grown(now.chosen)
    found, base = _settle(search, declared, base, names, rounds)
    found, base, hidden, tested = _told_apart(search, declared, base, found, rounds, test, shown)
    declared_variables = regressors(declared.regression, inputs=search.inputs, moved=search.moved)
    before = dependences(declared.regression, declared_variables, overview=bool(found))
    variables = (
        regressors(base.regression, inputs=search.inputs, moved=search.moved) if found else declared_variables
    )
    after = dependences(base.regression, variables) if found else before
    left = _beyond_chance(search, after, allowances(tested))
    explained = 2.0 * (base.score.fitted - declared.score.fitted)
    rest = max((d.gain - d.functions for d in left), default=0.0)
    if (
        found and explained < _NOTHING * rest
    ):  # what is missing bends the physics, and any term straightens it a little
        before = dependences(declared.regression, declared_variables)
        found, base, variables, after = [], declared, declared_variables, before
        tested = test(base.regression)
        left = _beyond_chance(search, before, allowances(tested))
    if not found:
        verdict: Verdict = "unexplained" if left else "no_effect"
    else:
        verdict = "unexplained" if rest > explained else "effect_found"
    gained = gained_by_channel(declared.regression, base.regression)
    found = [replace(f, moves=moved_channels(base.regression, f.name)) for f in found]
    found = [replace(f, lead=_lead(f, found, left, gained)) for f in found]
    tests = (declared_variables, variables, before, after, left)
    return Outcome(
        verdict, declared, base, found, rounds, *tests, aside=tuple(aside), hidden=tuple(hidden), test=tested
    )


def _told_apart(
    search: Search,
    declared: Base,
    base: Base,
    found: list[Found],
    rounds: list[Round],
    test: Callable[[Regression], LoopTest],
    shown: Callable[[System, str], bool],
) -> tuple[list[Found], Base, list[Hidden], LoopTest]:
    """Effects that explain more than feedback may hide, the physics with them, the others, and the test by it."""
    hidden: list[Hidden] = []
    tested = test(base.regression)
    while found:
        allowed = allowances(tested)
        weakest: tuple[float, Found, Base, tuple[str, ...]] | None = None
        for f in found if allowed else ():
            moved = moved_channels(base.regression, f.name)
            if not set(moved) & set(allowed):
                continue
            rest = _without(fitted_system(base.regression), declared.system, f.name)
            without = declared if len(found) == 1 else search.base(rest, warm=True, like=base.regression)
            count = len(base.regression.vector.of(f.name))
            gained = gained_by_channel(without.regression, base.regression)
            chance = chance_beyond(gained, moved, allowed, count) * max(len(rounds[0].screened), 1)
            if chance >= search.alpha and (weakest is None or chance > weakest[0]):
                weakest = (chance, f, without, tuple(c for c in moved if c in allowed))
        if weakest is None or shown(fitted_system(base.regression), weakest[1].name):
            break
        _, f, base, channels = weakest
        hidden.append(Hidden(f.name, channels))
        found = [g for g in found if g is not f]
        tested = test(base.regression)
    return found, base, hidden, tested


def _beyond_chance(
    search: Search, tests: Sequence[Dependence], allowed: Mapping[str, float]
) -> list[Dependence]:
    """Tests that find something after correction for their number, what explains most first.

    Args:
        search: Settings.
        tests: All tests.
        allowed: Twice the log-likelihood that feedback may hide, by channel (`hidden`).
    """
    sure = (
        d
        for d in tests
        if d.p * len(tests) < search.alpha and d.gain - d.functions > allowed.get(d.channel, 0.0)
    )
    return sorted(sure, key=lambda d: d.functions - d.gain)


def _lent(search: Search, base: Base, chosen: Trial, names: Sequence[str]) -> Base | None:
    """The physics whose effects, which `chosen` contains, are fitted from its shapes; None if that is no better.

    What contains an effect may seem better only because the effect was stuck beside its own optimum.
    """
    best = base
    for name in effect_class(chosen.name).includes:
        if name in names:
            other = search.reshaped(base, name, chosen)
            if other.score.fitted > best.score.fitted + _FEWER:
                best = other
    return None if best is base else best


def _lead(f: Found, found: Sequence[Found], left: Sequence[Dependence], gained: Mapping[str, float]) -> str:
    """Why an effect is only a lead: structure is left where it acts, or two laws of one variable were needed.

    Args:
        f: The effect.
        found: All effects that were added.
        left: What the residual still depends on.
        gained: Twice the log-likelihood that the effects brought, by channel.
    """
    rest = max((d.gain - d.functions for d in left if d.channel in f.moves), default=0.0)
    if rest > _LEAD * sum(gained[name] for name in f.moves):
        return "something else is there too"
    own = effect_class(f.name)
    others = [effect_class(g.name) for g in found if g.name != f.name]
    if own.along and any((o.along, o.port) == (own.along, own.port) for o in others):
        return f"two laws of the same {own.along} may stand for one that the catalogue lacks"
    return ""


def choice(search: Search, trials: Sequence[Trial], added: Sequence[str]) -> Trial | None:
    """The likeliest candidate; of one that contains a simpler one that is there too, the simpler.

    What contains it has to be better than it together with any other in the next round.
    """
    accepted = [t for t in trials if search.accept(t)]
    if not accepted:
        return None
    best = accepted[0]
    simpler = [t for t in accepted if t.name in effect_class(best.name).includes]
    if simpler:
        return simpler[0]
    # one effect in the place of another explains with fewer than two beside each other
    wider = [
        t for t in accepted if set(effect_class(t.name).includes) & set(added) and best.gain < t.gain + _FEWER
    ]
    return wider[0] if wider else best


def _settle(
    search: Search, declared: Base, base: Base, names: list[str], rounds: list[Round]
) -> tuple[list[Found], Base]:
    """Look at each effect again with the others present; returns them and the physics with those that stay."""
    if not names:
        return [], base
    if len(names) == 1 and rounds[0].chosen is not None and rounds[0].chosen.name == names[0]:
        trials = rounds[0].trials
        chosen = next(t for t in trials if t.name == names[0])
        return [Found(chosen.name, chosen, _ties(search, declared, chosen, rounds[0], names, rounds))], base
    found: list[Found] = []
    i = 0
    while i < len(names):
        name = names[i]
        rest = _without(fitted_system(base.regression), declared.system, name)
        without = search.base(rest, warm=True, like=base.regression)
        contained = effect_class(name).includes
        now = search.look(without, only={name, *contained, *_rivals(search, name, rounds)})
        own = next((t for t in now.trials if t.name == name), None)
        if own is None or not search.accept(own):
            names.pop(i)  # the others explain it
            base, found, i = without, [], 0
            continue
        best = next(t for t in now.trials if search.accept(t))
        if best.name != name and (best.name in contained or surely_above(best, own)):
            names[i] = best.name
            base, found, i = search.grown(best), [], 0
            if names.count(best.name) > 1 or len(rounds) > 12:
                break
            rounds.append(now)
            continue
        found.append(Found(name, own, _ties(search, without, own, now, names, rounds)))
        i += 1
    return found, base


def _ties(
    search: Search, without: Base, own: Trial, look: Round, names: Sequence[str], rounds: Sequence[Round]
) -> tuple[str, ...]:
    """What explains the data as well as an effect that was found: in its place, or in that of a part of it."""
    ties = ties_of(search, own, look.trials)
    others = _rivals(search, own.name, rounds) - {*ties, *effect_class(own.name).includes, *names}
    return (*ties, *_in_part(search, without, own, sorted(others), max(len(look.screened), 1)))


def _in_part(search: Search, without: Base, own: Trial, names: Sequence[str], among: int) -> list[str]:
    """Effects that explain the data as well with a part of the one that was found as all of it does.

    Air that moves is drag and a steady push; a tilted thrust pushes steadily too.
    """
    out: list[str] = []
    for name in names:
        if own.name in effect_class(name).includes:
            continue
        search.say("comparing effects", len(out), len(names))
        try:
            other = search.shared(without, own, name, among=among)
        except (NsdeError, np.linalg.LinAlgError):
            continue
        if other is not None and search.accept(other) and not surely_above(own, other):
            out.append(name)
    return out


def _rivals(search: Search, name: str, rounds: Sequence[Round]) -> set[str]:
    """Candidates that were there too when an effect was chosen, as far as chance goes."""
    return {
        t.name
        for look in rounds
        if look.chosen is not None and look.chosen.name == name
        for t in look.trials
        if search.accept(t)
    }


def _without(system: System, declared: System, name: str) -> System:
    """The system without an effect that was added; a declared one that it stood in for is back."""
    left = system.without_effects(name)
    contained = effect_class(name).includes
    back = [e for e in declared.effects if e.name in contained and e.name not in left.effect_names]
    return left.with_effects(*back) if back else left  # type: ignore[arg-type]


def ties_of(search: Search, chosen: Trial, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Names of candidates that explain the data as well as the chosen one; what contains it is none."""
    out = []
    for t in trials:
        contains = chosen.name in effect_class(t.name).includes
        if t.name != chosen.name and not contains and search.accept(t) and not surely_above(chosen, t):
            out.append(t.name)
    return tuple(out)
