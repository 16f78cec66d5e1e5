"""What differs between the runs of a log: parameters, the mass, steady forces, zeros of sensors, effects of some runs.

    e_r = J theta + J_c d_r + noise in run r,      J_c the columns of a parameter, or of several that change together

The Gram matrix of each run says what a candidate c would explain there: one pass of physics and catalogue tells of all
candidates. Other runs cannot say what is special of one, so that numbers have a price (Schwarz) in place of evidence on
runs left out. The best candidates are fitted to the end, the best of those joins the physics, and all effects are
looked at again beside it.

This is asked after effects and laws of all runs, and where these leave something: what nobody declared biases runs in
which it acts in other ways, and differences between runs would take its place. Of states that were smoothed and inputs
that were restored it is not asked, as of functions (`ceiling`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import log

import numpy as np
from scipy.special import chdtrc

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.candidates import effect_of, joined, values_of
from nsde_torch.diagnosis.ceiling import silent
from nsde_torch.diagnosis.decision import far_above_noise, feedback_made
from nsde_torch.diagnosis.evidence import bonferroni, sum_error
from nsde_torch.diagnosis.joint_selection import (
    FittedPhysics,
    JointSearch,
    JointSelection,
    fitted,
    fitted_at,
    sure_nats,
)
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.possible_differences import ColumnsBeside, PossibleDifference, columns_beside
from nsde_torch.diagnosis.reading import Concluded, Log
from nsde_torch.diagnosis.regressors import MOST_RUNS
from nsde_torch.diagnosis.search import Search, repeats_seldom
from nsde_torch.diagnosis.within_runs import cut_where_it_changes
from nsde_torch.effects import Effect
from nsde_torch.effects.base import STRICTLY
from nsde_torch.effects.by_run import BY_RUN, RUN, ByRun
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import split_name
from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.sensitivity import half_squares, solved
from nsde_torch.sysid.guard import Guarded
from nsde_torch.sysid.standstill import moving
from nsde_torch.systems import System
from nsde_torch.systems.in_run import difference_on

_TRIED = 3  # candidates that are fitted to the end
_MOST = 3  # differences that are looked for


@dataclass(frozen=True)
class ExplainedDifference:
    """What a candidate would explain."""

    of: PossibleDifference
    each: Array  # numbers of each run (R, k), those of the first 0 where it is the reference
    nats: float  # log likelihood that it would bring, less the price of the numbers (Schwarz)

    def joined(self, numbers: Labels) -> System:
        """Physics with it; runs have these `numbers` in the column `run` (R,)."""
        each, system, target = self.each[np.argsort(numbers)], self.of.system, self.of.target
        if split_name(target)[0] in BY_RUN:
            cls = system.effect_class(target)
            assert issubclass(cls, ByRun)
            key = cls.numbers()
            for shared in (effect_of(system, name) for name in cls.includes if name in system.effect_names):
                each = each + shared.value(key).detach().double().numpy()
            out = joined(system, target, {key: each[cls.first :].T.ravel().tolist()})
        else:
            if self.of.new:  # what the reference has is that of all runs
                system = system.with_effects()
                effect, own = target.rsplit("/", 1)
                shared_by_all = effect_of(system, effect)
                spec, inside = shared_by_all.parameter(own), STRICTLY * shared_by_all.scale_of(own)
                low = -np.inf if spec.low is None else spec.low + inside
                high = np.inf if spec.high is None else spec.high - inside
                shared_by_all.set_value(own, np.clip(each[0], low, high).tolist())
            made, change = [], (each[1:] - each[0]).T
            for part in target.split(","):
                cls = difference_on(system, part)
                made.append(cls({"change": change[: cls.width].ravel().tolist()}))
                change = change[cls.width :]
            out = system.with_effects(*made)
        return out


def asked_for(outcome: Outcome, guard: Guarded) -> bool:
    """Whether something is left that differences between runs may explain.

    Steady forces of a cart that a controller holds are what inputs seem to know beyond the log (carts of
    `benchmarks/blind/run_differences.py`, seed 3). And functions may see what no test does: of a glider's airspeed,
    loud once a filter was undone, a brake that came out in one flight was left at 381 nats.
    """
    functions = None if outcome.joint is None else outcome.joint.functions
    left = outcome.structured or outcome.test.hidden or _one_is_odd(guard)
    return bool(left or (functions is not None and functions.nats))


def _one_is_odd(guard: Guarded) -> bool:
    """Whether a run is surely of another machine; all parameters may differ there."""
    return any(o.kind == "odd_run" for o in guard.objections)


def _instead(search: Search, joint: JointSelection) -> list[str]:
    """What was selected and may be there in the place of a difference.

    That is laws, what drifts, what hardly repeats, and what has numbers for each run. A gain that falls at a moment was
    a drift, surely, and a force that begins half a slow wave; zeros that differ made a law of the time (carts of
    `benchmarks/blind/run_differences.py`, seed 3). Masses that differ made waves of what inputs do (spring of seed
    8101).
    """
    best, effects = joint.final.best, joint.final.system.effects
    some = {e.name for e in effects if isinstance(e, Effect) and (e.drifts or isinstance(e, ByRun))}
    return [
        name
        for name in joint.selected
        if is_law(name) or name in some or repeats_seldom(search, best.vector, best.theta, name)
    ]


def with_differences(
    now: Concluded, guard: Guarded, conclude: Callable[[Log, Search, JointSearch, JointSelection], Outcome]
) -> Concluded:
    """The log with the numbers of its runs, and what is concluded of what differs between them; else all as it is."""
    log, search, outcome = now
    joint = outcome.joint
    # of the published flights, whose inputs know the future, five minutes of differences came to nothing
    if joint is None or silent(log) or len(log.runs) > MOST_RUNS:
        return now
    # they come back where they are needed: of zeros of an angle that differ laws made four, provisional ones
    instead = _instead(search, joint)
    asked = bool(instead) or asked_for(outcome, guard)
    # a friction that begins after a third of a run left 105 times white noise in which no test saw a structure
    all_of_it = asked or bool(far_above_noise(outcome.declared, outcome.final, search.decisions))
    log.say("what differs between runs", 0, _MOST)
    begun = joint.final
    if instead:
        begun = fitted(joint.final.system.without_effects(*instead), joint.final)
    apart = joint.final.at.of.apart_s
    odd = _one_is_odd(guard)
    columns = columns_beside(search, begun, together=odd, steady=not all_of_it)
    first = _best(search, begun, columns)
    whole = {run.name for run in log.runs}
    parts = cut_where_it_changes(log, search, begun, columns, {one.of.target: one.nats for one in first})
    if parts is not log:
        log, search = parts, parts.search(parts.runs).apart(apart)
        begun = fitted_at(_likelihood(log, begun), begun.system, None)
        first = _best(search, begun, columns_beside(search, begun, together=odd))
    if not first or not (asked or log.moments):
        return now
    there = sorted(set(begun.at.of.space.steps.runs))
    if len(there) < 2:  # of the others no stretch is long enough
        return now
    middle = there[reference(first[0].each, [log.runs[r].name not in whole for r in there])]
    numbered = log.numbered([middle, *(r for r in there if r != middle)])
    again = numbered.search(numbered.runs).apart(apart)
    declared = joint.declared.system.reading(RUN)
    known = _of_runs(joint.final.system)
    problem = _likelihood(numbered, begun, declared)
    made = JointSearch(again, problem, declared, aside=joint.aside)
    place = made.fitted(_under_numbers(begun.system, log, numbered), made.declared)
    other = made.fitted(_under_numbers(joint.final.system, log, numbered), place) if instead else place
    ties: dict[str, tuple[str, ...]] = {}
    timed = any("time" in law for law in instead)
    for count in range(_MOST):
        log.say("what differs between runs", count, _MOST)
        better, alike = _with_one(
            made, place, _best(again, place, columns_beside(again, place, together=odd))
        )
        # of a quadrotor's flights half of the time went into differences of gains that feedback may have made. Beside a
        # law of the time they are no worse than that (cart of seed 203, a force of each run)
        if better is None or (not timed and feedback_made(again, numbered, place, better)):
            break
        ties |= dict.fromkeys(_of_runs(better.system) - _of_runs(place.system), alike)
        place = better
    if not _of_runs(place.system) - known or _within_reach(made, place) < other.value:
        return now
    selected = made.concluded(place)
    if not (_of_runs(selected.final.system) - known and selected.final.value > other.value):
        return now
    named = {n: replace(one, ties=(*one.ties, *ties.get(n, ()))) for n, one in selected.selected.items()}
    return Concluded(numbered, again, conclude(numbered, again, made, replace(selected, selected=named)))


def _within_reach(made: JointSearch, place: FittedPhysics) -> float:
    """Value of some physics with all that its catalogue promises, added up [nats].

    Without a law that is right the search beside differences takes minutes and ends 2000 nats below it (an arm whose
    second joint is pulled by `sin(q1) q2`).
    """
    return place.value + sum(one.nats for one in made.look(place) if one.accepted)


def reference(numbers: Array, parts: Sequence[bool]) -> int:
    """Which run the others are held against, from numbers in each (R, k) and whether it is part of one that was cut.

    By the number that differs most: of six motors the one that breaks.

    The one in the middle: where one run has another load, that one is named. Where a run changes, the part of one that
    is nearest: held against a third run, short or odd, neither part of a motor's run differed, though they differ from
    each other (the prbs run of DCMotor.jl, beside 6 s of a step).
    """
    sizes = numbers[:, np.ptp(numbers, 0).argmax()]
    middle = np.sort(sizes)[(len(sizes) - 1) // 2]
    able = np.flatnonzero(parts) if any(parts) else np.arange(len(sizes))
    return int(able[np.abs(sizes[able] - middle).argmin()])


def _likelihood(log: Log, like: FittedPhysics, system: System | None = None) -> LogLikelihood:
    """That of a log, in rows as far apart as those of some physics, and without those at standstill where it is."""
    of, physics, clock = like.at.of, system or like.system, log.recorded.clock
    made = [LogLikelihood(physics, log.runs, clock, run_in=True, apart=of.apart_s)]
    if log.slowest:
        made.append(
            LogLikelihood(physics, moving(log.runs, log.slowest)[0], clock, run_in=True, apart=of.apart_s)
        )
    return min(made, key=lambda one: abs(len(one.space.steps) - len(of.space.steps)))


def _of_runs(system: System) -> set[str]:
    return {str(effect.name) for effect in system.effects if isinstance(effect, ByRun)}


def _under_numbers(system: System, before: Log, after: Log) -> System:
    """Physics of a log whose runs have other numbers, or none; what its effects have for each run stays with it."""
    out = system.reading(RUN)
    for effect in (e for e in system.effects if isinstance(e, ByRun)):
        was, now = ([int(run.extra[RUN][0]) for run in log.runs] for log in (before, after))
        old = effect.value(effect.numbers()).detach().double().numpy().reshape(effect.width, -1)
        new = np.zeros((effect.width, len(now)))
        for number, other in zip(was, now, strict=True):
            new[:, other] = old[:, number] if number < old.shape[1] else 0.0
        values = {**values_of(effect), effect.numbers(): new.ravel().tolist()}
        out = joined(out.without_effects(str(effect.name)), str(effect.name), values)
    return out


def _with_one(
    made: JointSearch, place: FittedPhysics, tried: Sequence[ExplainedDifference]
) -> tuple[FittedPhysics | None, tuple[str, ...]]:
    """The physics with the difference that explains most once it is fitted, and what explains as much; or None."""
    needed: list[tuple[float, FittedPhysics]] = []
    space = place.at.of.space
    column = space.vector.system.nu + space.vector.system.exogenous.index(RUN)
    first = space.steps.u[[a for a, _ in space.steps.segments], column].long().tolist()
    of_run = dict(zip(space.steps.runs, first, strict=True))
    numbers = np.array([of_run[r] for r in sorted(of_run)], dtype=np.int64)
    for one in tried[:_TRIED]:
        there = made.fitted(one.joined(numbers), place, place.best.likelihood)
        more = len(there.best.vector) - len(place.best.vector)
        risen = there.best.likelihood - place.best.likelihood
        p = bonferroni(float(chdtrc(more, max(2.0 * risen, 0.0))), len(tried))
        value = risen - 0.5 * more * log(len(there.at.blocks))
        sure = risen - more > sure_nats(made.search, sum_error(there.at.blocks - place.at.blocks))
        if p < made.search.level("effects") and sure:
            needed.append((value, there))
    if not needed:
        return None, ()
    value, best = max(needed, key=lambda one: one[0])
    alike = [  # which cannot be told from the best
        there
        for other, there in needed
        if value - other < sure_nats(made.search, sum_error(best.at.blocks - there.at.blocks))
    ]
    # of a pendulum whose load differs the inertia alone, and not all three of its parameters
    best = min(alike, key=lambda there: len(there.best.vector))
    alike = [there for there in alike if there is not best]
    return best, tuple(sorted(set().union(*(_of_runs(t.system) - _of_runs(place.system) for t in alike))))


# ---- what each would explain ---------------------------------------------------------------------------


def _best(search: Search, place: FittedPhysics, columns: ColumnsBeside) -> list[ExplainedDifference]:
    """What surely would explain something, the best start of each, the best first."""
    owner, _ = place.at.of.space.chunks.places()
    of_runs = np.stack([columns.blocks[owner == run].sum(0) for run in np.unique(owner)])
    best: dict[str, ExplainedDifference] = {}
    for one in columns.candidates:
        found = _explained(search, place, of_runs, one, len(columns.candidates))
        if found is not None and (one.target not in best or found.nats > best[one.target].nats):
            best[one.target] = found
    return sorted(best.values(), key=lambda d: -d.nats)


def _explained(
    search: Search, place: FittedPhysics, of_runs: Array, one: PossibleDifference, among: int
) -> ExplainedDifference | None:
    """What one of so many candidates explains with numbers for each run; None where that is not beyond chance.

    `of_runs` are the Gram matrices of the runs (R, 1 + K, 1 + K).
    """
    kept, k, first = np.concatenate(([0], 1 + place.best.free)), one.turn.shape[1], int(not one.new)
    count = len(kept)
    size = count + k * (len(of_runs) - first)
    total = np.zeros((size, size))
    total[:count, :count] = of_runs[:, kept[:, None], kept].sum(0)
    moved = np.flatnonzero(one.turn.any(1))
    turn = one.turn[moved]
    for number, own in enumerate(of_runs[first:]):
        at = slice(count + k * number, count + k * (number + 1))
        total[:count, at] = own[np.ix_(kept, 1 + moved)] @ turn
        total[at, :count] = total[:count, at].T
        total[at, at] = turn.T @ own[np.ix_(1 + moved, 1 + moved)] @ turn
    step, without = solved(total), solved(total[:count, :count])
    gained = float(half_squares(total[:count, :count], without) - half_squares(total, step))
    gained, parameters = gained / place.best.inflation, size - count
    nats = gained - 0.5 * parameters * log(len(place.at.blocks))
    p = bonferroni(float(chdtrc(parameters, max(2.0 * gained, 0.0))), among)
    if not (np.isfinite(nats) and nats > search.decisions.alike_nats and p < search.level("effects")):
        return None
    each = np.zeros((len(of_runs), k))
    each[first:] = step[count - 1 :].reshape(-1, k)
    return ExplainedDifference(one, each, nats)
