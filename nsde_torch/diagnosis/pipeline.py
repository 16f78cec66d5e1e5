"""From measured runs and a declared model to the effects that it lacks: the stages of a diagnosis, in order.

read            runs and logged channels, and options that fit the machine      reading
undo            faults of the recording chain; columns that are late            reading, recording, late_columns
fit             the declared physics: a regression, then the joint likelihood   search, inference
select          effects of the catalogue, one at a time; then each one again    joint_selection, feedback_bias
exclude         what feedback may have made                                     decision, feedback_bias
test, decide    what is left against all that was measured; the verdict         residual_tests, decision
beyond          laws that no catalogue has, where functions explain more        beyond_catalogue
cross-validate  the physics without and with effects on runs left out           cross_validation
ceiling         what functions of all that was measured could still explain     ceiling
explain         what is left, as far as it can be                               explanation
report          `Diagnosis`, and the content of `diagnosis.json`                result

A stage whose numbers fail, or that would not end in the time that is left, costs itself and not the run (`stages`),
but for the first search.

After the fit of the declared physics, each round of the selection and each later stage, what is known is given to
whoever listens, and kept for the case that the diagnosis is stopped. It is never less than before: a search that is
repeated (in other rows) is known once it has come to an end. How long all will yet take is rough: one more round of the
selection, and later stages as so many rounds, as they took on springs and flights.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import final

from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.between_runs import with_differences
from nsde_torch.diagnosis.beyond_catalogue import LawSearch, with_laws
from nsde_torch.diagnosis.candidates import candidate_names, of_each_run
from nsde_torch.diagnosis.ceiling import Ceiling, ceiling, silent
from nsde_torch.diagnosis.cross_validation import HeldOut, cross_validated, none_held_out
from nsde_torch.diagnosis.decision import (
    decide,
    dependent_on_provisional,
    doubted,
    far_above_noise,
    guard_of,
    judged_by_the_ceiling,
    judged_on_runs_left_out,
    refuted,
    selection,
    set_aside,
    sized,
)
from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions, Options
from nsde_torch.diagnosis.explanation import Explanation, explained
from nsde_torch.diagnosis.feedback_bias import (
    among,
    behind_smoothers,
    not_sure_behind_smoothers,
    with_suspects,
)
from nsde_torch.diagnosis.joint_selection import (
    Evidence,
    FittedPhysics,
    JointSearch,
    JointSelection,
    fitted_at,
)
from nsde_torch.diagnosis.late_columns import late_columns
from nsde_torch.diagnosis.outcome import Found, Outcome, undecided
from nsde_torch.diagnosis.periodicity import HIGHEST, lines
from nsde_torch.diagnosis.reading import (
    Concluded,
    Log,
    at_declared,
    at_found,
    cut_at,
    not_sure,
    read_effects,
    read_log,
    undone,
    where_it_moves,
    without_standstill,
)
from nsde_torch.diagnosis.regressors import MOST_RUNS
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.search import Search, at_bounds, fitted_system, moved_channels
from nsde_torch.diagnosis.shape import channel_residuals
from nsde_torch.diagnosis.stages import (
    CEILING,
    ERRORS,
    ESTIMATES,
    EXPLANATION,
    LAWS,
    MOVING_ROWS,
    NO_TIME,
    NOT_YET,
    OTHER_ROWS,
    SECOND_LOOK,
    SELECTION,
    STOPPED,
    TESTS,
    Begun,
    NotDone,
    OptionalStages,
    SoFar,
    StoppedError,
    needed,
)
from nsde_torch.effects.by_run import ByRun
from nsde_torch.inference import LogLikelihood
from nsde_torch.models.identified import SysidSpec
from nsde_torch.progress import Say
from nsde_torch.recording.chain import Recorded
from nsde_torch.recording.fault import Detected
from nsde_torch.sysid.guard import Guarded
from nsde_torch.sysid.identify import by_likelihood, dependence_on_band, identification
from nsde_torch.sysid.instruments import adopted
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.standstill import moving
from nsde_torch.systems import System
from nsde_torch.time_limit import TimeLimit, TimeUpError, check_time


def give_back() -> None:
    """Return freed memory to the system; nothing where the C library has no `malloc_trim`."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


_ROUNDS: Mapping[str, float] = {  # in order, and how long each takes, in rounds of the selection
    SELECTION: 1.0,
    SECOND_LOOK: 0.5,
    TESTS: 0.2,
    LAWS: 0.5,
    OTHER_ROWS: 1.5,
    ESTIMATES: 0.2,
    ERRORS: 1.0,
    CEILING: 1.0,
    EXPLANATION: 0.2,
}
_ORDER = list(_ROUNDS)
_UNFINISHED = "the diagnosis is not finished"


@final
class DiagnosisCourse:
    """What a diagnosis does and knows.

    Attributes:
        guard, errors, ceiling, instrumented: What is known beside the outcome, as far as stages are done.
        limit: Of time. It ends nothing before something is known.
    """

    def __init__(
        self,
        data: DataSet,
        options: Options,
        spec: SysidSpec,
        *,
        say: Say,
        so_far: Callable[[Diagnosis], None],
    ) -> None:
        self.data, self.options, self.spec = data, options, spec
        self.guard, self.ceiling = Guarded(), Ceiling(NOT_YET)
        self.errors: HeldOut | None = None
        self.instrumented: Identification | None = None
        self._seconds: dict[str, float] = {}
        self._tell, self._so_far = say, so_far
        self._found: Diagnosis | None = None
        self._during = ""
        self._done = self._rounds = 0
        self._began = self._lapped = perf_counter()
        self._round_s = 0.0
        seconds = None if options.max_minutes is None else 60.0 * options.max_minutes
        # a round of a boat's log took seven minutes without a line
        self.limit = TimeLimit(seconds, lambda: self._tell(self._during, 0, 1))
        self.limit.holds = False

    def lap(self, name: str) -> None:
        """Note the time since the last call."""
        now = perf_counter()
        self._seconds[name], self._lapped = now - self._lapped, now

    def say(self, stage: str, done: int, total: int) -> None:
        """Tell that `done` of `total` pieces of a stage are done."""
        if self._done == _ORDER.index(OTHER_ROWS):
            stage = f"second search, {stage}"
        if stage != self._during:
            give_back()
        self._during = stage
        check_time()
        self._tell(stage, done, total)

    def diagnosis(
        self, log: Log, outcome: Outcome, left: Explanation, not_done: Sequence[NotDone], so_far: SoFar | None
    ) -> Diagnosis:
        """The diagnosis with what is known."""
        data = replace(self.data, runs=cut_at(self.data.runs, log.moments)) if log.moments else self.data
        names, errors = tuple(run.name for run in log.runs), self.errors or none_held_out(log, None)
        known = Diagnosis(
            log.system,
            data,
            names,
            log.recorded,
            outcome,
            errors,
            left,
            self.options,
            self.spec,
            dict(self._seconds),
        )
        known = replace(known, so_far=so_far, moments=log.moments)
        return replace(known, instrumented=self.instrumented, not_done=tuple(not_done))

    def known(self, stage: str | None, log: Log, outcome: Outcome) -> None:
        """Keep what is known after a stage, and give it to whoever listens."""
        done = 0 if stage is None else _ORDER.index(stage) + 1
        if done < self._done:  # a search that is repeated
            return
        self._done = done

        def known() -> Diagnosis:
            channels = channel_residuals(outcome.declared, outcome.final)
            left = Explanation(channels, guard=self.guard, ceiling=self.ceiling)
            not_done = (*log.stages.not_done, *self._left(NOT_YET))
            provisional = outcome.provisional(lambda _: _UNFINISHED)
            return self.diagnosis(log, provisional, left, not_done, SoFar(left_s=self._left_s(stage)))

        found = log.stages.attempt("what was known before the end", known, None)
        if found is not None:
            self._found = found
            self.limit.holds = True
            self._so_far(found)

    def ended(self, why: str, after_min: float | None = None) -> Diagnosis | None:
        """What is known where Ctrl-C or the limit of time ends it; None while that is nothing."""
        if self._found is None:
            return None
        other = [one for one in self._found.not_done if one.why != NOT_YET]
        so_far = SoFar(stopped_during=self._during, after_min=after_min)
        return replace(self._found, not_done=(*other, *self._left(why)), so_far=so_far)

    def too_long(self, stage: str) -> bool:
        """Whether a stage would not end in the time that is left, as far as the rounds so far show."""
        return self._round_s * _ROUNDS.get(stage, 0.0) > max(self.limit.left_s, 0.0)

    def _left(self, why: str) -> list[NotDone]:
        return [NotDone(stage, why) for stage in _ORDER[self._done :]]

    def _left_s(self, stage: str | None) -> float | None:
        """Roughly how long all will yet take [s]; None before a round has ended."""
        if stage is None or stage == SELECTION:
            self._rounds += 1
        rounds = self._rounds - 1  # what is known first is the declared physics
        if rounds < 1:
            self._began = perf_counter()
            return None
        if stage is None or stage == SELECTION:
            self._round_s = (perf_counter() - self._began) / rounds
        return self._round_s * sum(_ROUNDS[one] for one in _ORDER[self._done :])


# ---- stages --------------------------------------------------------------------------------------------


def diagnose(
    system: System,
    spec: SysidSpec,
    data: DataSet,
    runs: Sequence[Run],
    options: Options,
    *,
    closed_loop: bool | None = None,
    decisions: Decisions = DECISIONS,
    budgets: Budgets = BUDGETS,
    begun: Begun | None = None,
    say: Say = lambda stage, done, total: None,
    so_far: Callable[[Diagnosis], None] = lambda found: None,
) -> Diagnosis:
    """Diagnose a declared model.

    Args:
        system: Declared system with first values.
        spec: The same as the specification of a model.
        data: The data set.
        runs: Its runs to look at.
        options: Settings.
        closed_loop: Whether inputs answer the state, which is reported beside errors under replayed inputs; None asks
            the test of feedback.
        decisions: What is decided by, but for alpha and the most effects, which the options give.
        budgets: How much is tried.
        begun: What an earlier diagnosis of the same had selected, from which this one continues.
        say: Told stage, number done and number in all.
        so_far: Takes what is known after each round of the selection and each later stage (`Diagnosis.so_far`).

    Raises:
        DataError: too few rows, or nothing moves.
        ConfigError: a candidate that the system cannot have.
        StoppedError: Ctrl-C once something was known; before, a plain KeyboardInterrupt.
    """
    course = DiagnosisCourse(data, options, spec, say=say, so_far=so_far)
    decisions = replace(decisions, alpha=options.alpha, most_effects=options.max_effects)
    try:
        with course.limit:
            return _diagnosed(course, system, runs, closed_loop, decisions, budgets, begun)
    except TimeUpError:
        found = course.ended(NO_TIME, options.max_minutes)
        assert found is not None  # the limit does not hold before
        return found
    except KeyboardInterrupt as stop:
        found = course.ended(STOPPED)
        if found is None:
            raise
        raise StoppedError(found) from stop


def _diagnosed(
    course: DiagnosisCourse,
    system: System,
    runs: Sequence[Run],
    closed_loop: bool | None,
    decisions: Decisions,
    budgets: Budgets,
    begun: Begun | None,
) -> Diagnosis:
    stages, say, options = OptionalStages(too_long=course.too_long), course.say, course.options
    read_effects(system, runs, options)

    def read(some: Sequence[Run], late: Sequence[Detected]) -> Log:
        say("checking the recording chain", 0, 1)
        recorded = stages.attempt(
            "faults of the recording chain",
            lambda: undone(course.data, some, system, options, decisions, budgets),
            Recorded(tuple(some), 1.0, ()),
        )
        log = read_log(system, recorded.after(late), options, decisions=decisions, budgets=budgets, say=say)
        return at_declared(replace(log, stages=stages, so_far=course.known))

    log = read(runs, ())
    search = log.search(log.runs)
    late = stages.attempt("columns that are late", lambda: late_columns(search, log), [])
    if late:
        chain = Recorded(tuple(runs), 1.0, tuple(late))
        log = read([chain.like(run, system) for run in runs], late)
        search = log.search(log.runs)
    log = stages.attempt("numbers of the runs", lambda: _numbered(log, search), log)
    search = log.search(log.runs) if log.by_number else search
    course.lap("recording")
    now = needed("the search for effects", partial(first_search, replace(log, begun=begun), search))
    now = now._replace(log=replace(now.log, begun=None))
    course.known(LAWS, now.log, now.outcome)

    def again(what: str, stage: Callable[[Concluded], Concluded]) -> Concluded:
        return stages.attempt(what, lambda: stage(now), now)

    def guarded() -> Guarded:
        return stages.attempt(
            "the comparison with simple fits", lambda: guard_of(now.log, now.outcome), Guarded()
        )

    now = again("rates inferred with what was found", lambda now: at_found(now, _concluded))
    now = again(MOVING_ROWS, lambda now: without_standstill(now, searched))
    now = now._replace(search=_of_the_same_rows(now.search, now.outcome.joint))
    course.guard, before = guarded(), now.outcome
    now = again(
        "what differs between runs", lambda now: with_differences(now, course.guard, _concluded_with_laws)
    )
    if now.outcome is not before:
        course.guard = guarded()
    log, search, outcome = now
    course.lap("search")
    course.known(OTHER_ROWS, log, outcome)

    def estimates(outcome: Outcome) -> Outcome:
        outcome = not_sure_behind_smoothers(doubted(outcome, course.guard))
        outcome, course.instrumented = stages.attempt(
            ESTIMATES, partial(_identified, log, outcome), (outcome, None)
        )
        return sized(outcome)

    def errors(outcome: Outcome) -> HeldOut:
        say(ERRORS, 0, 1)
        closed = outcome.test.closed_loop if closed_loop is None else closed_loop
        measured = partial(cross_validated, log, search, outcome, course.spec, closed_loop=closed)
        return stages.attempt(ERRORS, measured, none_held_out(log, closed))

    outcome = estimates(outcome)
    course.known(ESTIMATES, log, outcome)
    course.errors = errors(outcome)
    while (worst := refuted(outcome, course.errors)) is not None and outcome.joint is not None:
        less = partial(_concluded, log, search, outcome.joint.less(worst.name))
        rest = stages.attempt(f"what is left without {worst.name}", less, None)
        if rest is None:
            break
        now = now._replace(outcome=replace(rest, hidden=(*outcome.hidden, worst)))
        course.guard = guarded()
        outcome = estimates(now.outcome)
        course.errors = errors(outcome)
    course.lap("errors")
    outcome = not_sure(log, judged_on_runs_left_out(outcome, course.errors))
    course.known(ERRORS, log, outcome)
    course.ceiling = stages.attempt(
        CEILING, partial(ceiling, log, outcome), Ceiling("it could not be computed")
    )
    outcome = judged_by_the_ceiling(outcome, course.ceiling)
    outcome = stages.attempt(
        "what hangs on provisional effects", partial(dependent_on_provisional, outcome), outcome
    )
    course.lap("ceiling")
    course.known(CEILING, log, outcome)
    left = explained(log, search, outcome, course.guard, course.ceiling)
    no_time = any(s.why == NO_TIME for s in stages.not_done)
    so_far = SoFar(after_min=options.max_minutes) if no_time else None
    return course.diagnosis(log, outcome, left, stages.not_done, so_far)


def _numbered(log: Log, search: Search) -> Log:
    """The log, its runs numbered where something oscillates: a phase of each run is a candidate that needs the numbers.

    A force of 1.37 Hz that began each of three runs anew was a hidden mass of 1.5 %, surely
    (tests/diagnosis/test_between_runs.py).
    """
    of_runs = of_each_run(candidate_names(log.system, search.candidates))
    if not (of_runs and 1 < len(log.runs) <= MOST_RUNS):
        return log
    found = lines(search.quick(log.system), decisions=search.decisions)
    return log.numbered() if any(line.p < search.level("effects") for line in found) else log


def first_search(log: Log, search: Search) -> Concluded:
    """Search in all rows; or where it moves, of a machine that rests for much of the time and has dry friction."""
    there = log.stages.attempt(MOVING_ROWS, lambda: where_it_moves(log, search, searched), None)
    if there is None:
        return Concluded(log, search, searched(log, search))
    found = there.outcome.joint
    if found is None:
        return there
    some = among(search, [*found.selected])
    whole = log.stages.attempt(SELECTION, lambda: _selected(log, some, found)[1], None)
    if whole is None or _better(whole, found) is found:
        return there
    return there._replace(outcome=_concluded(there.log, there.search, whole))


def _better(whole: JointSelection, moving: JointSelection) -> JointSelection:
    """Effects as fitted to all rows, or to those that move, if other ones are there or all rows are not as predicted.

    A dry friction is identified best by how it changes at a turn, which rows that move lack. But how it holds is no law
    of the speed: where the rows do not fit it, it biases the rest (a damping of 0.265 for 0.3, test_named.py).
    """
    same = whole.selected.keys() == moving.selected.keys()
    return whole if same and (moving.final.best.misfit or not whole.final.best.misfit) else moving


def searched(log: Log, search: Search, before: Outcome | None = None) -> Outcome:
    """Fit the declared physics, select effects, test what is left, and decide.

    It begins with the effects that were concluded from other rows of the log (`before`), else with none.
    """
    search.say("fitting the declared physics", 0, 1)
    joint = None if before is None else before.joint
    made = log.stages.attempt(SELECTION, partial(_selected, log, search, joint), None)
    if made is None:
        return _concluded(log, search, joint)
    if joint is not None:
        return _concluded(log, search, _better(joint, made[1]))
    return _concluded_with_laws(log, search, *made)


def _concluded_with_laws(log: Log, search: Search, made: JointSearch, joint: JointSelection) -> Outcome:
    """Conclude, and look for laws that no catalogue has."""
    outcome = _concluded(log, search, joint)
    return log.stages.attempt(
        LAWS,
        lambda: with_laws(
            made,
            joint,
            outcome,
            partial(_concluded, log, search),
            of_functions=not silent(log),
        ),
        outcome,
    )


def _selected(
    log: Log, search: Search, before: JointSelection | None = None
) -> tuple[JointSearch, JointSelection]:
    """The search by the joint likelihood, and what it selects.

    Of rows further apart, where only these are as predicted: what a differentiated encoder, a friction that gives way
    or a smoother does within a few rows is no noise of this model, and noise levels then learn the physics (of a Dahl
    friction of 0.3 m/s2 nothing was found, and 114 nats so; behind the smoother of NeuroBEM a drag of 0.54 1/s, and so
    of 0.35). The declared physics decides: an effect that is missing stays seen in rows apart.
    """
    runs = moving(log.runs, log.slowest)[0] if log.slowest else log.runs
    declared = search.quick(log.system)
    # of first values that are far off, what is left would pass for noise
    system = fitted_system(declared)
    physics, brought = _begun_with(log, search, system, before)
    smoothed, whole = any(run.band for run in log.runs), search
    if smoothed and log.loop(declared).closed_loop:
        search = behind_smoothers(whole, log.system)
    frequencies = [line.frequency for line in lines(declared, decisions=search.decisions)]
    apart, share = search.decisions.apart_s, search.decisions.apart_share

    def of(apart: float) -> JointSearch:
        problem = LogLikelihood(system, runs, log.recorded.clock, run_in=True, apart=apart)
        # a force of 12.5 Hz was named in rows of 20 Hz (drive 0 of bench_friction_drive.py)
        some = [f for f in frequencies if f * apart < HIGHEST]
        return JointSearch(search, problem, system, some, given=log.system)

    made = of(0.0)
    if search.steps.dt < 0.5 * apart and made.declared.best.misfit:
        search.say(f"rows {apart:g} s apart", 0, 1)
        other = of(apart)
        # half: drive 1 of bench_friction_drive.py, where the past predicts 8 % of the innovations apart, 92 % of all
        driven = other.declared.best.driven
        if other.declared.best.worst(driven) < max(1.0, share * made.declared.best.worst(driven)):
            made = other
    made.laws = LawSearch(made, not silent(log))
    found = _begun_anew(search, made.selected(physics, brought, partial(_so_far, search)))
    return made, found if search is whole else with_suspects(found, whole, log.system)


def _begun_anew(search: Search, joint: JointSelection) -> JointSelection:
    """The selection, its physics fitted again from the regression's values where a size stands at its bound.

    While another effect is missing its work passes for noise, and a size can end at nothing: the damping of two stops
    (28.7 for 28.7 from the values of the regression, 1200 nats).
    """
    if not joint.selected:
        return joint
    declared, final = search.at(joint.declared), search.at(joint.final)
    sizes = [
        j
        for name in joint.selected
        if name in final.vector.system.effect_names
        for j in final.vector.sizes(name)
    ]
    if not (far_above_noise(declared, final, search.decisions) and at_bounds(final)[sizes].any()):
        return joint
    system = fitted_system(search.quick(fitted_system(final)))
    other = fitted_at(joint.final.at.of.of(system), system, None)
    risen = other.best.likelihood - joint.final.best.likelihood
    return replace(joint, final=other) if risen > search.decisions.alike_nats else joint


def _of_the_same_rows(search: Search, joint: JointSelection | None) -> Search:
    """The search, its regressions over means of the rows that effects were selected on."""
    return search if joint is None else search.apart(joint.final.at.of.apart_s)


def _begun_with(
    log: Log, search: Search, declared: System, before: JointSelection | None
) -> tuple[System | None, Mapping[str, float]]:
    """The physics that a selection begins with, and what each of its effects brought; None: the declared physics."""
    if before is not None and before.selected:
        return before.final.system, {name: before.evidence(search, name).nats for name in before.selected}
    if log.begun is None:
        return None, {}
    return log.begun.beside(declared), log.begun.nats


def _so_far(search: Search, first: FittedPhysics, place: FittedPhysics, brought: Mapping[str, float]) -> None:
    """What is known of effects before each is looked at again beside the others."""
    declared = search.at(first)
    final = search.at(place) if place is not first else declared
    found = [
        Found(name, Evidence(nats, 0.0, 0.0), (), moved_channels(final, name))
        for name, nats in brought.items()
        if name in place.system.effect_names and name not in first.system.effect_names
    ]
    search.so_far(undecided(search, declared, final, found))


def _concluded(log: Log, search: Search, joint: JointSelection | None) -> Outcome:
    """Exclude what feedback may have made, test what is left, and conclude."""
    search = _of_the_same_rows(search, joint)
    for effect in () if joint is None else joint.final.system.effects:
        if isinstance(effect, ByRun):
            effect.runs = log.by_number
    chosen = selection(search, joint, log.system)
    log.so_far(SECOND_LOOK, log, chosen)
    search.say("what feedback may have made", 0, 1)
    chosen = set_aside(search, chosen, log)
    search.say("testing what is left", 0, 1)
    alone = None
    if joint is None:
        likelihood = partial(LogLikelihood, log.system, log.runs, log.recorded.clock, run_in=True)
        alone = log.stages.attempt(TESTS, lambda: fitted_at(likelihood(), log.system, None), None)
    outcome = decide(search, chosen, alone)
    log.so_far(TESTS, log, outcome)
    return outcome


def _identified(log: Log, outcome: Outcome) -> tuple[Outcome, Identification | None]:
    """The outcome, with the estimates to print: by signals from outside the loop, or of largest likelihood."""
    clock = log.recorded.clock
    if outcome.joint is not None:
        place = outcome.joint.final
        band = dependence_on_band(place.system, place.best.theta, log.runs, clock, place.at.of.apart_s)
        outcome = replace(outcome, of_band=band)
    if log.options.instruments and not outcome.test.why_not:
        log.say("estimates from signals outside the loop", 0, 1)
        found = log.identified(outcome.system)
        outcome = replace(outcome, optimum=found.optimum)
        better = found.instrumented is not None and adopted(found.instrumented, outcome.test)
        if better or found.likelihood_used:
            outcome = replace(outcome, printed=found)
        return outcome, found
    if outcome.joint is None:
        return outcome, None
    log.say("estimates of largest likelihood", 0, 1)
    regressed = identification(outcome.final, "weak")
    regressed = replace(regressed, doubt=outcome.doubt, loop=outcome.test)
    near = (outcome.joint.final.system, outcome.joint.final.at)
    likeliest = by_likelihood(regressed, outcome.system, log.runs, clock, near)
    outcome = replace(outcome, optimum=likeliest.optimum)
    return (outcome if likeliest.likelihood is None else replace(outcome, printed=likeliest)), None
