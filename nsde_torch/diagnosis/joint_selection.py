"""Effects that the declared physics lacks, selected by the joint likelihood of physics, disturbances and sensors.

    e(theta + d, effect(start + a)) = e - J_theta d - J_start - J_effect a

One pass of the filter (`nsde_torch.inference`) at the physics so far leaves its innovations e and, as further columns
of one linear recursion, what every candidate of the catalogue does to them from each of its starts. All that is
compared is linear algebra of Gram matrices by block of time: what a candidate, or two of them together, would explain
of blocks that they were not fitted to. The best is fitted to the end, and counts only if the likelihood then rises as
far as it should.

Selected effects are then looked at again, each without itself: another one that is likelier in its place replaces
it, and one that cannot be distinguished from it is a tie.

A time shorter than a step of the log (inputs that act a millisecond late) is nothing that data can name: below one,
how inputs are held between samples decides. Left out, it makes other effects look likely. So it joins what is declared.
"""

import copy
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import inf, isfinite, log
from typing import Protocol, TypeAlias, final

import numpy as np
import torch
from scipy.special import chdtrc

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.candidates import (
    Start,
    alone,
    candidate_names,
    effect_of,
    joined,
    simplified,
    starts,
    starts_of,
)
from nsde_torch.diagnosis.evidence import bonferroni, folds_of, sum_error
from nsde_torch.diagnosis.gram_table import GramTable
from nsde_torch.diagnosis.laws import Term, tables, terms_on
from nsde_torch.diagnosis.search import Search, acts_everywhere, bent_shape, without_effect
from nsde_torch.effects import Effect, Law, Port, effect_class
from nsde_torch.effects.by_run import ByRun
from nsde_torch.effects.law import AND
from nsde_torch.errors import NsdeError
from nsde_torch.inference import LogLikelihood, MaximumLikelihood, Optimum, nearly_maximised
from nsde_torch.inference.functions import Functions, held_out_density
from nsde_torch.inference.sensitivity import grams
from nsde_torch.inference.state_space import Along
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name
from nsde_torch.time_limit import check_time

# of numpy, and of a machine whose own matrix is: of a crane at a rope of no length the selection ended
_SINGULAR = np.linalg.LinAlgError, torch.linalg.LinAlgError
_RISES = 0.3  # share of the nats of a linearised step that a fit has to bring
_TRIED = 3  # candidates that are fitted to the end before a round ends
_RIVALS = 3  # candidates that are fitted in the place of an effect, beside those that it contains
_LAWS = 2  # laws that are fitted in the place of an effect
_ROWS = 6000  # that are asked first whether anything comes near an effect: the published flights' 18,000 take minutes
# of what an effect brings, by which a law has to bring more to go before it: an asymmetric friction was a law of the
# force and a friction first, 225 nats for 202 (spring 26 of the blind seed 5601)
_BY_FAR = 0.25
_NOTHING = 1e-5  # typical sizes of an amplitude that does nothing: starts are strictly inside the bounds
# by which states may settle in a step beside an effect: beyond, it is a function of others at once, and only ratios of
# its numbers are seen. The speed of a small car was one of the command and of the place, by 14,000 1/s at 40 Hz, surely
_FASTEST = 2.8
_FAR = 3.0  # times the user's value, or a third of it
# that say which resonance is the likeliest: an arm of 9,000 that lacks a law had 40 s of hidden masses
_OF_RESONANCE = 2500
_COLUMNS = 40  # of candidates that are asked at once


@dataclass(frozen=True)
class Explained:
    """What a candidate would explain."""

    name: str  # of the effect
    beside: System  # physics that it would explain more beside
    start: Start  # values that a linearised step begins at
    values: dict[str, float]  # those of its parameters after the step, by label
    nats: float  # log likelihood of blocks left out, beyond that of the physics without it [nats]
    error: float  # its standard error, from the scatter over blocks [nats]
    rank: float  # `nats` less the price of its parameters
    p: float  # chance of as much if the effect did nothing, corrected for all candidates and their starts
    accepted: bool  # whether it is beyond chance
    blocks: Array  # `nats` by block of time (B,)
    errors: dict[str, tuple[float, float]]
    """Standard errors of its sizes, by label, and the same if all other parameters were known; inf: no row shows it."""

    @cached_property
    def begun(self) -> System:
        """The physics with it, at the values that the step begins at."""
        return joined(self.beside, self.name, self.start)

    @cached_property
    def system(self) -> System:
        """The physics with it, at the values of the step."""
        out = self.begun.with_effects()
        _set(out, self.values)
        return out


Look: TypeAlias = Sequence[Explained]
"""What the catalogue would explain beside some physics: every candidate at the best of its starts, the best first."""


@dataclass(frozen=True)
class FittedPhysics:
    """Physics at its optimum."""

    system: System  # with its values
    best: MaximumLikelihood  # parameters and noise levels
    at: Optimum  # the likelihood there

    @cached_property
    def density(self) -> Array:
        """Log density of each block of time (B,) under parameters that were fitted to others [nats]."""
        return held_out_density(self.at)

    @property
    def value(self) -> float:
        """Log likelihood less the price of the parameters (Schwarz) [nats]."""
        return self.best.likelihood - 0.5 * len(self.best.free) * log(len(self.at.blocks))


@dataclass(frozen=True)
class Round:
    """A look at the catalogue while effects are added."""

    look: Look
    chosen: str  # the effect that was added; empty where none was


@dataclass(frozen=True)
class Selected:
    """The physics without an effect that was selected, and what cannot be distinguished from it."""

    fit: Callable[[], FittedPhysics]  # fits all others
    ties: tuple[str, ...]  # effects that explain the data as well in its place
    law: str = ""  # a law of one term that is likelier in its place; empty where none is
    tried: int = 0  # number of the terms that a law was chosen from

    @cached_property
    def without(self) -> FittedPhysics:
        """All others, fitted when they are first asked for."""
        return self.fit()


@dataclass(frozen=True)
class Instead:
    """What may be in the place of an effect."""

    better: FittedPhysics | None = None  # physics with what is surely likelier; None where nothing is
    ties: tuple[str, ...] = ()  # effects that explain the data as well
    law: str = ""  # a law of one term that is likelier; empty where none is


@dataclass(frozen=True)
class Evidence:
    """How sure an effect is."""

    nats: float  # log likelihood that it brings beside the others, as expected of rows left out [nats]
    error: float  # its standard error [nats]
    p: float  # chance of as much if it did nothing, corrected for the number of comparisons (`starts_of`)

    @classmethod
    def of(
        cls, name: str, place: FittedPhysics, without: FittedPhysics, candidates: int, terms: int, steps: int
    ) -> "Evidence":
        """That for an effect of some physics, held against the physics `without` it.

        It was the best of `candidates` and their starts (`steps` of the longest stretch), and of `terms`.
        """
        labels = [label for label in place.best.vector.labels if label.startswith(f"{name}.")]
        risen, count = place.best.likelihood - without.best.likelihood, len(labels)
        among = max(candidates, 1) * starts_of(name, labels, steps) + terms
        p = bonferroni(float(chdtrc(count, max(2.0 * risen, 0.0))), among)
        # less a nat a parameter: of rows left out (Akaike)
        return cls(risen - count, sum_error(place.at.blocks - without.at.blocks), p)


@dataclass(frozen=True)
class JointSelection:
    """What the joint likelihood selected."""

    declared: FittedPhysics  # the declared physics, with what is shorter than a step
    final: FittedPhysics  # the physics with the effects
    selected: dict[str, Selected]  # the effects
    rounds: tuple[Round, ...]  # looks at the catalogue, in order
    errors: dict[str, dict[str, tuple[float, float]]]
    """Smallest `Explained.errors` over all looks, by candidate and label."""
    aside: tuple[str, ...] = ()  # effects that joined what is declared because they are shorter than a step
    functions: Functions | None = None
    """Functions that explain more beside the physics, as far as they were looked for."""
    suspected: tuple[str, ...] = ()
    """Effects that were no candidates behind a smoother and would explain more (`feedback_bias`)."""

    @property
    def candidates(self) -> int:
        """Number of the candidates of the first look."""
        return len(self.rounds[0].look)

    def evidence(self, search: Search, name: str) -> Evidence:
        """How sure an effect is."""
        one = self.selected[name]
        return Evidence.of(name, self.final, one.without, self.candidates, one.tried, search.longest)

    def less(self, name: str) -> "JointSelection":
        """The same without one effect."""
        rest = self.selected[name].without

        def without(other: str) -> FittedPhysics:
            if len(self.selected) == 2:
                return self.declared
            return fitted(without_effect(rest.system, self.declared.system, other), rest)

        others = {n: replace(one, fit=partial(without, n)) for n, one in self.selected.items() if n != name}
        return replace(self, final=rest, selected=others, functions=None)


class Laws(Protocol):
    """Laws that no catalogue has."""

    def first(self, place: FittedPhysics) -> FittedPhysics | None:
        """Physics with the law that explains most beside them, if it may be asked before the catalogue has ended."""

    def lost(self) -> None:
        """An effect of the catalogue was likelier."""


@final
class JointSearch:
    """Looks for effects; remembers what was fitted, and what the catalogue would explain beside it.

    It begins with a system at its first values; sinusoids start from `frequencies` [Hz], and effects `aside` joined
    what is declared because they are shorter than a step. `given` is the system at the values that the user gave.

    Attributes:
        declared: The declared physics, fitted, with what is shorter than a step.
        libraries: By law: all terms that it was chosen from.
        laws: Where laws are found that compete with the catalogue while they are likelier; None: nowhere.
    """

    def __init__(
        self,
        search: Search,
        problem: LogLikelihood,
        system: System,
        frequencies: Sequence[float] = (),
        *,
        aside: Sequence[str] = (),
        given: System | None = None,
    ) -> None:
        self.search, self._problem, self._frequencies = search, problem, frequencies
        self._declared = set(system.effect_names)
        self._rounds: list[Round] = []
        self._aside = list(aside)
        self._places: dict[frozenset[str], FittedPhysics] = {}
        self._looks: dict[frozenset[str], Look] = {}
        self.libraries: dict[str, tuple[Term, ...]] = {}
        self.laws: Laws | None = None
        self._instead: dict[str, tuple[Term, ...]] = {}
        self._some: torch.Tensor | None = None  # chunks of the log that it is in; None: all
        self._parts: dict[int, JointSearch | None] = {}
        self._given = given
        self.declared = self.fitted(system, None)
        if given is not None:
            self.declared = self._begun_from(given)
        # without the outliers that were found beside the declared physics
        self._problem = self.declared.at.of
        speeds = [
            self._problem.of(one).speed(self.declared.at.x)
            for one in (self.declared.system, *([] if given is None else [given]))
        ]
        self._problem.space.fastest = max(_FASTEST, 2.0 * max(speeds))

    def _begun_from(self, given: System) -> FittedPhysics:
        """The declared physics fitted from these values, where that is likelier than from those of least squares.

        Least squares of a loop may lie far off. The declared physics of a robot on two wheels were 7,000 nats below,
        its masses 50 times too large, and a hidden mass came before the friction that is there. A part of a long log is
        asked first: of 203 s of a hexacopter the same optimum took 5 s once more.
        """
        which = self.declared.at.of.part(_ROWS)
        try:
            if which is not None:
                few, least = self.declared.at.of.some(which), self.search.decisions.alike_nats
                here = fitted_at(
                    few.of(self.declared.system), self.declared.system, self.declared.at.some(which)
                )
                there = fitted_at(few.of(given), given, None, here.best.likelihood + least)
                if there.best.likelihood < here.best.likelihood + least:
                    return self.declared
            other = self.fitted(given, None, self.declared.best.likelihood)
        except (NsdeError, *_SINGULAR):
            return self.declared
        return max(self.declared, other, key=lambda f: f.best.likelihood)

    @property
    def tries_laws(self) -> bool:
        """Whether laws may be tried: not where the user says what may be."""
        return self.search.candidates is None and self.search.budgets.laws > 0

    def selected(
        self,
        begun: System | None = None,
        brought: Mapping[str, float] | None = None,
        so_far: Callable[[FittedPhysics, FittedPhysics, Mapping[str, float]], None] = lambda *known: None,
    ) -> JointSelection:
        """Effects selected by the likelihood, beside those of `begun` that were selected before and `brought` so much.

        `so_far` takes the declared physics, those after each effect that is added, and what each effect brought [nats].
        """
        brought = dict(brought or {})
        place = self.declared if begun is None else self._declared_if_short(self.fitted(begun, self.declared))
        so_far(self.declared, place, brought)

        def known(before: FittedPhysics, after: FittedPhysics) -> None:
            new = self.added(after.system) - self.added(before.system)
            brought.update(dict.fromkeys(new, after.best.likelihood - before.best.likelihood))
            so_far(self.declared, after, brought)

        return self.concluded(place, known)

    def concluded(
        self,
        place: FittedPhysics,
        known: Callable[[FittedPhysics, FittedPhysics], None] = lambda before, after: None,
        before: Mapping[str, Selected] | None = None,
    ) -> JointSelection:
        """Physics with what it lacks of the catalogue, each effect looked at again beside the others.

        Where that changed the effects, what they lack is looked for again: a law that takes the place of a steady force
        leaves that to be found beside it (the public drive EMPS).

        It begins with `place`; `known` takes the physics before and after an effect is added. Of effects that were
        selected `before`, only whether they are still needed is asked again: a law beside the seven of the published
        flights made each be looked at in full once more.
        """
        been: set[frozenset[str]] = set()
        looked = {name: Instead(None, one.ties, one.law) for name, one in (before or {}).items()}
        while frozenset((more := self._extended(place, known)).system.effect_names) not in been:
            been.add(frozenset(more.system.effect_names))
            place, looked = self.looked_at_again(more, looked)
            if frozenset(place.system.effect_names) in been:
                break
        selected = {}
        for name, one in looked.items():
            ties, tried = tuple(t for t in one.ties if t not in looked), len(self.libraries.get(name, ()))
            selected[name] = Selected(partial(self.without, place, name), ties, one.law, tried)
        rounds = tuple(self._rounds) or (Round(self.look(self.declared), ""),)
        # what is missing passes for noise in the first look
        errors: dict[str, dict[str, tuple[float, float]]] = {}
        for p in (p for look in self._looks.values() for p in look):
            own = errors.setdefault(p.name, {})
            for label, found in p.errors.items():
                least = own.get(label, found)
                own[label] = min(found[0], least[0]), min(found[1], least[1])
        return JointSelection(self.declared, place, selected, rounds, errors, tuple(self._aside))

    def _extended(
        self, place: FittedPhysics, known: Callable[[FittedPhysics, FittedPhysics], None]
    ) -> FittedPhysics:
        """Physics with effects of the catalogue that it lacks, one at a time."""
        most = self.search.decisions.most_effects
        for count in range(len(self.added(place.system)), most):
            names = candidate_names(place.system, self.search.candidates)
            tried = f"{len(names)} effect{'s' if len(names) > 1 else ''}"
            self.search.say(f"round {count + 1}: trying {tried}", count, most)
            better = self._or_a_law(place, self.with_one_more(place))
            # among those that count as declared is a delay of less than a step, and it may come back (odd_springs.py,
            # "wall of magnets", seed 1)
            name = (
                ""
                if better is None
                else next(iter({*better.system.effect_names} - {*place.system.effect_names}))
            )
            self._rounds.append(Round(self.look(place), name))
            if better is None:
                there = frozenset(place.system.effect_names)
                nearer = self._places.get(there, place)
                # not where both are minus infinity: of a cart the same 43 effects were tried six times
                if not nearer.best.likelihood > place.best.likelihood + self.search.decisions.alike_nats:
                    break
                # the fit of a candidate has led there
                self.declared = nearer if place is self.declared else self.declared
                place = nearer
                self._looks.pop(there)
                continue
            # memory starts by the values that a fit begins at: a heater had a gain that drifts by 1e-7 1/s, 118 nats
            better = better if better.best.settled else self._settled(better)
            before, place = place, self._without_idle(self._declared_if_short(better))
            known(before, place)
        return place

    def _or_a_law(self, place: FittedPhysics, better: FittedPhysics | None) -> FittedPhysics | None:
        """The physics with one more effect, or with a law that is surely likelier.

        Seven effects of the catalogue made up for a cable between two joints, 440 nats of 3,000, before its law was
        looked for.
        """
        if better is None or self.laws is None:
            return better
        law = self.laws.first(place)
        if law is not None:
            more = len(law.best.free) - len(better.best.free)
            difference = law.at.blocks - better.at.blocks
            name = next(iter(self.added(law.system) - self.added(place.system)))
            least = sure_nats(self.search, sum_error(difference)) + log(max(len(self.libraries[name]), 1))
            least = max(least, _BY_FAR * (better.best.likelihood - place.best.likelihood))
            if float(difference.sum()) - 0.5 * more * log(len(difference)) > least:
                return law
        self.laws.lost()
        return better

    def chosen(self, law: str, fitted: Sequence[Term], library: Sequence[Term]) -> None:
        """A law was chosen: it is held against the other terms that were fitted when it is looked at again."""
        self._instead[law] = tuple(fitted)
        self.libraries |= dict.fromkeys((t.law for t in fitted), tuple(library))

    def without(self, place: FittedPhysics, name: str) -> FittedPhysics:
        """The physics without an effect, fitted; a declared one that it stood in for is back."""
        rest = without_effect(place.system, self.declared.system, name)
        return self._places.get(frozenset(rest.effect_names)) or self.tried(rest, place)

    def added(self, system: System) -> frozenset[str]:
        return frozenset(system.effect_names) - self._declared

    def fitted(self, system: System, like: FittedPhysics | None, wanted: float = -inf) -> FittedPhysics:
        """Physics fitted from its present values, with noise levels near those of other physics; the best so far.

        A fit that has no way to a log likelihood that is wanted ends early, and is not kept.
        """
        made = fitted_at(self._problem.of(system), system, None if like is None else like.at, wanted)
        if made.best.likelihood < wanted:
            return made
        added = frozenset(system.effect_names)
        known = self._places.get(added)
        if known is None or made.best.likelihood > known.best.likelihood:
            self._places[added] = made
        return self._places[added]

    def tried(self, system: System, like: FittedPhysics | None, wanted: float = -inf) -> FittedPhysics:
        """As `fitted`, with a candidate; without any likelihood where its slopes are no numbers.

        The end of travel of an arm went 2,600 rad away. Physics that others are compared with has to have a likelihood.
        """
        try:
            return self.fitted(system, like, wanted)
        except _SINGULAR:
            like = like or self.declared
            return replace(like, best=replace(like.best, likelihood=-inf))

    def look(self, place: FittedPhysics) -> Look:
        """What the catalogue would explain beside some physics."""
        names = frozenset(place.system.effect_names)
        if names not in self._looks:
            self._looks[names] = looked(self.search, place, self._frequencies)
        return self._looks[names]

    def _below_a_step(self, system: System, name: str) -> bool:
        """Whether an effect is a time that is a mere fraction of a step."""
        vector = ParameterVector(system)
        own = [j for j in vector.of(name) if vector.moves_memory[j] and vector.units[j] == "s"]
        return any(vector.start[j] < self.search.shortest for j in own)

    def _declared_if_short(self, place: FittedPhysics) -> FittedPhysics:
        """The physics; effects that are a time of a fraction of a step join what is declared.

        One may be seen to be so short only beside what was added after it.
        """
        for name in sorted(self.added(place.system)):
            if not self._below_a_step(place.system, name):
                continue
            without = self.without(place, name)
            # what was added after it may explain what it did: a lag after a delay (blind carts, seed 8123, case 8)
            if not self.needed(name, place, without):
                place = without
                continue
            with_it = self.declared.system.with_effects(effect_of(place.system, name))
            self._declared.add(name)
            self._aside.append(name)
            self.declared = place if not self.added(place.system) else self.fitted(with_it, self.declared)
        return place

    def _without_idle(self, place: FittedPhysics) -> FittedPhysics:
        """The physics without times of a fraction of a step that bring nothing beside what was added since.

        A delay of a millisecond that had stood in for a hidden mass cost 24 nats beside it, which a relaxation brought
        that is not there (benchmarks/blind/hidden_masses.py, spring 6).
        """
        for name in tuple(self._aside):
            without = self.fitted(place.system.without_effects(name), place)
            if without.value > place.value:
                self._aside.remove(name)
                self._declared.discard(name)
                self.declared = self.fitted(self.declared.system.without_effects(name), self.declared)
                place = without
        return place

    def with_one_more(self, place: FittedPhysics) -> FittedPhysics | None:
        """The physics with the candidate that brings most once it is fitted; None where none surely brings anything.

        Which one that is, a part of a long log tells: of six racing flights (NeuroBEM) six fits took two minutes.
        """
        look = self.look(place)
        tried = _in_order(self.search, look, self.added(place.system), place)[:_TRIED]
        few = self._in_few_rows(_ROWS)
        most = None if few is None or len(tried) < 2 else few.most_here(tried, place, self._problem)
        best = None if most is None else self._best_of([most], place)[0]
        best = best or self._best_of([p for p in tried if p is not most], place)[0]
        doubtful = [p for p in look if p.nats > 0 or p.p < self.search.level("effects")]
        best = best or self._more_once_fitted(place, [p for p in doubtful if p not in tried], few)
        best = best or self._from_afar(place)
        afresh = self._given if place is self.declared and self._has_learned(place) else None
        return best if afresh is None else self._afresh(afresh, best)

    def _has_learned(self, place: FittedPhysics) -> bool:
        """Whether a number of the declared physics ends at its bound, or far from what the user gave.

        A heater that settles in 0.5 s settled in 5 s, behind an actuator that lags by 4 s.
        """
        if len(place.best.free) < len(place.best.vector):
            return True
        if self._given is None:
            return False
        given = ParameterVector(self._given)
        found = dict(zip(place.best.vector.labels, place.best.theta.tolist(), strict=True))
        known = [
            (own, found[label])
            for label, own in zip(given.labels, given.start, strict=True)
            if label in found
        ]
        return any(own and not 1.0 / _FAR < theta / own < _FAR for own, theta in known)

    def _afresh(self, given: System, best: FittedPhysics | None) -> FittedPhysics | None:
        """The best so far, or physics with a candidate that is looked for and fitted from the given values.

        Declared physics may have learned what they lack (`_has_learned`). The gain of a servo that swings at 1.5 Hz was
        0, beside which nothing that acts on inputs does anything. Which candidate it is, a part of a longer log tells.
        """
        begun = fitted_at(self._problem.of(given), given, None, turns=1)
        look = looked(self.search, begun, self._frequencies)[:_TRIED]
        first = [system for p in look for system in (p.system, p.begun)]
        for name in candidate_names(given, self.search.candidates):
            values = effect_class(name).fits_from(begun.at.of.sizes)
            first += [joined(given, name, dict(one)) for one in values]
        few = self._in_few_rows(_OF_RESONANCE) or self
        most: FittedPhysics | None = None
        for system in first:
            check_time()
            there = few.tried(system, None, -inf if most is None else most.best.likelihood)
            most = there if most is None or there.best.likelihood > most.best.likelihood else most
        place = best or self.declared
        least = place.best.likelihood + self.search.decisions.alike_nats
        there = place if most is None else self.tried(most.system, None, least)
        better = there.best.likelihood > least and self._surely_brings(there, self.declared)
        return there if better else best

    def _best_of(
        self, tried: Sequence[Explained], place: FittedPhysics, share: float = 1.0
    ) -> tuple[FittedPhysics | None, Explained | None]:
        """The physics with one of some candidates, the best first, and which; `share` of the nats are in these rows.

        A fit may bring more than its step promised, and then another that promised as much may, too: a servo was a
        delay, and four more effects that made up for the rest (tests/diagnosis/test_hidden_mass.py). Each pays for its
        parameters: a wind beside a drag was a force of the world (closed_loop.py --seed 5801, case_05).
        """
        best, chosen, risen, worth = None, None, 0.0, 0.0
        for proposal in tried:
            promised = share * proposal.nats
            if chosen is not None and promised < risen and self._promises_less(proposal, chosen):
                continue
            # what contains it is tried in the next round: of a flight's motors a lag up and down was exchanged for one
            if chosen is not None and chosen.name in effect_class(proposal.name).includes:
                continue
            there = self._fitted_to_the_end(proposal, place, risen - log(len(place.at.blocks)))
            gained, more = there.best.likelihood - place.best.likelihood, there.value - place.value
            # else it is not what its step promised: a lag in the place of a delay (carts of seed 9002, case 11)
            if more > worth and (gained > _RISES * promised or self._surely_brings(there, place)):
                best, chosen, risen, worth = there, proposal, gained, more
        return best, chosen

    def _promises_less(self, proposal: Explained, chosen: Explained) -> bool:
        """Whether a step promises surely fewer nats than that of what was chosen."""
        less = chosen.blocks - proposal.blocks
        return float(less.sum()) > sure_nats(self.search, sum_error(less))

    def _more_once_fitted(
        self, place: FittedPhysics, proposals: Sequence[Explained], few: "JointSearch | None"
    ) -> FittedPhysics | None:
        """The physics with a candidate that explains much more once it is fitted than its linearised step promises.

        Gusts that last have learned a steady push: what a step gains at their level is no measure of what a fit gains
        (2.7 and 27 nats, tests/diagnosis/test_ceiling.py). And where what is missing biases the physics far, as the
        lag of a motor does a gain that one flight shows best, steps from there disagree between runs
        (tests/diagnosis/test_named.py).

        A part of a long log is asked first: three fits of six racing flights (NeuroBEM) that win nothing take a minute.
        """
        best, last = None, place
        for proposal in proposals[:_TRIED]:
            if few is not None and not few.wins_here(proposal.system, place):
                continue
            least = place.best.likelihood + self.search.decisions.alike_nats
            there = self._from_each(proposal.name, place, self.tried(proposal.system, place, least))
            if there.best.likelihood > least and self._surely_brings(there, place, last):
                best = last = there
        return best

    def _from_afar(self, place: FittedPhysics) -> FittedPhysics | None:
        """The physics with an effect that is seen only once it is fitted from near its values (`Effect.fitted_from`).

        Beside a hidden mass of 24 % the declared physics, and the noise levels, had learned so much of the resonance
        that a step from no mass promises nothing where a fit brings 1,400 nats: differences between runs are named
        instead, surely (tests/diagnosis/test_hidden_mass.py).
        """
        best = place
        for name in candidate_names(place.system, self.search.candidates):
            there = self._from_each(name, place, best)
            if there is not best and self._surely_brings(there, place):
                best = there
        return None if best is place else best

    def _from_each(self, name: str, place: FittedPhysics, best: FittedPhysics) -> FittedPhysics:
        """The likeliest physics with an effect, fitted from each of its values (`Effect.fitted_from`), or the best.

        Not where the innovations are white, as nothing that resonates leaves them. From which value, a part of a longer
        log tells. Each to its end: they begin far below the physics without it, and one fit may not get there. Of a
        hidden mass of 3 % it was 190 nats short (benchmarks/blind/hidden_masses.py, spring 16).
        """
        before, values = best, _seen_once_fitted(name, place.at.of.sizes)
        if not values or not place.best.predictable.any():
            return best
        few = self._in_few_rows(_OF_RESONANCE) or self
        here = place if few is self else few._here(place)
        least = here.best.likelihood + (0.0 if few is self else self.search.decisions.alike_nats)
        for value in values:
            check_time()
            there = few.tried(joined(place.system, name, dict(value)), here)
            if there.best.likelihood > least:
                least = there.best.likelihood
                tried = there if few is self else self.tried(there.system, place)
                best = max(best, tried, key=lambda f: f.best.likelihood)
        return best if best is before else self._settled(best)

    def _settled(self, place: FittedPhysics) -> FittedPhysics:
        """Physics fitted again from where their fit ended, until that is no likelier.

        Where innovations are not as predicted, a nat is worth less: fits of a boat at sea were begun again for minutes.
        """
        while isfinite(place.best.likelihood):
            again = self.tried(place.system, place)
            least = self.search.decisions.alike_nats * place.best.inflation
            if again.best.likelihood <= place.best.likelihood + least:
                break
            place = again
        return place

    def _fitted_to_the_end(self, proposal: Explained, place: FittedPhysics, least: float) -> FittedPhysics:
        """A candidate fitted from where its linearised step ends, or else from where that begins.

        Fits that have no way to more nats than some end early.
        """
        wanted = place.best.likelihood + max(least, self.search.decisions.alike_nats)
        there = self.tried(proposal.system, place, wanted)
        if _seen_once_fitted(proposal.name, place.at.of.sizes):
            return self._from_each(proposal.name, place, there)
        if there.best.likelihood > place.best.likelihood + _RISES * proposal.nats:
            return there
        # an undeclared delay makes a gain of 0, beside which a step of the delay goes anywhere
        # (test_a_delay_is_selected_whose_lack_hides_the_gain_of_the_input)
        other = self.tried(proposal.begun, place, wanted)
        return max(there, other, key=lambda f: f.best.likelihood)

    def _surely_brings(
        self, there: FittedPhysics, place: FittedPhysics, last: FittedPhysics | None = None
    ) -> bool:
        """Whether effects that are beside some physics are needed, and explain rows left out as others do at least.

        Asked where a fit is not what a linearised step promised. What is there in one run alone
        (tests/diagnosis/test_one_run.py) is no law of the machine. And the fit of the physics without them may have
        ended short of theirs: beside a friction and a delay of a robot on two wheels a viscoelasticity that is not
        there brought 56 nats.
        """
        new = self.added(there.system) - self.added(place.system)
        nearer = self.tried(there.system.without_effects(*new), there)
        if {*place.system.effect_names} == {*nearer.system.effect_names}:
            place = max(place, nearer, key=lambda f: f.best.likelihood)
        return all(self.needed(n, there, place) for n in new) and _surely_more(
            self.search, there.density - (last or place).density, place
        )

    def looked_at_again(
        self, place: FittedPhysics, before: Mapping[str, Instead]
    ) -> tuple[FittedPhysics, dict[str, Instead]]:
        """Each effect again beside the others: what is likelier replaces it, what is as likely is a tie.

        Where one is not needed, all others are looked at again without it. Of those looked at before the last exchange
        only whether they are still needed is asked again, not what else may be in their place: on six racing flights
        (NeuroBEM) that took 130 s each time.

        A part of a long log is asked first: an effect that is needed there is needed, and what is surely worse in its
        place there is worse, and not fitted to all rows (of the published flights, physics without one of eight effects
        are fitted in 10 s each; of NeuroBEM's, three in the place of the drag took two minutes).
        """
        looked = dict(before)
        few = self._in_few_rows(_ROWS)
        exchanged, kept = 0, set[str]()  # those needed beside all others as they are now
        beside = set[str]()  # those that were looked at beside all of these
        while left := [n for n in place.system.effect_names if n not in {*self._declared, *kept}]:
            name = left[0]
            self.search.say(f"looking again at {name}", len(kept), len(kept) + len(left))
            inside = few is not None and few.needed_here(name, place)
            if not inside and not self.needed(name, place, without := self.without(place, name)):
                place, kept = without, set()  # what was added after it explains what it did
                # beside a viscoelasticity that was not needed a dead band of a motor that turns one way had no tie
                looked = {n: one for n, one in looked.items() if n not in beside}
                beside = set()
                continue
            if name not in looked:
                may = exchanged < self.search.budgets.exchanges
                there = few.instead_here(name, place) if inside and few is not None else None
                instead = Instead()
                if there != instead:
                    instead = self._instead_of(name, place, self.without(place, name), may, there)
                if instead.better is not None:
                    place, kept, exchanged = instead.better, set(), exchanged + 1
                    continue
                looked[name] = instead
                beside.add(name)
            kept.add(name)
        return place, {n: looked[n] for n in place.system.effect_names if n in kept}

    def _in_few_rows(self, rows: int) -> "JointSearch | None":
        """The same search in a part of the log that is evenly from all of it; None where that is hardly a part."""
        which = self._problem.part(rows)
        if which is None:
            return None
        if (out := self._parts.get(rows)) is None:
            out = self._parts[rows] = copy.copy(self)
            out._some, out._problem = which, self._problem.some(which)
            out._places, out._looks, out._parts = {}, {}, {}
        out.declared, out._declared = self.declared, self._declared
        out._looks[frozenset(self.declared.system.effect_names)] = self.look(self.declared)
        out._instead, out.libraries = dict(self._instead), dict(self.libraries)
        return out

    def needed_here(self, name: str, whole: FittedPhysics) -> bool:
        """Whether an effect is needed in these few rows; `whole` is the physics with it, fitted to all rows."""
        place = self._here(whole)
        return self.needed(name, place, self.without(place, name))

    def most_here(
        self, tried: Sequence[Explained], whole: FittedPhysics, problem: LogLikelihood
    ) -> Explained | None:
        """Which of some candidates brings most in these few rows of a whole log; see `needed_here`."""
        here, all_rows = (p.space.chunks.counted.sum() for p in (self._problem, problem))
        return self._best_of(tried, self._here(whole), float(here / all_rows))[1]

    def wins_here(self, begun: System, whole: FittedPhysics) -> bool:
        """Whether physics with a candidate explain more of these few rows, fitted, than chance; see `needed_here`."""
        place = self._here(whole)
        further = len(ParameterVector(begun)) - len(place.best.vector)
        least = place.best.likelihood + 0.5 * max(further, 1) + self.search.decisions.alike_nats
        return self.tried(begun, place, least).best.likelihood > least

    def instead_here(self, name: str, whole: FittedPhysics) -> Instead:
        """What comes near in the place of an effect in these few rows; see `needed_here`."""
        place = self._here(whole)
        return self._instead_of(name, place, self.without(place, name), True, None)

    def _here(self, whole: FittedPhysics) -> FittedPhysics:
        """Physics that were fitted to all rows, fitted to these."""
        assert self._some is not None
        known = self._places.get(frozenset(whole.system.effect_names))
        return known or self.fitted(whole.system, replace(whole, at=whole.at.some(self._some)))

    def _instead_of(
        self, name: str, place: FittedPhysics, without: FittedPhysics, exchanges: bool, near: Instead | None
    ) -> Instead:
        """What is likelier in the place of an effect where that may be exchanged, or else as likely.

        Of what comes `near` in a part of the log, if that is known; where something is likelier there, of anything.
        """
        # without it the filter may diverge, and nothing can be begun there (blind joints of seed 202, case 1)
        if not isfinite(without.best.likelihood):
            return Instead()
        some = near if near is not None and near.better is None else None
        alike, better = self._rivals(name, place, without, None if some is None else some.ties)
        law = ""
        if (better is None or not exchanges) and (some is None or some.law):
            law, better = self._nearer_law(name, place, without)
        if better is not None and exchanges:
            return Instead(better)
        if some is None or any(AND in tie for tie in some.ties):
            alike += self._in_parts(name, place, without)
        return Instead(None, tuple(alike), law)

    def needed(self, name: str, place: FittedPhysics, without: FittedPhysics) -> bool:
        """Whether an effect brings more likelihood than chance, of all candidates of the look that found it."""
        terms = len(self.libraries.get(name, ()))
        candidates = len(self.look(self.declared))
        own = Evidence.of(name, place, without, candidates, terms, self.search.longest)
        # by the scatter over blocks alone: axes turned by 0.2 deg brought 14 nats beside a steady force (case 6 of
        # `closed_loop.py --seed 77`)
        return own.p < self.search.level("effects") and own.nats > sure_nats(self.search, own.error)

    def _rivals(
        self, name: str, place: FittedPhysics, without: FittedPhysics, only: Collection[str] | None = None
    ) -> tuple[list[str], FittedPhysics | None]:
        """Effects as likely as one that was selected, `only` of these, and physics with a better one in its place."""
        look, contained = self.look(without), effect_class(name).includes
        # what contains the effect was a candidate beside it, and was not needed
        others = [p for p in look if p.accepted and name not in {p.name, *effect_class(p.name).includes}]
        # what contains another one comes after it: beside a friction of two sides and one of Stribeck's a dead band was
        # no rival of a steady torque (tests/diagnosis/test_own_machines.py)
        all_of_them = {p.name for p in others}
        others.sort(key=lambda p: not all_of_them.isdisjoint(effect_class(p.name).includes))
        rivals = [
            *(p for p in look if p.name in contained),
            *[p for p in others if p.name not in contained][:_RIVALS],
        ]
        alike: list[str] = []
        best: tuple[float, FittedPhysics] | None = None
        there_too = {name, *without.system.effect_names}
        beside = self._instead.get(name, ())
        around = {t.law for t in beside for own in beside if own.law == name and t.contains(own)}
        laws = [t for t in beside if t.law not in there_too | around]
        least = self._as_likely(place, without)
        tried = (
            *((r.name, r.system) for r in rivals),
            *((t.law, joined(without.system, t.law, t.start)) for t in laws),
        )
        for rival, system in tried:
            if only is not None and rival not in only:
                continue
            # from the noise levels that its step was made at: from those beside the effect, of which one was a tenth, a
            # dry friction ended 24,000 nats below (tests/diagnosis/test_named.py)
            there = self.tried(system, without, least)
            if rival in contained and there.best.likelihood < least:
                # without it the physics may lie where no step leads back from: two equal lags up and down were no lag
                there = self.tried(simplified(place.system, name, rival), place, least)
            gained = _compared(self.search, name, rival, place, there)
            if gained >= 0 and (fewer := self._without_needless(there, rival)) is not there:
                there, gained = fewer, _compared(self.search, name, rival, place, fewer)
            if gained > 0 and (best is None or gained > best[0]):
                best = gained, there
            elif not gained and not self._another_law(rival, there):
                alike.append(rival)
        return alike, None if best is None else best[1]

    def _without_needless(self, place: FittedPhysics, name: str) -> FittedPhysics:
        """The physics without effects that one of them makes needless.

        A servo far above what the log holds was a delay with a relaxation: in the place of each alone it was no better,
        of both it is (`odd_springs.py`, "servo", seed 5).
        """
        for other in sorted(self.added(place.system) - {name}):
            rest = self.without(place, other)
            if not self.needed(other, place, rest):
                return self._without_needless(rest, name)
        return place

    def _another_law(self, name: str, place: FittedPhysics) -> bool:
        """Whether an effect of some physics is, as it is fitted, another law under its name."""
        bent = bent_shape(place.best.vector, place.best.theta, name)
        return bool(bent) or acts_everywhere(self.search.steps, place.system, name)

    def _as_likely(self, place: FittedPhysics, without: FittedPhysics) -> float:
        """Log likelihood below which nothing in the place of an effect is as likely, also with fewer parameters."""
        difference = place.at.blocks - without.at.blocks
        price = 0.5 * (len(place.best.vector) - len(without.best.vector)) * log(len(difference))
        return place.best.likelihood - max(price, 0.0) - sure_nats(self.search, sum_error(difference))

    def _in_parts(self, name: str, place: FittedPhysics, without: FittedPhysics) -> list[str]:
        """What is as likely as an effect and a sum: a simpler effect that it contains, and another that does the rest.

        Air that moves is drag and a steady push where all flights point the same way (tests/diagnosis/test_named.py).
        """
        simpler, out = effect_class(name).includes, []
        for part in (p for p in self.look(without) if p.name in simpler):
            half = self.tried(part.system, without)
            others = (p for p in self.look(half) if p.nats > 0 and p.name != name)
            rest = next((p for p in others if part.name not in effect_class(p.name).includes), None)
            if rest is not None:
                there = self.tried(rest.system, half)
                if _compared(self.search, name, rest.name, place, there) >= 0:
                    out.append(part.name + AND + rest.name)
        return out

    def _nearer_law(
        self, name: str, place: FittedPhysics, without: FittedPhysics
    ) -> tuple[str, FittedPhysics | None]:
        """A law of one term that is likelier than an effect of a coordinate in its place, empty if there is none.

        And the physics with it where it is surely likelier, and laws may be tried.

        A force `x^2 x_dot` on a cart is well explained by a dry friction where nothing else is offered. A law with as
        many parameters has to explain surely more, as it is the best of a library; one with fewer, as much (case_010 of
        the blind springs of seed 8123: a dry friction of 0.37 m/s width for a damping that falls with the speed).
        """
        effect, space = effect_of(place.system, name), without.at.of.space
        if effect.port in (Port.INPUT, Port.RATE) and not effect.n_memory:
            return self._likelier_law(place, without)
        if not isinstance(effect, Law) or (effect.at.port, effect.at.row) not in space.disturbances:
            return "", None
        port = space.disturbances.index((effect.at.port, effect.at.row))
        terms = terms_on(without.system, without.at, port, coordinate_of(place.system, effect))
        folds = folds_of(self.search.decisions, *space.chunks.places())
        # linearised steps with linearised steps: noise without either has learned some of both
        own = next((p.nats for p in self.look(without) if p.name == name), 0.0)
        rivals: list[tuple[float, Term]] = []
        for some, held in tables(without.system, without.at, terms):
            table = GramTable(held, 1 + without.best.free, folds)
            for term, numbers in some:
                if all(map(table.is_new, numbers)):
                    nats = float(table.gain((0, *numbers))[0].sum())
                    rivals += [(nats, term)] if nats > own else []
        least = self._as_likely(place, without)
        for _, term in sorted(rivals, key=lambda r: -r[0])[:_LAWS]:
            system = joined(without.system, term.law, term.start)
            there = self.tried(system, without, least)
            difference = there.at.blocks - place.at.blocks
            fewer = len(place.best.vector) - len(there.best.vector)
            gained = float(difference.sum()) + 0.5 * fewer * log(len(difference))
            sure = log(len(terms)) + sure_nats(self.search, sum_error(difference))
            if gained > (0.0 if fewer > 0 else sure):
                if self.tries_laws and float(difference.sum()) > sure:
                    self.chosen(term.law, [term], terms)
                    return term.law, there
                return term.law, None
        return "", None

    def _likelier_law(self, place: FittedPhysics, without: FittedPhysics) -> tuple[str, FittedPhysics | None]:
        """As `_nearer_law`, of what an input or a store loses: any law of a machine of few variables, on any row.

        A reactor's loss of heat was a loss of its coolant, which is 312 to 337 K, with a relaxation beside it.
        """
        there = self.laws.first(without) if self.laws is not None and self._some is None else None
        if there is None:
            return "", None
        (law,) = self.added(there.system) - self.added(without.system)
        difference = there.at.blocks - place.at.blocks
        fewer = len(place.best.free) - len(there.best.free)
        sure = log(max(len(self.libraries[law]), 1)) + sure_nats(self.search, sum_error(difference))
        gained = float(difference.sum()) + 0.5 * fewer * log(len(difference))
        if gained > (0.0 if fewer > 0 else sure):
            return law, there if gained > sure else None
        return "", None


def fitted_at(
    problem: LogLikelihood, system: System, near: Optimum | None, wanted: float = -inf, **limits: int
) -> FittedPhysics:
    """A machine at the optimum of its likelihood, or as far as `limits` let it come (`turns`)."""
    best, at = nearly_maximised(problem, near, wanted=wanted, **limits)
    out = system.with_effects()
    best.vector.write(out, best.theta)
    return FittedPhysics(out, best, at)


def fitted(system: System, like: FittedPhysics) -> FittedPhysics:
    """A machine at the optimum of its likelihood, from its values and those of other physics on the same rows."""
    return fitted_at(like.at.of.of(system), system, like.at)


def _seen_once_fitted(name: str, sizes: Mapping[str, float]) -> Sequence[Mapping[str, float]]:
    """Values from which fits of an effect begin, as a linearised step from no effect shows nothing of it.

    Of what acts on inputs it does, unless their gain is nothing (`JointSearch._afresh`).
    """
    cls = effect_class(name)
    return () if cls.port is Port.INPUT else cls.fits_from(sizes)


def coordinate_of(system: System, effect: Law) -> list[str]:
    """Names of the position and the speed that a law of one coordinate is of."""
    return [system.state_names[k] for k in (effect.at.position, effect.at.velocity) if k is not None]


def _in_order(search: Search, look: Look, added: Collection[str], place: FittedPhysics) -> list[Explained]:
    """Candidates that surely explain something, the best first, and before it what is simpler."""
    # surely: on the EMPS drive a friction by place, 50 +- 28 nats, led to four effects more
    ranked = [p for p in look if p.accepted and _surely_more(search, p.blocks, place)]
    if not ranked:
        return []
    best = ranked[0]
    # what contains it has to be better than it with any other effect, too, in the next round
    simpler = [p for p in ranked if p.name in effect_class(best.name).includes]
    # one effect in the place of another explains with fewer than two beside each other
    price = search.decisions.wider_nats
    simpler += [
        p for p in ranked if set(effect_class(p.name).includes) & set(added) and best.rank < p.rank + price
    ]
    return [*simpler, *(p for p in ranked if all(p is not s for s in simpler))]


@dataclass(frozen=True)
class _Entry:
    """A candidate at one of its starts: its columns, their labels, and base parameters that it takes the place of."""

    name: str
    start: Start
    columns: tuple[int, ...]
    labels: tuple[str, ...]
    at: Array
    low: Array
    high: Array
    dropped: Labels


@torch.no_grad()
def looked(search: Search, place: FittedPhysics, frequencies: Sequence[float] = ()) -> Look:
    """What the candidates of a search would explain beside some physics."""
    space, about = place.at.of.space, place.at.about
    names = candidate_names(place.system, search.candidates)
    places, base = space.chunks.places(), 1 + place.best.free
    folds = folds_of(search.decisions, *places)
    within = {name for name in names if issubclass(effect_class(name), ByRun)}
    of_runs = folds_of(search.decisions, *places, of_each_run=True) if within else None
    longest = max(b - a for a, b in space.steps.segments)
    proposals = list[Explained]()
    for entries, columns in _side_by_side(search, place, names, frequencies):
        apart = [slice(entry.columns[0], entry.columns[-1] + 1) for entry in entries]
        held = grams(space, place.at.levels, about, place.at.at, columns, apart=apart)
        table = GramTable(held, base, folds)
        parts = table if of_runs is None else GramTable(held, base, of_runs)
        best: dict[str, _Step] = {}
        for entry in entries:
            of_label = dict(zip(entry.labels, entry.columns[1:], strict=True))
            for held_at_nothing in alone(entry.name, entry.labels):
                free = (c for label, c in of_label.items() if label not in held_at_nothing)
                step = _stepped(parts if entry.name in within else table, entry, (entry.columns[0], *free))
                if step is not None and (entry.name not in best or step.rank > best[entry.name].rank):
                    best[entry.name] = step
        proposals += [
            _proposed(search, place.system, table, step, len(names), longest) for step in best.values()
        ]
    return sorted(proposals, key=lambda p: -p.rank)


def _side_by_side(
    search: Search, place: FittedPhysics, names: Sequence[str], frequencies: Sequence[float]
) -> Iterator[tuple[list["_Entry"], torch.Tensor]]:
    """Candidates at each of their starts, a few at a time, and columns (T, C, ne, k) of the physics and then of these.

    Those of a whole catalogue are a hundred times as large as the log: of 203 s of a hexacopter's flight 260 MB.
    """
    space, about = place.at.of.space, place.at.about
    along = space.along(about.x, about.after)
    # in single precision: they are the largest of all
    base = space.columns(about.x, about.slopes, range(len(place.best.vector)), about.after).float()
    entries, tables = list[_Entry](), [base]
    for name in names:
        check_time()
        own: LogLikelihood | None = None
        for start in starts(place.system, name, place.at.of.sizes, frequencies):
            at = 1 + sum(table.shape[-1] for table in tables)
            try:
                own = own or place.at.of.of(joined(place.system, name, start), space.estimates)
                entry, columns = _columns(own, place, name, start, along, at)
            except (NsdeError, *_SINGULAR):
                continue
            if bool(torch.isfinite(columns).all()):
                tables.append(columns.float())
                entries.append(entry)
        if sum(table.shape[-1] for table in tables[1:]) > _COLUMNS:
            yield entries, torch.cat(tables, -1)
            entries, tables = [], [base]
    if entries:
        yield entries, torch.cat(tables, -1)


def _columns(
    own: LogLikelihood,
    place: FittedPhysics,
    name: str,
    start: Start,
    along: Along,
    at: int,
) -> tuple[_Entry, torch.Tensor]:
    """What a candidate does to the steps: by its start, beside the physics, and by each parameter.

    `own` is the likelihood with it, `along` what is known of the steps of the physics without it.
    """
    space, vector, about, labels = own.space, own.vector, place.at.about, place.best.vector.labels
    known, nothing = dict(zip(labels, place.best.theta.tolist(), strict=True)), effect_class(name).at_null()
    for key, value in start.items():
        if value == nothing.get(key):
            continue  # what is nothing depends on the data, and every start has the same
        alike = [j for j in vector.of(name) if own_name(vector.labels[j]) == key]
        each = value if isinstance(value, list) else [value] * len(alike)
        known |= dict(zip((vector.labels[j] for j in alike), each, strict=True))
    theta, mine = vector.inside(vector.first_values(known)), vector.of(name)
    missing = [j for j, label in enumerate(labels) if label not in vector.labels]
    sizes = vector.sizes(name) if effect_class(name).amplitudes else []
    if sizes and not missing and (np.abs(theta[sizes]) < _NOTHING * vector.scale[sizes]).all():
        # of no size it is the physics without it, whatever its shape
        space.use(np.where(np.isin(np.arange(len(theta)), sizes), 0.0, theta))
        moved = about.slopes.new_zeros(*about.x.shape[:2], space.ne, 1 + len(mine))
        which = [1 + mine.index(j) for j in sizes]
        moved[..., which] = space.columns(about.x, about.slopes, sizes, along=along)
    else:
        space.use(theta)
        moved = space.columns(about.x, about.slopes, mine, along=along, beside=True)
    places = tuple(range(at, at + 1 + len(mine))), tuple(vector.labels[j] for j in mine)
    values = theta[mine], vector.low[mine], vector.high[mine]
    return _Entry(name, start, *places, *values, 1 + np.array(missing, dtype=np.int64)), moved


@dataclass(frozen=True)
class _Step:
    """A linearised step of some parameters of a candidate from one of its starts."""

    entry: _Entry
    columns: tuple[int, ...]  # the shift of its start, then the parameters that it moves
    values: Array  # of all its parameters, after it
    blocks: Array  # nats of blocks left out (B,)
    fitted: float  # nats of all rows
    error: float  # standard error of the nats left out
    rank: float  # these nats less the price of the parameters


def _stepped(table: GramTable, entry: _Entry, columns: tuple[int, ...]) -> _Step | None:
    """A step of the parameters of a candidate in these columns, inside their bounds."""
    asked, free = len(columns) - 1, columns
    for _ in range(len(columns)):
        blocks, fitted, step = table.gain(free, entry.dropped)
        inside = [entry.columns.index(c) - 1 for c in free[1:]]
        there = entry.at[inside] + step
        out = (there < entry.low[inside]) | (there > entry.high[inside])
        if not out.any():
            break
        # what runs out of its bounds stays where it started: that alone may explain much, of a delay
        free = (free[0], *(c for c, o in zip(free[1:], out, strict=True) if not o))
    with np.errstate(over="ignore", invalid="ignore"):
        error = sum_error(blocks)
    if not isfinite(error):  # the filter has diverged (a shaft that hardens, declared linear)
        return None
    values = entry.at.copy()
    values[inside] = there
    rank = float(blocks.sum()) - table.price(asked - len(entry.dropped))
    return _Step(entry, free, values, blocks, fitted, error, rank)


def _proposed(
    search: Search, beside: System, table: GramTable, step: _Step, among: int, longest: int
) -> Explained:
    """What a candidate explains by the best of its steps, of which there is one per start and choice."""
    entry, sizes = step.entry, effect_class(step.entry.name).size_names()
    p = float(chdtrc(max(len(step.columns) - 1, 1), max(2.0 * step.fitted, 0.0)))
    labels = [label for label in entry.labels if own_name(label) in sizes]
    own = np.array([entry.columns[1 + entry.labels.index(label)] for label in labels], dtype=np.int64)
    errors = zip(table.errors(own).tolist(), table.errors_alone(own).tolist(), strict=True)
    p = bonferroni(p, among * starts_of(entry.name, entry.labels, longest))
    nats = float(step.blocks.sum())
    values = dict(zip(entry.labels, step.values.tolist(), strict=True))
    sure = nats, step.error, step.rank, p, p < search.level("effects") and nats > 0
    known = dict(zip(labels, errors, strict=True))
    return Explained(entry.name, beside, entry.start, values, *sure, step.blocks, known)


def _set(system: System, values: Mapping[str, float]) -> None:
    effects = {str(e.name): e for e in system.effects if isinstance(e, Effect)}
    of: dict[tuple[str, str], list[float]] = {}
    for label, value in values.items():
        of.setdefault((label.partition(".")[0], own_name(label)), []).append(value)
    for (effect, own), column in of.items():
        effects[effect].set_value(own, torch.tensor(column, dtype=torch.float64))


def _compared(search: Search, name: str, rival: str, place: FittedPhysics, there: FittedPhysics) -> float:
    """By how many nats a rival in the place of an effect is surely better; 0: indistinguishable; else -1.

    A rival that the effect contains replaces it unless it is surely worse; one that contains it is never its tie. One
    with fewer parameters need not be surely better: a small hidden mass stood in for a viscous friction, and a lag that
    rises and falls alike stayed beside it (a magnet's coil in a closed loop).
    """
    difference = there.at.blocks - place.at.blocks
    more = len(there.best.free) - len(place.best.free)
    gained = float(difference.sum()) - 0.5 * more * log(len(difference))
    sure = sure_nats(search, sum_error(difference))
    if name in effect_class(rival).includes:
        chance = chdtrc(max(more, 1), max(2.0 * float(difference.sum()), 0.0))
        return gained if gained > sure and chance < search.decisions.nested_alpha else -1.0
    if rival in effect_class(name).includes and gained > -sure:
        return max(gained, search.decisions.alike_nats)
    return gained if gained > (0.0 if more < 0 else sure) else 0.0 if gained > -sure else -1.0


def _surely_more(search: Search, nats: Array, place: FittedPhysics) -> bool:
    """Whether what is explained beside some physics, by block of time (B,), is surely more than nothing.

    Nats are half the square of a score. Where that scatters as it should, they are known to the root of twice their
    sum: what acts in a few blocks alone scatters over blocks, and is sure (a cubic damping at the highest speeds of a
    spring, 40 +- 36 nats by the scatter, tests/diagnosis/test_laws_beyond_the_catalogue.py).
    """
    whole = float(nats.sum())
    error = (2.0 * max(whole, 0.0) * place.best.inflation) ** 0.5
    return whole > sure_nats(search, min(sum_error(nats), error))


def sure_nats(search: Search, error: float) -> float:
    """Nats by which physics are surely better, from the standard error of their difference."""
    return max(search.decisions.alike_nats, search.decisions.alike_errors * error)
