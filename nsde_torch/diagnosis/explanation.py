"""What is left, explained as far as it can be: in words, in one run, by a fault of the columns.

Where one run alone has something, the physics with everything that was found is fitted to that run, and the catalogue
is looked at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from nsde_torch.diagnosis.between_runs import RunZeros, between_runs
from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.channels import ChannelResidual, channel_residuals
from nsde_torch.diagnosis.declared import Warned, warnings
from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.estimates import Estimate
from nsde_torch.diagnosis.joint_selection import JointSearch
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import Shape, shape
from nsde_torch.diagnosis.views import rates
from nsde_torch.errors import DataError
from nsde_torch.inference import LogLikelihood
from nsde_torch.sysid.guard import Guarded
from nsde_torch.sysid.standing import moving
from nsde_torch.systems import System


@dataclass(frozen=True)
class InRun:
    """An effect that one run seems to have."""

    run: int  # number of the run
    effect: str  # name of the effect
    values: tuple[Estimate, ...]  # its parameters, fitted to that run
    p: float  # chance of it in that run, corrected for the number of candidates


@dataclass(frozen=True)
class Explanation:
    """What is left, and what may explain it."""

    channels: list[ChannelResidual]  # residuals before and after
    shapes: tuple[Shape, ...] = ()  # what the residual still depends on, in words
    between_runs: RunZeros | None = None
    """The sensor's zero that differs between runs, where structure is left."""
    in_run: InRun | None = None
    """The effect that would explain it in the one run that it is in: provisional, unverified."""
    warned: tuple[Warned, ...] = ()  # declared parameters that tell of a fault of the columns
    guard: Guarded = field(default_factory=Guarded)
    """How the final physics stands beside simple fits, and what speaks against it."""
    standing: float = 0.0  # share of the rows that were left out because what has dry friction stands in them
    ceiling: Ceiling = field(default_factory=Ceiling)  # what functions could still explain


def explained(
    log: Log,
    search: Search,
    outcome: Outcome,
    guard: Guarded,
    runs: tuple[str, ...],
    most: Ceiling,
) -> Explanation:
    """Describe what is left.

    Args:
        log: The log.
        search: That in all runs of the log.
        outcome: What was concluded.
        guard: The final physics held against simple fits.
        runs: Names of the runs.
        most: What functions could still explain.
    """
    regression, left = outcome.final.regression, outcome.structured
    attempt = log.stages.attempt

    def shaped() -> tuple[Shape, ...]:
        seen = rates(regression, outcome.variables)
        return tuple(shape(regression, d, outcome.variables, seen, runs) for d in left[: log.budgets.shapes])

    def zeros() -> RunZeros | None:
        return between_runs(regression, runs, tie=log.decisions.alike_nats) if left else None

    def alone() -> InRun | None:
        odd = odd_run(left, shapes)
        return None if odd is None else in_run(log, outcome.system, odd)

    shapes = attempt("the shape of what is left", shaped, ())
    return Explanation(
        channel_residuals(outcome.declared.regression, regression),
        shapes=shapes,
        between_runs=attempt("a sensor's zero that differs between runs", zeros, None),
        in_run=attempt("what is special about one run", alone, None),
        warned=attempt("odd declared values", lambda: tuple(warnings(outcome, log.system)), ()),
        guard=guard,
        standing=moving(log.runs, log.slowest)[1] if log.slowest else 0.0,
        ceiling=most,
    )


def odd_run(left: Sequence[Dependence], shapes: Sequence[Shape]) -> int | None:
    """Number of the run that what explains most of what is left is confined to, beside single moments.

    Args:
        left: What is left over, what explains most first.
        shapes: The first of them in words.
    """
    pairs = zip(left, shapes, strict=False)
    return next((s.only_run for d, s in pairs if d.moment is None), None)


def in_run(log: Log, system: System, run: int) -> InRun | None:
    """The effect that would explain a run, or None where none does.

    Args:
        log: The log.
        system: Physics with everything that was found.
        run: Number of the run.
    """
    alone = [log.runs[run]]
    search = log.search(alone)
    search.decisions = replace(search.decisions, most_effects=1)
    try:
        joint = JointSearch(
            search, LogLikelihood(system, alone, log.recorded.clock, run_in=True), system
        ).selected()
    except DataError:  # it moves too little to be fitted by itself
        return None
    for name in joint.selected:
        best = joint.final.best
        own = best.vector.of(name)
        values = tuple(
            Estimate(best.vector.labels[j], float(best.theta[j]), None, None, best.vector.units[j])
            for j in own
        )
        return InRun(run, name, values, joint.evidence(search, name).p)
    return None
