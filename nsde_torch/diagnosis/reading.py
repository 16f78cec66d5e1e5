"""The log of a diagnosis: how it is read, and how it is read again once something is known of the machine.

Runs have the logged channels that an effect could read, their recording chain undone: the declared physics is its
judge where kinematics cannot decide. A log is read again, and searched again,

- with rates that no sensor measured inferred by the physics that was come to: first the declared physics, fitted, then
  what was found. Regressions need them, and the likelihood does not;
- without the rows in which a machine with dry friction stands (`sysid.standstill`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import log
from typing import NamedTuple, TypeAlias

import numpy as np
import torch

from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.candidates import candidate_names, check_candidates, on_coordinates
from nsde_torch.diagnosis.decisions import Budgets, Decisions, Options
from nsde_torch.diagnosis.evidence import filtered_log
from nsde_torch.diagnosis.feedback_bias import shown_by_instruments
from nsde_torch.diagnosis.joint_selection import FittedPhysics, JointSelection
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.diagnosis.stages import MOVING_ROWS, Begun, OptionalStages
from nsde_torch.effects import effect_class
from nsde_torch.effects.by_run import RUN, target_of
from nsde_torch.effects.law import Law
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.inference import LogLikelihood
from nsde_torch.progress import Say
from nsde_torch.recording.chain import Recorded, undo
from nsde_torch.recording.fault import level
from nsde_torch.recording.unmeasured_rates import measured_part
from nsde_torch.sysid.feedback_test import FeedbackTest, tested
from nsde_torch.sysid.identify import identify_in_loop, with_rates
from nsde_torch.sysid.instruments import with_columns
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.standstill import SHARE, moving, slowest
from nsde_torch.systems import System
from nsde_torch.systems.coordinates import check_pushes

# by name of a run, the logged times between which something changes
Moments: TypeAlias = Mapping[str, tuple[tuple[float, float], ...]]
_CHECKED = 50  # rows of the data at which coordinates are checked


@dataclass(frozen=True)
class Log:
    """A log that was read, its recording chain undone."""

    system: System  # declared system, which reads the logged channels
    recorded: Recorded  # the recording chain, undone
    runs: tuple[Run, ...]  # its runs, with the logged channels behind the inputs
    options: Options  # settings
    decisions: Decisions  # what is decided by
    budgets: Budgets  # how much is tried
    say: Say  # called with stage, number done and number in all
    # speeds below which coordinates with dry friction stand, by column; rows in which one does are left out
    slowest: Mapping[int, float] = field(default_factory=dict)
    stages: OptionalStages = field(default_factory=OptionalStages)  # stages that may fail, and those that did
    # takes what is known after a stage (`stages.SELECTION` and those after it; None: within the selection)
    so_far: Callable[[str | None, Log, Outcome], None] = lambda stage, log, outcome: None
    begun: Begun | None = None
    """What an earlier diagnosis had selected, which the selection starts from; None: the declared physics."""
    moments: Moments = field(default_factory=dict)
    """Where runs were cut, by their names, as something changes there (`within_runs`)."""

    def cut(self, moments: Moments) -> Log:
        """The log with runs cut at moments of each."""
        recorded = replace(self.recorded, runs=cut_at(self.recorded.runs, moments))
        return replace(self, recorded=recorded, runs=cut_at(self.runs, moments), moments=moments)

    def numbered(self, order: Sequence[int] = ()) -> Log:
        """The log with a number of each run behind the inputs, those of an `order` first: the first one has 0."""
        order = [*order, *(r for r in range(len(self.runs)) if r not in order)]
        known = RUN in self.system.exogenous
        system = self.system.reading(RUN)
        at = system.nu + system.exogenous.index(RUN)

        def with_its(run: Run, r: int) -> Run:
            column = np.full(len(run), float(order.index(r)))
            u = np.column_stack((run.u[:, :at], column, run.u[:, at + known :]))
            return replace(run, u=u, extra={**run.extra, RUN: column})

        runs, recorded = (
            tuple(with_its(run, r) for r, run in enumerate(some)) for some in (self.runs, self.recorded.runs)
        )
        return replace(self, system=system, recorded=replace(self.recorded, runs=recorded), runs=runs)

    @property
    def by_number(self) -> tuple[str, ...]:
        """Names of the runs by their numbers; empty where they have none."""
        if RUN not in self.system.exogenous:
            return ()
        return tuple(run.name for run in sorted(self.runs, key=lambda run: float(run.extra[RUN][0])))

    def search(self, runs: Sequence[Run]) -> Search:
        """A search in runs of the log."""
        r = self.recorded
        return Search(
            self.system,
            moving(runs, self.slowest)[0] if self.slowest else runs,
            r.clock,
            self.options,
            inputs=not r.inputs_restored,
            stages=r.stages,
            moved=bool(r.values("sensor_delay") or r.values("sensor_lag")),
            decisions=self.decisions,
            # what a smoother did to states looks like laws (`ceiling`)
            budgets=replace(self.budgets, laws=0) if any(run.band for run in runs) else self.budgets,
            say=self.say,
            so_far=partial(self.so_far, None, self),
        )

    def identified(self, physics: System) -> Identification:
        """Physics identified as `nsde sysid` does: with signals from outside the loop where there are any."""
        return identify_in_loop(
            physics, self.runs, clock=self.recorded.clock, instruments=self.options.instruments
        )

    def loop(self, regression: Regression, place: FittedPhysics | None = None) -> FeedbackTest:
        """What a regression that has settled, at an optimum, says of the loop that the log was recorded in."""
        if self.recorded.inputs_restored:
            return FeedbackTest(why_not="the inputs were logged as an average and know the future")
        return self.stages.attempt(
            "the test of feedback",
            lambda: tested(regression, self.runs, filtered_log(place, regression) if place else None),
            FeedbackTest(why_not="it could not be computed"),
        )

    def shown(self, physics: System, effect: str) -> bool:
        """Whether signals from outside the loop show an effect of physics with fitted values."""
        if not self.options.instruments:
            return False
        found = self.stages.attempt(
            "estimates from signals outside the loop", lambda: self.identified(physics), None
        )
        alpha = level("effects", self.decisions.alpha, self.recorded.stages)
        return found is not None and shown_by_instruments(found, effect, alpha)


def cut_at(runs: Sequence[Run], moments: Moments) -> tuple[Run, ...]:
    """Runs, some of them cut at moments, without the rows between which each may be."""
    out: list[Run] = []
    for run in runs:
        begin, words = 0, ""
        for first, last in moments.get(run.name, ()):
            a, b = (int(at) for at in np.searchsorted(run.t, (first, last)))
            name = f"{words} to {first:.2f} s" if words else f"{run.name} before {first:.2f} s"
            if a - begin > 1:  # moments may be next to one another, and none is between two of them
                out.append(run.slice(begin, a, name=name))
            begin, words = b, f"{run.name} from {last:.2f}"
        out.append(run.slice(begin, len(run), name=f"{words} s") if words else run)
    return tuple(out)


def read_effects(system: System, runs: Sequence[Run], options: Options) -> None:
    """Register effects of one's own, first of all: they may read channels that no other does.

    Raises:
        DataError: an instrument is no column of the log.
        ConfigError: a candidate that the system cannot have.
    """
    own = check_candidates(system, options.candidates or (), options.also)
    if options.instruments:  # reported before any work
        with_columns(system, runs, options.instruments)
    reading = system.reading(*logged_channels(system, runs))
    able = candidate_names(reading)
    for name in on_coordinates(reading, options.candidates or ()):
        if name not in able:
            raise ConfigError(
                f"`candidates` names {name!r}, which {system.name!r} cannot have beyond its declared physics and the "
                f"logged channels; it could have: {', '.join(able)}."
            )
    for key, name in zip(options.also, own, strict=True):
        if not set(on_coordinates(reading, [name])) & set(able):
            cls = effect_class(name)
            raise ConfigError(
                f"`also` names {key!r}, which {system.name!r} cannot have: it acts on the port {cls.port.value!r} and "
                f"reads {', '.join(cls.exogenous) or 'no channel'}."
            )


def read_log(
    system: System, recorded: Recorded, options: Options, *, decisions: Decisions, budgets: Budgets, say: Say
) -> Log:
    """The log with its channels.

    Raises:
        DataError: there is no run.
    """
    runs = tuple(with_channels(system, recorded.runs))
    if not runs:
        raise DataError("no run to diagnose.")
    some = slice(None, None, max(1, len(runs[0]) // _CHECKED))
    x, u = (torch.from_numpy(values[some].copy()) for values in (runs[0].x, runs[0].u))
    check_pushes(system.with_effects().double(), x, u)
    system = system.reading(*logged_channels(system, runs))
    return Log(system, recorded, runs, options, decisions, budgets, say)


def logged_channels(system: System, runs: Sequence[Run]) -> tuple[str, ...]:
    """Logged columns, of all runs and without gaps, that an effect of the catalogue could read."""
    effects = system.able_effects()
    names = {name for cls in effects.values() for name in cls.exogenous}
    return tuple(
        n
        for n in sorted(names - set(system.exogenous))
        if all(n in run.extra and np.isfinite(run.extra[n]).all() for run in runs)
    )


def with_channels(system: System, runs: Sequence[Run]) -> list[Run]:
    """Runs with their `logged_channels` behind the inputs."""
    have = logged_channels(system, runs)
    if not have:
        return list(runs)
    return [replace(run, u=np.column_stack((run.u, *(run.extra[n] for n in have)))) for run in runs]


# ---- the recording chain -------------------------------------------------------------------------------


class Concluded(NamedTuple):
    """A log, a search in it, and what was concluded."""

    log: Log
    search: Search
    outcome: Outcome


def undone(
    data: DataSet,
    runs: Sequence[Run],
    system: System,
    options: Options,
    decisions: Decisions,
    budgets: Budgets,
) -> Recorded:
    """The recording chain undone as far as kinematics and spectra show it."""

    def misfit(some: Sequence[Run], clock: float) -> float:
        search = Search(system, some, clock, options, decisions=decisions, budgets=budgets)
        return sum(log(noise.std) for noise in search.quick(system).noises)

    seen = measured_part(system, {name for run in runs for name in run.inferred})
    return undo(data, runs, seen, alpha=decisions.alpha, misfit=misfit)


# ---- inferred rates ------------------------------------------------------------------------------------

_SLOWLY = "the residual still depends on time: it may change slowly"
_TURNS = 2  # of fits of the declared physics


def at_declared(log: Log) -> Log:
    """The log with inferred rates as the declared physics predicts them; the log itself where none are inferred."""
    system = log.system
    for _ in range(_TURNS if log.runs[0].inferred else 0):
        log = _at(log, system)
        system = fitted_system(log.search(log.runs).quick(system))
    return _at(log, system)


def at_found(now: Concluded, concluded: Callable[[Log, Search, JointSelection | None], Outcome]) -> Concluded:
    """The log with inferred rates as what was found predicts them, and what is concluded in it.

    The likelihood takes these rates for unmeasured: what it selected stays.
    """
    if not now.log.runs[0].inferred or not now.outcome.found:
        return now
    log = _at(now.log, now.outcome.system)
    search = log.search(log.runs)
    return Concluded(log, search, concluded(log, search, now.outcome.joint))


def not_sure(log: Log, outcome: Outcome) -> Outcome:
    """The outcome; no change at a moment is sure where the residual depends on time.

    A gain that fell as a motor warmed up, in 25 s, changed between 15.4 and 17.6 s, surely.
    """
    with_time = {d.channel for d in outcome.structured if log.moments and d.variable == "time"}
    return outcome.provisional(lambda f: _SLOWLY if target_of(f.name) and with_time & {*f.moves} else "")


def _at(log: Log, system: System) -> Log:
    return replace(log, runs=tuple(with_rates(system, log.runs, log.recorded.clock)))


# ---- standstill ----------------------------------------------------------------------------------------

MUCH_STANDSTILL = 0.3
"""Share of the rows in which a coordinate stands or turns round, beyond which friction may hold it."""


Searched: TypeAlias = Callable[[Log, Search, Outcome | None], Outcome]
"""Searches rows of a log, beginning with what was concluded from others."""


def where_it_moves(log: Log, search: Search, searched: Searched) -> Concluded | None:
    """What is concluded where it moves, of a machine that rests for much of the time; None unless it has dry friction.

    Friction may hold it so long that it is not found with the rows at rest, or looks like a deadband. And no fit of it
    may begin there: of a hydraulic cylinder (a Stribeck friction, 67 % at rest) every effect was tried in vain, and
    laws of its valve, for ten minutes (tests/diagnosis/test_standstill.py).
    """
    speeds, stands = _at_rest(log, search)
    if stands < MUCH_STANDSTILL:
        return None
    there = _in_moving_rows(log, None, speeds, searched)
    return there if there is not None and _dry(there) else None


def without_standstill(now: Concluded, searched: Searched) -> Concluded:
    """The log without the rows in which what has dry friction stands, and the search in it.

    It is taken where friction is found there too: what else was found with these rows may be how friction holds. Where
    friction is all that was found, and all rows are as predicted, there is nothing to look for: of an arm's Stribeck
    friction, exact after 60 s, rows that move went on for six minutes. Where nothing explains the structure that is
    left, whatever may have friction is looked at where it moves.
    """
    log, _, outcome = now
    speeds = _dry(now)
    if speeds and not log.slowest and _all_that_is_missing(outcome):
        return now
    if not speeds and not log.slowest:
        speeds, stands = _at_rest(log, now.search)
        if stands >= MUCH_STANDSTILL or outcome.found or not outcome.structured:
            return now  # the first search began where it moves, or nothing asks for it
        there = _in_moving_rows(log, None, speeds, searched)
        if there is None or not _dry(there):
            return now
        now, speeds = there, _dry(there)
    if speeds.keys() == now.log.slowest.keys():
        return now
    there = _in_moving_rows(now.log, now.outcome, speeds, searched)
    return now if there is None or not _dry(there).keys() >= speeds.keys() else there


def _all_that_is_missing(outcome: Outcome) -> bool:
    """Whether nothing but dry friction was found, and all rows are as predicted with it."""
    dry = [issubclass(cls, Law) and cls.dry for cls in (effect_class(f.name) for f in outcome.found)]
    best = None if outcome.joint is None else outcome.joint.final.best
    return all(dry) and not outcome.structured and best is not None and not best.misfit


def _at_rest(log: Log, search: Search) -> tuple[dict[int, float], float]:
    """Speeds whose direction is not known, of coordinates that may have dry friction, and the most that one rests."""
    std = search.quick(log.system).physics.sensor_std
    candidates = [log.system.effect_class(n) for n in candidate_names(log.system, search.candidates)]
    speeds = slowest(log.system, std, log.runs, candidates)
    return speeds, max((moving(log.runs, {j: v})[1] for j, v in speeds.items()), default=0.0)


def _in_moving_rows(
    log: Log, before: Outcome | None, speeds: Mapping[int, float], searched: Searched
) -> Concluded | None:
    """What is concluded without rows that are slower; None where these are too few, or too many.

    What stretches are left is asked first: a search that failed there passed for one that failed in all rows, whose
    effects were listed, and of a swing-up differences between runs were not looked for (physical-cartpole).
    """
    kept, share = moving(log.runs, speeds)
    if share < SHARE:
        return None
    moved = replace(log, slowest=speeds)
    try:
        LogLikelihood(log.system, kept, log.recorded.clock, run_in=True)
    except DataError:
        longest = max(b - a for run in kept for a, b in run.segments)
        log.stages.leave_out(
            MOVING_ROWS,
            f"without the rows in which it stands or turns round ({share:.0%}) stretches are too short to be fitted, "
            f"the longest {longest} rows ({longest * log.runs[0].dt:.2g} s): let it move one way for longer at a time, "
            "or log faster",
        )
        return None
    try:
        again = moved.search(log.runs)
        return Concluded(moved, again, searched(moved, again, before))
    except (DataError, NonFiniteError):
        return None


def _dry(now: Concluded) -> dict[int, float]:
    """Speeds whose direction is not known, of coordinates in which dry friction was found or declared."""
    return slowest(now.outcome.system, now.outcome.final.physics.sensor_std, now.log.runs)
