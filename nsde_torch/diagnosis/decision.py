"""What is concluded: which effects count, what is left beyond chance, the verdict, and which findings are provisional.

The verdict is `unexplained` where what is left explains more than what was found, `no_effect` where nothing was found
and nothing is left. All differences of log-likelihood are in nats; the tests of structure bring half a nat per function
in noise, which is taken off first.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.candidates import effect_of, variable_of
from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.cross_validation import LARGER, HeldOut
from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.diagnosis.evidence import joint_nats_by_channel, nats_by_channel
from nsde_torch.diagnosis.feedback_bias import (
    FeedbackBiased,
    allowances,
    allowances_of_tests,
    chance_beyond,
    lengths_of_parameters,
)
from nsde_torch.diagnosis.joint_selection import FittedPhysics, JointSelection, fitted, sure_nats
from nsde_torch.diagnosis.outcome import Estimate, Found, Outcome, Refuted, Verdict, found_by, undecided
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.regressors import BEFORE
from nsde_torch.diagnosis.residual_tests import (
    Dependence,
    PhysicsResiduals,
    beyond_chance,
    dependences,
    overview,
)
from nsde_torch.diagnosis.search import (
    Search,
    bent_shape,
    fitted_system,
    moved_channels,
    repeats_seldom,
    without_effect,
)
from nsde_torch.diagnosis.shape import channel_residuals
from nsde_torch.effects import effect_class
from nsde_torch.effects.by_run import BY_RUN, target_of
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.forces import HiddenSwing
from nsde_torch.effects.law import split_name
from nsde_torch.sysid.feedback_test import ALPHA, FeedbackTest
from nsde_torch.sysid.guard import Guarded, doubts_the_fit, guarded
from nsde_torch.sysid.readings import LESS
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.rough import log_share
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

_NO_SMALLER = "the residual on runs left out is no smaller with what was found"


def selection(search: Search, joint: JointSelection | None, system: System) -> Outcome:
    """What the joint likelihood selected, not judged yet; nothing where that could not be computed (None)."""
    if joint is None:
        declared = search.quick(system)
        return undecided(search, declared, declared)
    declared = search.at(joint.declared)
    final = search.at(joint.final) if joint.selected else declared
    return undecided(search, declared, final, found_by(search, joint), joint)


def set_aside(search: Search, chosen: Outcome, log: Log) -> Outcome:
    """Effects that explain more than feedback may hide; the others are dropped, the weakest first.

    What one brought beside all others it brings at least beside fewer: physics without it are fitted again only where
    that is not enough any more (of six racing flights, NeuroBEM, each takes 6 to 10 s).
    """
    base, joint, hidden = chosen.final, chosen.joint, list(chosen.hidden)
    if joint is None:
        return replace(chosen, test=log.loop(base))
    tested = log.loop(base, joint.final)
    among = max(joint.candidates, 1)
    known: dict[str, dict[str, float]] = {}
    while joint.selected:
        lengths = lengths_of_parameters(tested, base)
        # by what it brings less than that: of several that all could be feedback the chance is 1, and of the drive of
        # `nsde benchmark emps` the frictions went before a force that brought nothing
        weakest: tuple[float, str, tuple[str, ...]] | None = None
        for name, one in joint.selected.items() if lengths else ():
            moved, allowed, count = _hidden(tested, lengths, base, name, cut=bool(log.moments))
            if not set(moved) & set(lengths):
                continue
            enough = search.level("effects") / among
            if name in known and chance_beyond(known[name], moved, allowed, count) < enough:
                continue
            nats = _brought(one.without, joint.final, base, partial(search.at, one.without))
            brought = known[name] = {channel: 2.0 * value for channel, value in nats.items()}
            if chance_beyond(brought, moved, allowed, count) < enough:
                continue
            beyond = sum(brought[c] - allowed.get(c, 0.0) for c in moved)
            if weakest is None or beyond < weakest[0]:
                weakest = (beyond, name, tuple(c for c in moved if c in allowed))
        if weakest is None or log.shown(fitted_system(base), weakest[1]):
            break
        _, name, channels = weakest
        hidden.append(FeedbackBiased(name, channels))
        joint = _still_needed(search, joint.less(name))
        base = search.at(joint.final)
        tested = log.loop(base, joint.final)
    found = found_by(search, joint)
    return replace(chosen, final=base, found=found, joint=joint, hidden=tuple(hidden), test=tested)


def _brought(
    before: FittedPhysics, after: FittedPhysics, base: Regression, first: Callable[[], Regression]
) -> dict[str, float]:
    """What physics explain beyond others, by channel of the regression `base` at the former [nats]."""
    names = [base.physics.names[c] for c in base.rows]
    return joint_nats_by_channel(before, after, names) or nats_by_channel(first(), base)


def _brought_by_all(outcome: Outcome) -> dict[str, float]:
    """What an outcome's physics explain beyond the declared ones, by channel [nats]."""
    if outcome.joint is None:
        return nats_by_channel(outcome.declared, outcome.final)
    return _brought(outcome.joint.declared, outcome.joint.final, outcome.final, lambda: outcome.declared)


def _still_needed(search: Search, joint: JointSelection) -> JointSelection:
    """The selection without effects that bring nothing beside fewer, the weakest first.

    Without a damping that feedback may have made a flapping moment of a quadrotor brought -2 nats, and was named.
    """
    while joint.selected:
        sure = {
            n: e.nats - sure_nats(search, e.error)
            for n in joint.selected
            for e in [joint.evidence(search, n)]
        }
        weakest = min(sure, key=lambda n: sure[n])
        if sure[weakest] > 0:
            break
        joint = joint.less(weakest)
    return joint


def _hidden(
    test: FeedbackTest,
    lengths: Mapping[str, Array],
    regression: Regression,
    name: str,
    *,
    cut: bool = False,
) -> tuple[tuple[str, ...], dict[str, float], int]:
    """Channels that an effect moves, what feedback may hide of it there (2 log L), and number of its parameters.

    `cut`: whether runs were cut where something changes (`within_runs`).
    """
    # what moves nothing (a limit that no input reaches any more) brings nothing
    moved = moved_channels(regression, name) or tuple(lengths)
    own = regression.vector.of(name)
    if (target_of(name) or split_name(name)[0] in BY_RUN) and not cut:
        # what feedback does goes with how a run is flown, and does not change in the middle of one. By what all runs
        # have in common alone, gains that differ were named in flights of which nothing is missing (closed_loop.py,
        # regimes b and c)
        return moved, {c: test.hidden.get(c, 0.0) ** 2 for c in lengths}, len(own)
    # not of its shapes: feedback may bias the width of EMPS's friction by 68 standard errors, its size by 21
    return moved, allowances(lengths, regression.vector.sizes(name)), len(own)


def feedback_made(search: Search, log: Log, before: FittedPhysics, after: FittedPhysics) -> bool:
    """Whether feedback may have made all that some effects brought, by which two physics differ: see `set_aside`."""
    base = search.at(after)
    tested = log.loop(base, after)
    lengths = lengths_of_parameters(tested, base)
    if not lengths:
        return False
    nats = _brought(before, after, base, lambda: search.at(before))
    brought = {channel: 2.0 * value for channel, value in nats.items()}

    def made(name: str) -> bool:
        moved, allowed, count = _hidden(tested, lengths, base, name, cut=bool(log.moments))
        beyond = chance_beyond(brought, moved, allowed, count) < search.level("effects")
        return not (beyond or log.shown(fitted_system(base), name))

    return all(map(made, set(after.system.effect_names) - set(before.system.effect_names)))


def decide(search: Search, chosen: Outcome, alone: FittedPhysics | None = None) -> Outcome:
    """Test what is left with and without the effects, and conclude.

    `alone` is the declared physics where nothing could be selected; None: nothing is tested.
    """
    declared, base, joint, found = chosen.declared, chosen.final, chosen.joint, chosen.found
    place = alone if joint is None else joint.final
    before = None
    if found and joint is not None:  # first: scores of the final physics are asked for again by what follows
        before = overview(PhysicsResiduals(search, joint.declared, declared))
    after = [] if place is None else dependences(PhysicsResiduals(search, place, base))
    levels = search.levels(*(["effects"] if found else []))
    known = inputs_know(after, chosen.test)
    allowed = allowances_of_tests(chosen.test, known)
    # what arithmetic leaves has structure, and means nothing
    left = [] if base.arithmetic else beyond_chance(after, allowed, alpha=levels["structure"])
    explained = 0.0 if joint is None else joint.final.best.likelihood - joint.declared.best.likelihood
    rest = max((d.excess for d in left), default=0.0)
    brought = _brought_by_all(chosen)
    found = [replace(f, moves=moved_channels(base, f.name)) for f in found]
    abrupt = abrupt_changes(declared, base, found, search.decisions)
    for i, f in enumerate(found):
        why = _moved_from_outside(f, left, base.vector.system) or _bent(base, f.name)
        why = why or provisional_reason(f, left, brought, search.decisions)
        why = why or _unshown(base, f.name) or _slow(search, base, f.name) or _of_many(f, found, chosen.test)
        why = why or next((text for channel, text in abrupt.items() if channel in f.moves), "")
        why = why or _shared(f, found, base.vector.system)
        found[i] = replace(f, provisional=why)
    found = beside_provisional(found)
    verdict: Verdict = "effect_found" if found else "no_effect"
    if rest > explained if found else left:
        verdict = "unexplained"
    return replace(
        chosen,
        verdict="undecided" if place is None else verdict,
        found=found,
        before=after if before is None else before,
        after=after,
        structured=left,
        known=known,
        levels=levels,
    )


def inputs_know(tests: Sequence[Dependence], test: FeedbackTest) -> frozenset[str]:
    """Channels of a closed loop whose innovations inputs predict, and on which most is left of inputs a moment before.

    No lag and no delay explained that, so the controller saw more than the log. Of a motor and of a ball on a beam of
    which nothing was missing, whose loops ran faster on better sensors, "something has a memory", and both were
    `unexplained`.
    """
    if not (test.closed and test.predictive):
        return frozenset()
    most: dict[str, Dependence] = {}
    for d in tests:
        if d.p < ALPHA and (d.channel not in most or d.excess > most[d.channel].excess):
            most[d.channel] = d
    return frozenset(c for c, d in most.items() if d.variable.endswith(BEFORE))


def provisional_reason(
    f: Found, left: Sequence[Dependence], brought: Mapping[str, float], decisions: Decisions = DECISIONS
) -> str:
    """Why an effect is provisional: structure is left where it acts; empty where it is the last word.

    `brought` is the log-likelihood that the effects brought, by channel [nats].
    """
    rest = max((d.excess for d in left if d.channel in f.moves), default=0.0)
    return "something else is there too" if _too_much(rest, f, brought, decisions) else ""


def beside_provisional(found: Sequence[Found]) -> list[Found]:
    """The findings, laws beyond the catalogue provisional beside what is provisional on the channels that they move.

    Of a wall that loses heat `T_out flow` was sure, with an exchange, a lag and a law beside it that were not.
    """
    doubted = {c for f in found if f.provisional for c in f.moves}
    why = "what acts there beside it is provisional"
    return [
        replace(f, provisional=why)
        if is_law(f.name) and not f.provisional and not doubted.isdisjoint(f.moves)
        else f
        for f in found
    ]


_HANGS = 0.5  # share by which a size changes without what is provisional, from which it is provisional too


def dependent_on_provisional(outcome: Outcome) -> Outcome:
    """The outcome, effects provisional whose size is another one without what is provisional on their channels.

    Two terms that cancel fit as well as one law that nobody listed: beside two provisional laws of a magnet's gap a
    viscous friction was sure, 16 times too large.
    """
    joint, doubtful = outcome.joint, [f for f in outcome.found if f.provisional]
    moved = {channel for f in doubtful for channel in f.moves}
    sure = [f for f in outcome.found if not (f.provisional or moved.isdisjoint(f.moves))]
    if joint is None or not sure:
        return outcome
    system, declared = joint.final.system, joint.declared.system
    for f in doubtful:
        system = without_effect(system, declared, f.name) if f.name in system.effect_names else system
    before, after = joint.final.best, fitted(system, joint.final).best

    def changes(f: Found) -> bool:
        labels = [before.vector.labels[j] for j in before.vector.sizes(f.name)]
        if f.name not in system.effect_names or not {*labels} <= {*after.vector.labels}:
            return False
        one, other = (np.array([b.theta[b.vector.labels.index(n)] for n in labels]) for b in (before, after))
        return bool(np.linalg.norm(one - other) > _HANGS * np.linalg.norm(one))

    hanging = {f.name for f in sure if changes(f)}
    return outcome.provisional(
        lambda f: "its size hangs on what is provisional beside it" if f.name in hanging else ""
    )


_NEAR_ITS_OWN = 1.25  # times the frequency of what swings, or a part of it


def _moved_from_outside(f: Found, left: Sequence[Dependence], system: System) -> str:
    """Why a mass that is not in the log is provisional: near its frequency an oscillation is left, its phases its own.

    Of a quadrotor in a wind that came and went at 0.62 Hz a load of 4 % on a cable was sure, which swings at 0.60 Hz
    (tests/diagnosis/test_between_runs.py).
    """
    effect = effect_of(system, f.name)
    if not isinstance(effect, HiddenSwing):
        return ""
    own = float(effect.swing().detach()) / (2.0 * math.pi)
    for d in left:
        near = d.sinusoid is not None and 1.0 / _NEAR_ITS_OWN < d.sinusoid / own < _NEAR_ITS_OWN
        if near and d.channel in f.moves:
            return f"an oscillation of {d.sinusoid:.3g} Hz is left, near its own: a force from outside may move both"
    return ""


def judged_by_the_ceiling(outcome: Outcome, found: Ceiling) -> Outcome:
    """The outcome, given what functions explain beside the effects: structure, as tests find it.

    Where nothing was named, something is missing. Effects that act where functions explain as much as makes one
    provisional are leads, as a law that was not written down may be behind both; what is missing of the moments casts
    no doubt on a wind (Neural-Fly at 8.5 m/s, pulses below 1000 cut off: 318 nats of roll and pitch, 240 of a steady
    force). So are those beside much that such leads bring: the level of a motor whose back-EMF is missing was 38 % too
    high beside four of them. Where functions explain more than all effects, the verdict is `unexplained`.
    """
    if not found.rows:
        return outcome
    rest, decisions = found.left, outcome.decisions
    verdict: Verdict = "unexplained" if not outcome.found or rest > found.effects else outcome.verdict
    brought = _brought_by_all(outcome)

    def imitates(f: Found) -> str:
        own = sum(row.nats for row in found.rows if row.channels & {*f.moves})
        if not _too_much(own, f, brought, decisions):
            return ""
        return f"functions explain {own:.0f} nats more: it may imitate another law"

    outcome = outcome.provisional(imitates)
    doubtful = [f for f in outcome.found if imitates(f)]

    def beside(f: Found) -> str:
        own = sum(g.evidence.nats for g in doubtful if g is not f and {*g.moves} & {*f.moves})
        return "what acts there too may imitate another law" if _too_much(own, f, brought, decisions) else ""

    return replace(outcome.provisional(beside), verdict=verdict)


def _too_much(rest: float, f: Found, brought: Mapping[str, float], decisions: Decisions) -> bool:
    """Whether what is left in the channels of an effect is much beside what effects brought there, or it alone [nats].

    What is little beside a lag may be all that a dead band stands for: of an actuator that is slower downwards, a lag,
    a dead band and a law were sure, with 101 nats left beside 1350, 159 and 483.
    """
    whole = sum(brought[name] for name in f.moves)
    return rest > decisions.provisional_share * min(whole, max(f.evidence.nats, 0.0))


def _of_many(f: Found, found: Sequence[Found], tested: FeedbackTest) -> str:
    """Why a law beyond the catalogue is provisional: there are so many that they need more than an effect does.

    Three are what a library makes of one that it lacks: of a tyre that saturates, polynomials of what the slip is of.
    """
    if not is_law(f.name):
        return ""
    laws = sum(is_law(o.name) and not {*o.moves}.isdisjoint(f.moves) for o in found)
    if laws > 2:
        return f"{laws} laws act there, and together they may be one that no formula here has"
    if tested.closed and tested.predictive:
        return "inputs know what the log does not, and a law may stand for that"
    return "other laws explain as much" if any(map(is_law, f.ties)) else ""


def _shared(f: Found, found: Sequence[Found], system: System) -> str:
    """Why a term of one variable is provisional: with others it may share a law that nobody listed.

    With two others, a law beyond the catalogue among them, or with another law: a pull of 0.03 / (0.9 - q)^2 was two
    stops, two laws and a constant force, and a second relaxation of a battery two laws of its charge, one of them sure.
    """
    of = {str(effect.name): variable_of(effect) for effect in system.effects}
    own = of.get(f.name)
    alike = [o.name for o in found if own and {*o.moves} == {*f.moves} and of.get(o.name) == own]
    laws = sum(map(is_law, alike))
    many = len(alike) > 2 if laws == 1 else laws > 1
    return f"{len(alike)} terms of one variable may share a law that is not listed" if many else ""


def _bent(regression: Regression, name: str) -> str:
    """Why an effect is provisional whose shape is at an end.

    A mass that hardly resonates moves along: a ball that is hollow, and a pole that is 18 % longer, were hidden masses.
    """
    shape = bent_shape(regression.vector, regression.theta, name)
    if not shape:
        return ""
    why, labels = f"{shape} is at the end of what these data tell from another law", regression.vector.labels
    if not effect_class(name).estimated or f"{name}.mass" not in labels:
        return why
    share = regression.theta[labels.index(f"{name}.mass")]
    return f"{why}, and the machine may be as if its inertia were {share:.0%} larger"


def _unshown(regression: Regression, name: str) -> str:
    """Why an effect whose sizes are all unknown is provisional: losses of six motors, inputs of four dimensions."""
    sizes = regression.vector.sizes(name)
    return "" if not sizes or regression.shown.known[sizes].any() else "these data show none of its values"


def far_above_noise(before: Regression, after: Regression, decisions: Decisions) -> dict[str, float]:
    """Channels of which much more is left than white noise leaves, and how many times as much."""
    each = {c.name: c.times_noise for c in channel_residuals(before, after)}
    return {name: times for name, times in each.items() if times > decisions.far_above_noise}


def abrupt_changes(
    before: Regression, after: Regression, found: Sequence[Found], decisions: Decisions
) -> dict[str, str]:
    """Why what acts on a channel beside a drift is provisional: what changes at once leaves much of a drift."""
    drifting = {name for f in found if is_law(f.name) and "time" in f.name.split() for name in f.moves}
    far = far_above_noise(before, after, decisions) if drifting else {}
    text = "something changes with time, and {:.0f} times white noise is left: it may change at a moment"
    return {name: text.format(times) for name, times in far.items() if name in drifting}


def _slow(search: Search, regression: Regression, name: str) -> str:
    """Why what repeats in time is provisional: too seldom for anybody to know that it does (an encoder that jumps)."""
    few = repeats_seldom(search, regression.vector, regression.theta, name)
    fewest = search.decisions.least_periods
    return f"fewer than {fewest:g} periods of it are in the data" if few else ""


def guard_of(log: Log, outcome: Outcome) -> Guarded:
    """The final physics held against simple fits; the declared physics, where the columns are read in another way.

    Where inputs were restored from an average they know the future, and least squares that leave less say nothing of
    causes (the published flights: w_x 2.1 where the fit leaves 2.5 rad/s2, tested or not by the number of parameters).
    """
    regression = outcome.final
    basis = regression.shown.basis
    covariance = basis @ outcome.spread.covariance @ basis.T
    clock, declared = log.recorded.clock, ParameterVector(log.system)
    known = dict(zip(declared.labels, declared.start.tolist(), strict=True))
    first = regression.vector.first_values(known)
    found = guarded(regression, log.runs, clock=clock, covariance=covariance, first=first)
    if not outcome.inputs and {o.kind for o in found.objections} == {"least_squares"}:
        return replace(found, objections=(), half_90=(), units=())
    read = any(o.kind == "reading" for o in found.objections)
    if not read and (found.objections or not any(is_law(f.name) for f in outcome.found)):
        return found
    # laws make up for an angle that is counted from the other side (tests/diagnosis/test_declared.py); and beside a
    # gravity of any sign that side is as good as the other sign of the angle, of which the declared physics leaves less
    alone = outcome.declared
    without = guarded(alone, log.runs, clock=clock, first=alone.vector.first_values(known))
    # a law that leaves much less than the other reading does is none that makes up for it: a cable on a pendulum
    share = math.inf if read else sum(log_share(c.fit, c.measured) for c in found.channels)
    other = [o for o in without.objections if o.kind == "reading" and o.share < share + math.log(LESS)]
    return without if other else found


def doubted(outcome: Outcome, guard: Guarded) -> Outcome:
    """The outcome; where the guard speaks against the final physics, or it explains nothing, nothing found is sure.

    An objection to some channels speaks of what moves these alone: a hover in which no roll was seen, in moments that a
    loop at ten times the rate of the log commands, casts no doubt on a tilt of the thrust (Neural-Fly in still air,
    pulses below 1000 cut off).
    """
    if not guard.objections:
        return outcome
    against = doubts_the_fit(o.kind for o in guard.objections)
    why = "the fit is rejected" if against else "the physics explains next to nothing of what was measured"
    whole = all(guard.doubts(f.moves) for f in outcome.found)
    outcome = outcome.provisional(lambda f: why if guard.doubts(f.moves) else "")
    if not against:
        return outcome
    if whole:
        return replace(outcome, verdict="unexplained", doubted=True)
    return replace(outcome, doubted_channels=frozenset(c for o in guard.objections for c in o.channels))


_ANY = 10.0  # ends of a frequency's interval this many times apart: true hidden masses are known within a few percent


def sized(outcome: Outcome) -> Outcome:
    """The outcome, effects provisional that may be nothing by the intervals that are printed.

    Evidence compares fits; intervals also hold what feedback and a smoother's band may have done to the values. And
    what is named beside physics all of which may be nothing imitates it: of a force a part of which is late, a hidden
    mass of 72 % was sure beside such a gain, stiffness and damping (odd_springs.py, "pull in the past"). A hidden mass
    that may hardly resonate is an inertia: of a crane whose rope is a quarter longer than its class says, one of 0.238
    was sure, at 0.1 to 18 Hz; of a ball that is hollow one of 0.166, damped by 0.05 of the critical damping or more.
    """
    why, labels = "its size may be nothing by its interval", outcome.final.vector.labels
    declared = outcome.estimated(
        [j for j, name in enumerate(labels) if name in outcome.declared.vector.labels]
    )
    beside = "beside it all that is declared may be nothing, by its interval"
    beside = beside if declared and all(e.bound == "below" for e in declared) else ""

    def doubt(f: Found) -> str:
        if f.name not in hosts(outcome) and may_be_nothing(outcome, f):
            return why
        return beside or _hardly_resonates(outcome, f)

    return outcome.provisional(doubt)


def _hardly_resonates(outcome: Outcome, found: Found) -> str:
    """Why a hidden mass is provisional that may have any frequency, or any damping, by its intervals."""
    if not effect_class(found.name).estimated:
        return ""
    each = outcome.estimates(found.name)
    ends = [(e.low, e.high) for e in each if e.unit == "Hz"]
    unknown = any(not low or not high or high > _ANY * low for low, high in ends)
    if not unknown and not any(e.name.endswith(".damping") and e.bound == "above" for e in each):
        return ""
    share = next((f" {e.value:.0%} larger" for e in each if e.name.endswith(".mass") and e.value), "")
    return f"it may hardly resonate: an inertia{share} or a length that is declared wrong does the same"


def hosts(outcome: Outcome) -> set[str]:
    """Names of the effects whose sizes differ between runs: they may be nothing in the run others are held against."""
    return {target_of(f.name).partition("/")[0] for f in outcome.found} - {""}


def may_be_nothing(outcome: Outcome, found: Found) -> bool:
    """Whether an effect may be nothing by the intervals of its sizes."""
    nothing = effect_class(found.name).null
    sizes = [
        (e, nothing[name])
        for e in outcome.estimates(found.name)
        if (name := e.name.rpartition(".")[2].partition("[")[0]) in nothing and e.bound != "reference"
    ]

    # what is not shown is no reason to be sure: a steady force of two unknown axes, and of one that may be nothing, of
    # a quadrotor whose sensor was off its centre (docs/content/results/diagnosis.md, testers)
    def nothing_shown(e: Estimate, null: float) -> bool:
        if e.low is None or e.high is None:
            return e.bound in (None, "below")
        return e.bound == "below" or e.low <= null <= e.high

    return bool(sizes) and all(nothing_shown(e, null) for e, null in sizes)


def refuted(outcome: Outcome, errors: HeldOut) -> Refuted | None:
    """The effect that runs left out refute most, if they surely refute one: it is no finding.

    Of a free pole (physical-cartpole) two frictions were findings, provisional ones, without which the rest of the log
    was 67 and 18 nats likelier.
    """
    based_on = hosts(outcome)
    worse = {f.name: errors.refutes(f.name) for f in outcome.found if f.name not in based_on}
    name = max(worse, key=lambda n: worse[n], default="")
    return Refuted(name, worse[name]) if name and worse[name] > 0 else None


def judged_on_runs_left_out(outcome: Outcome, errors: HeldOut) -> Outcome:
    """The outcome, its effects provisional where runs left out speak against them.

    Where no residual there is surely smaller than without any effect, none is sure: of a quadrotor that hops with
    weights, by its own filtered states, a stop and an inertia were, with which it left 1.1 times as much; of 126
    other diagnoses none was. Where structure is left besides, or all residuals are larger, what was found stands
    for something else, and the verdict is `unexplained`: a drive with play and a shaft that twists was a lag, an
    arm with an elastic joint an input without strength, both surely. What acts on a channel whose residual grows is
    provisional, whatever it explains elsewhere: of a boat whose rudder alone is late a lag of both inputs was sure,
    and the residual along the keel half as large again.
    """
    # before any other reason: beside "something else is there too" it was printed that the log is likelier without it
    against = [replace(f, provisional=errors.against(f.name) or f.provisional) for f in outcome.found]
    outcome = replace(outcome, found=against)
    grows = {*errors.grows(outcome.decisions.provisional_share)} if errors.inputs else set[str]()

    def why_not(f: Found) -> str:
        channels = [name for name in f.moves if name in grows]
        return (
            f"the residual of {' and '.join(channels)} on runs left out is larger with the effects"
            if channels
            else ""
        )

    outcome = outcome.provisional(why_not)
    moved = {name for f in outcome.found for name in f.moves}
    structured, larger = any(d.channel in moved for d in outcome.structured), errors.larger(moved)
    if errors.smaller(moved):
        return outcome
    outcome = outcome.provisional(lambda _: LARGER if larger else _NO_SMALLER)
    return replace(outcome, verdict="unexplained") if structured or larger else outcome
