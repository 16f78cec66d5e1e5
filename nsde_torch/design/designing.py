"""From a question to a plan: fit what may be true, search, rehearse the best and the usual, and choose.

fit         members, or the one whose parameters are asked for, to the runs there are     members
search      inputs within the limits, judged without noise at several draws               proposals
rehearse    the best few and the usual ones, with noise, fitted as a measured run is      rehearsal
choose      the most evidence in the less favourable rehearsals, whichever is true   here
confirm     rehearse it anew: the best of several noisy rehearsals was lucky in them      here
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.design.experiment import Experiment, PlannedRun
from nsde_torch.design.limits import limits_of
from nsde_torch.design.members import Drive, Member, members_of, open_loop
from nsde_torch.design.options import DesignOptions
from nsde_torch.design.paths import Draw, Paths, flown_paths, flyable
from nsde_torch.design.proposals import Family, Judge, Precision, Signals, best_of_each, search, worth_of
from nsde_torch.design.questions import SURE, Question
from nsde_torch.design.rehearsal import Rehearsed, rehearse
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.progress import Say
from nsde_torch.systems import Multirotor, System
from nsde_torch.threads import one_thread

FINALISTS = 3
CONFIRMED = 2  # rehearsals of the plan that was chosen, over those that it was chosen by
APART = 0.05
"""Evidence below which members are not distinguished [nats]: rounding errors of one equation are smaller."""
_SEARCH = {False: (120, 12), True: (48, 6)}  # proposals and generations; flights take longer
_WIDER, _WIDE_ONES = 10.0, 16
_SLOWEST_SHARE, _FASTEST_SHARE = 1.0, 0.2


@one_thread()
def design(
    system: System,
    runs: Sequence[Run],
    question: Question,
    options: DesignOptions,
    *,
    clock: float = 1.0,
    values: Mapping[str, Any] | None = None,
    baselines: bool = True,
    say: Say = lambda stage, done, total: None,
) -> Experiment:
    """Plan the most informative experiment.

    Args:
        clock: Physical seconds per logged second.
        values: First values of effects, `{effect: {parameter: value}}`.
        baselines: Whether usual inputs are measured beside it.
        say: Told stage, number done and number in all.

    Raises:
        ConfigError: nothing stays within the limits, or a name that the system does not know.
        DataError: runs that an experiment cannot be planned from.
    """
    began = perf_counter()
    check_runs(system, runs)
    limits, start = limits_of(system, runs, options.limits), first_state(system, runs, options.start)
    say("fitting what may be true", 0, 1)
    members = members_of(system, runs, question, values or {}, clock=clock)
    rng = np.random.default_rng([options.seed, 11])
    dt, pilot = members[0].log.dt, members[0].system
    flies = isinstance(pilot, Multirotor)
    duration = max(run.duration for run in runs) * clock if options.duration is None else options.duration
    steps = max(round(duration / dt), 10)
    low, high = map(float, options.hertz or (_SLOWEST_SHARE / (steps * dt), _FASTEST_SHARE / dt))
    family: Family
    drive: Callable[[Array], Drive]
    if isinstance(pilot, Multirotor):
        family, drive = Paths(limits, dt, steps, start), partial(flown_paths, system=pilot, dt=dt)
    else:
        family, drive = Signals(limits, dt, steps, (low, high)), open_loop
    draw: Draw = partial(flyable, start=start, drive=drive) if flies else Member.draws
    draws = [draw(m, options.samples, rng) for m in members]
    precision = Precision.of(members[0], question.parameters) if question.parameters else None
    judge = Judge(members, precision, limits, start, draws, drive)
    finalists, most, most_use = search(
        judge,
        family,
        proposals=_SEARCH[flies][0] if options.proposals is None else options.proposals,
        generations=_SEARCH[flies][1] if options.generations is None else options.generations,
        keep=FINALISTS,
        rng=rng,
        say=say,
    )
    usual: list[PlannedRun] = []
    if baselines:
        longest = max(runs, key=len)
        before = longest.x[:, :3] if flies else longest.u
        say("judging usual inputs", 0, 1)
        usual = best_of_each(judge, family.baselines(rng, np.asarray(before)))
    if precision is None and max([most, *(p.worth for p in usual)]) < APART:
        _check_apart(question, judge, family, rng)
    plans = [*finalists, *usual]
    stages = 2 * len(members)

    def rehearsed(tables: Sequence[Array], count: int, stage: int) -> list[tuple[Rehearsed, ...]]:
        fly = partial(rehearse, members, start=start, limits=limits, drive=drive, draw=draw, rng=rng)
        out = []
        for i in range(len(members)):
            say("rehearsing", stage + i, stages)
            out.append(fly(np.stack(tables), truth=i, count=count))
        return list(zip(*out, strict=True))

    first = rehearsed([p.table for p in plans], options.rehearsals, 0)
    judged = [replace(p, rehearsed=own) for p, own in zip(plans, first, strict=True)]
    # a usual one is taken where none is better
    best = judged[int(np.argmax([_worth(plan, precision) for plan in judged]))]
    # the best of several noisy rehearsals was lucky in them: its expected evidence is worked out from others
    (again,) = rehearsed([best.table], CONFIRMED * options.rehearsals, len(members))
    say("rehearsing", stages, stages)
    return Experiment(
        system=system,
        question=question,
        members=tuple(members),
        plan=replace(best, rehearsed=again),
        baselines=tuple(judged[len(finalists) :]),
        limits=limits,
        start=start,
        dt=dt / clock,
        hertz=None if flies else (low, high),
        options=options,
        seconds=perf_counter() - began,
        most=most,
        most_use=most_use,
    )


def check_runs(system: System, runs: Sequence[Run]) -> None:
    """Refuse runs that an experiment cannot be planned from, by a DataError that says what stands in the way."""
    if any(run.inferred for run in runs):
        names = ", ".join(sorted({n for run in runs for n in run.inferred}))
        raise DataError(
            f"{names} were inferred from positions: what such a log would tell of an experiment is not worked out. Log "
            "the rates too."
        )
    if system.exogenous:
        raise DataError(
            f"the physics reads {', '.join(system.exogenous)}, which no plan can say. Leave out the effects that "
            "read it."
        )
    if system.quaternion is not None and not isinstance(system, Multirotor):
        raise DataError(
            f"{system.name!r} has an attitude and is no multirotor: no controller of the package flies it, and "
            "inputs of an open loop would not."
        )


def first_state(system: System, runs: Sequence[Run], given: Mapping[str, float]) -> Array:
    """Where an experiment begins: at rest where runs began, but for what is given, by names of states."""
    names = list(system.state_names)
    if system.quaternion is not None:  # hovering, in the middle of the flown range
        out = np.zeros(len(names))
        out[:3] = np.median(np.concatenate([run.x[:, :3] for run in runs]), axis=0)
        out[system.quaternion.start] = 1.0
    else:
        out = np.asarray(np.median([run.x[0] for run in runs], axis=0))
    for _, rate, _ in system.position_derivatives:
        out[names.index(rate)] = 0.0
    for name, value in given.items():
        if name not in names:
            raise ConfigError(f"`start` names {name!r}; {system.name!r} has: {', '.join(names)}.")
        out[names.index(name)] = float(value)
    return out


def _check_apart(question: Question, judge: Judge, family: Family, rng: np.random.Generator) -> None:
    """Refuse members that say the same of everything that was tried: one equation, or limits in the way."""
    wide = judge.limits.widened(_WIDER)
    tables = replace(family, limits=wide).inputs(family.random(_WIDE_ONES, rng))
    judged = replace(judge, limits=wide).judge(tables)
    at = int(judged.told.argmax())
    most = max(float(judged.told[at]), 0.0)
    apart = " from ".join(question.names)
    if most < APART:
        raise ConfigError(
            f"no experiment tells {apart}: whatever was tried, in ranges {_WIDER:g} times as wide as the limits too, "
            f"tells {most:.2g} nats or less, where {SURE:g} are wanted. They are one equation in this physics, or are "
            "fitted where they are. Measure by other means (weigh it, a motor on a stand), or name members that "
            "differ, members=[[EFFECT,...],[EFFECT,...]]."
        )
    name = wide.states[int(judged.use[at].argmax())]
    raise ConfigError(
        f"no experiment within the limits tells {apart}: what was tried tells less than {APART:g} nats, where {SURE:g} "
        f"are wanted. In ranges {_WIDER:g} times as wide one tells {most:.2g}, by {name} more than by other states: "
        f"widen limits.{name}{' and those of the inputs' if wide.open_loop else ''}, or plan a longer experiment "
        "(duration=...)."
    )


def _worth(plan: PlannedRun, precision: Precision | None) -> float:
    """What a plan was worth in rehearsal; less where it left a limit there."""
    left = sum(float((np.nan_to_num(r.use, nan=9.0).max(1) > 1.0).mean()) for r in plan.rehearsed)
    if precision is not None:
        return plan.worth - 10.0 * left
    # without noise it is linearised and may be far too large, in rehearsal of few noisy draws: the harmonic mean
    judged, seen = plan.worth, min(float(worth_of(r.evidence, 0)) for r in plan.rehearsed)
    least = min(judged, seen)
    return (least if least <= 0.0 else 2.0 * judged * seen / (judged + seen)) - 1e3 * left
