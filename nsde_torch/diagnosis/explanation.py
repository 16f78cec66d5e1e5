"""What is left, explained as far as it can be: in words, in one run, between runs, by a fault of the columns.

**In one run.** Where one run alone has something, the physics with everything that was found is fitted to that run, and
the catalogue is looked at once.

**Between runs.** An encoder's zero may differ from run to run: which state, in which runs, and by how much. With X the
whitened slopes of the physics that was found and Z_r what the residual does when one position is read by one unit too
much in run r alone, least squares on the whitened residual e,

    e  ~  X d + sum_r Z_r b_r,        V = covariance of b from blocks of time (`spread`),

Q = (b - m)' (V^-1 on contrasts) (b - m) is chi-square with one degree of freedom less than there are runs where all
runs share one zero. What a steady push that differs from run to run would explain instead is held against it: where
that is as much, as on a linear spring, both are named. Looked for where structure is left alone.

**Columns.** A declared parameter may well stand at its bound. It indicates a fault where the data pull beyond: the step
without bounds

    d = argmin |e - X d|

leads out of the bound by several standard errors: a gain of an input that wants to be negative, as of a force that was
logged the wrong way round. Which column it is says the guard (`nsde_torch.sysid.guard`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import log10
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.decisions import Decisions
from nsde_torch.diagnosis.feedback_bias import unmeasured_gains
from nsde_torch.diagnosis.joint_selection import JointSearch
from nsde_torch.diagnosis.outcome import Estimate, Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.residual_tests import Dependence, PhysicsResiduals
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import ChannelResidual, Shape, channel_residuals, rates, shape
from nsde_torch.diagnosis.text import with_space
from nsde_torch.effects import effect_class
from nsde_torch.effects.coordinates import Bound
from nsde_torch.errors import DataError, NsdeError
from nsde_torch.evaluation.report import number
from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.spread import spread
from nsde_torch.sysid.guard import Guarded
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.standstill import moving
from nsde_torch.systems import System

_AT_BOUND = 1e-5  # typical sizes from the bound; values are kept a millionth off it


@dataclass(frozen=True)
class Warned:
    """A declared parameter that indicates a fault."""

    parameter: str  # its name
    kind: str  # `at_bound`, `far_off`, or `not_shown` where it ran off unseen
    sentence: str  # what is odd about it
    remedy: str  # what may be the cause, and what to look at


def declared(outcome: Outcome) -> dict[str, Estimate]:
    """Parameters that the system declared, fitted with everything that was found, by name.

    A gain at nothing that the loop may hide has no interval: it was not measured.
    """
    r = outcome.final.regression
    found = {f.name for f in outcome.found}
    columns = [j for j, label in enumerate(r.vector.labels) if label.partition(".")[0] not in found]
    hidden = unmeasured_gains(outcome)
    return {
        e.name: replace(e, low=None, high=None, bound=None) if e.name in hidden else e
        for e in outcome.estimated(columns)
    }


def warnings(outcome: Outcome, system: System) -> list[Warned]:
    """Declared parameters at a bound that the data pull beyond, and orders of magnitude from their first values."""
    r, decisions = outcome.final.regression, outcome.decisions
    v, basis = r.vector, r.shown.basis
    flat = r.slopes.reshape(-1, len(v))
    pull = basis @ np.linalg.lstsq(flat @ basis, r.white.reshape(-1), rcond=None)[0]
    error = np.sqrt(np.clip(np.diag(basis @ outcome.spread.covariance @ basis.T), 0.0, None))
    firsts = _firsts(system)
    out = []
    for name in declared(outcome):
        j = v.labels.index(name)
        value, unit = float(r.theta[j]), with_space(v.units[j])
        beyond = abs(pull[j]) > max(decisions.bound_errors * error[j], decisions.bound_sizes * v.scale[j])
        for bound, word, outward in ((v.low[j], "lower", pull[j] < 0), (v.high[j], "upper", pull[j] > 0)):
            if (
                abs(value - bound) <= _AT_BOUND * v.scale[j]
                and outward
                and beyond
                and not _nothing(name, bound)
            ):
                out.append(
                    Warned(
                        name,
                        "at_bound",
                        f"{name} stands at its {word} bound, {number(bound)}{unit}: freely, the data would make it "
                        f"about {number(value + pull[j])}{unit}",
                        _remedy(system),
                    )
                )
                break
        else:
            held = min(abs(value - v.low[j]), abs(value - v.high[j])) <= _AT_BOUND * v.scale[j]
            known = bool(r.shown.known[j])
            # physics that explains all may be of any size
            if not held and (not known or outcome.verdict == "unexplained"):
                out += _apart(
                    name,
                    value,
                    firsts.get(name, 0.0),
                    unit,
                    _remedy(system),
                    known=known,
                    decisions=decisions,
                )
    return out


def _apart(
    name: str, value: float, first: float, unit: str, remedy: str, *, known: bool, decisions: Decisions
) -> list[Warned]:
    """The warning about a value that is orders of magnitude from its first one, or none."""
    powers = abs(log10(value / first)) if value * first > 0 else 0.0
    if powers <= (decisions.far_powers if known else decisions.lost_powers):
        return []
    times = f"{10**powers:.2g} times {'above' if abs(value) > abs(first) else 'below'}"
    ran = "" if known else ", and the data do not show it: it ran off"
    sentence = f"{name} is {number(value)}{unit}, {times} its first value {number(first)}{unit}{ran}"
    kind = "far_off" if known else "not_shown"
    return [Warned(name, kind, sentence, f"right if the machine is like that; otherwise {remedy}")]


def _firsts(system: System) -> dict[str, float]:
    out: dict[str, float] = {}
    for name, (value, _) in system.all_declared().items():
        values = value.reshape(-1).tolist()
        out |= {name: values[0]} if len(values) == 1 else {f"{name}[{i}]": x for i, x in enumerate(values)}
    return out


def _nothing(label: str, bound: float) -> bool:
    """Whether an effect does nothing at this bound: that there is no friction is no fault."""
    effect, dot, own = label.partition(".")
    return bool(dot) and bound == 0.0 and own.partition("[")[0] in effect_class(effect).null


def _remedy(system: System) -> str:
    inputs = ", ".join(repr(n) for n in system.input_names) or "none"
    return (
        f"check signs, units and order of the inputs ({inputs}), and signs and origins of the states, against what the "
        "system declares; or something that acts is missing from the log"
    )


# ---- between runs --------------------------------------------------------------------------------------

_CHANCE = 1e-4
"""Chance of naming zeros that differ between runs that share one."""
_ODD = 4.0
"""Standard errors by which the zero of a run that is named stands apart from the middle of all runs."""
_SMALL = 1e-4  # shift of a position that slopes are taken over [its unit]
_90 = float(ndtri(0.95))


@dataclass(frozen=True)
class RunZeros:
    """A position whose zero differs between runs."""

    state: str  # the position
    unit: str
    # what it reads too much against the middle of the runs, with its standard error, by run that stands apart
    values: dict[str, tuple[float, float]]
    p: float
    """Chance of such differences between runs that share a zero, corrected for the number of positions."""
    nats: float  # log likelihood that they bring
    tie: str  # what explains as much; empty: nothing

    @property
    def sentence(self) -> str:
        """What was found."""
        each = [
            f"{run} {value:+.3g} +- {_90 * error:.2g} {self.unit}"
            for run, (value, error) in self.values.items()
        ]
        text = f"The zero of {self.state} differs between runs: {', '.join(each)} against the others (90 %)"
        return text + (f"; {self.tie} would explain as much." if self.tie else ".")

    @property
    def remedy(self) -> str:
        """The option of a reader that takes it out."""
        each = ",".join(f"{run}:{{{self.state}:{value:.4g}}}" for run, (value, _) in self.values.items())
        return f"data.sensor_bias={{{each}}}"

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        return {
            "state": self.state,
            "unit": self.unit,
            "runs": {run: {"value": v, "standard_error": error} for run, (v, error) in self.values.items()},
            "p": self.p,
            "tie": self.tie,
            "sentence": self.sentence,
            "remedy": self.remedy,
        }


def between_runs(regression: Regression, names: Sequence[str], *, tie: float) -> RunZeros | None:
    """The position whose zero surely differs between runs; None where there is none.

    Args:
        regression: The physics that was found, at its optimum.
        names: Names of the runs.
        tie: Log-likelihood difference below which two explanations are as good [nats].
    """
    owners = np.unique(regression.owners)
    places = [at for at in regression.vector.system.bound_coordinates() if at.position is not None]
    if len(owners) < 2 or not places:
        return None
    known = regression.slopes @ regression.shown.basis
    found = [one for at in places if (one := _zeros(regression, known, at, owners, names)) is not None]
    sure = [one for one in found if one.p * len(places) < _CHANCE and one.values]
    if not sure:
        return None
    best = max(sure, key=lambda one: one.nats)
    pushes = [_nats(known, _pushed(regression, at, owners), regression.white) for at in places]
    other = max(range(len(places)), key=lambda k: pushes[k])
    beside = f"a steady push on {places[other].words} that differs between them"
    return replace(best, p=best.p * len(places), tie=beside if pushes[other] > best.nats - tie else "")


def _zeros(
    regression: Regression, known: Array, at: Bound, owners: NDArray[np.int64], names: Sequence[str]
) -> RunZeros | None:
    columns = _shifted(regression, at, owners)
    slopes = np.concatenate([known, columns], 2)
    flat, white = slopes.reshape(-1, slopes.shape[2]), regression.white
    try:
        all_values = np.linalg.lstsq(flat, white.reshape(-1), rcond=None)[0]
        left = white - slopes @ all_values
        blocks = np.unique(regression.whitened_rows(regression.blocks), return_inverse=True)[1].reshape(-1)
        covariance = spread(slopes, left, blocks, 0).covariance
        own, count = known.shape[2], len(owners)
        b, v = all_values[own:], covariance[own:, own:]
        contrast = np.eye(count - 1, count) - np.eye(count - 1, count, 1)
        apart = contrast @ b
        q = float(apart @ np.linalg.solve(contrast @ v @ contrast.T, apart))
    except (np.linalg.LinAlgError, NsdeError):
        return None
    if not np.isfinite(q):
        return None
    middle = float(np.median(b))
    errors = np.sqrt(np.maximum(np.diag(v), 0.0))
    values = {
        names[r]: (float(value - middle), float(error))
        for r, value, error in zip(owners.tolist(), b, errors, strict=True)
        if abs(value - middle) > _ODD * error
    }
    state = regression.vector.system.state_names[at.position or 0]
    nats = _nats(known, columns, white)
    return RunZeros(state, dict(at.units)["position"], values, float(chdtrc(count - 1, q)), nats, "")


def _nats(known: Array, columns: Array, white: Array) -> float:
    """Log likelihood that columns of each run bring beyond one for all [nats]."""
    alike = np.concatenate([known, columns.sum(2, keepdims=True)], 2)
    apart = np.concatenate([known, columns], 2)
    rest = [_left(slopes, white) for slopes in (alike, apart)]
    return 0.5 * (rest[0] - rest[1])


def _left(slopes: Array, white: Array) -> float:
    flat, y = slopes.reshape(-1, slopes.shape[2]), white.reshape(-1)
    return float(np.square(y - flat @ np.linalg.lstsq(flat, y, rcond=1e-9)[0]).sum())


def _shifted(regression: Regression, at: Bound, owners: NDArray[np.int64]) -> Array:
    """What the whitened residual gains by each unit that a position is read too much, one column for each run."""
    physics = copy.copy(regression.physics)
    physics._remembered = None
    assert at.position is not None
    less = torch.zeros(physics.steps.x0.shape[1], dtype=torch.float64)
    less[at.position] = _SMALL
    steps = physics.steps
    physics.steps = replace(steps, x0=steps.x0 - less, x1=steps.x1 - less)
    change = regression.physics.residual(regression.theta) - physics.residual(regression.theta)
    regression.physics.vector.use(torch.as_tensor(regression.theta))
    return _columns(regression, change / _SMALL, owners)


@torch.no_grad()
def _pushed(regression: Regression, at: Bound, owners: NDArray[np.int64]) -> Array:
    """What the whitened residual gains by a steady unit push on a coordinate, one column for each run."""
    system, s = regression.vector.system, regression.physics.steps
    z = torch.cat((s.x0, s.x0.new_zeros(len(s), system.nz - system.nx)), 1)
    push = s.x0.new_zeros(len(s), at.width)
    push[:, at.row] = 1.0
    change = system.drift(s.t, z, s.u, {at.port: push}) - system.drift(s.t, z, s.u)
    turned = regression.physics.turn(s.dt * change[:, : system.nx], regression.physics.attitude)
    return _columns(regression, turned.numpy(), owners)


def _columns(regression: Regression, change: Array, owners: NDArray[np.int64]) -> Array:
    """A change over steps (N, nx) as whitened columns (channels, n, runs), each nothing beyond its run."""
    steps = regression.physics.steps
    of = np.repeat(np.array(steps.runs, dtype=np.int64), [b - a for a, b in steps.segments])
    apart = np.where(of[:, None, None] == owners, change[:, :, None], 0.0)
    summed = regression.single.summed(apart, regression.box)
    pairs = zip(regression.noises, regression.rows, strict=True)
    return np.stack([regression.whitened(noise, summed[:, c]) for noise, c in pairs])


# ---- all of it -----------------------------------------------------------------------------------------


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
    warned: tuple[Warned, ...] = ()  # declared parameters that indicate a fault of the columns
    guard: Guarded = field(default_factory=Guarded)
    """How the final physics stands beside simple fits, and what speaks against it."""
    standstill: float = (
        0.0  # share of the rows that were left out because what has dry friction stands in them
    )
    ceiling: Ceiling = field(default_factory=Ceiling)  # what functions could still explain


def explained(
    log: Log,
    search: Search,
    outcome: Outcome,
    guard: Guarded,
    runs: tuple[str, ...],
    most: Ceiling,
) -> Explanation:
    """Describe what is left."""
    regression, left = outcome.final.regression, outcome.structured
    attempt = log.stages.attempt

    def shaped() -> tuple[Shape, ...]:
        seen, joint = rates(regression, outcome.variables), outcome.joint
        if not left or joint is None:
            return ()
        residuals = PhysicsResiduals(search, joint.final, regression)
        return tuple(shape(residuals, d, seen, runs) for d in left[: log.budgets.shapes])

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
        standstill=moving(log.runs, log.slowest)[1] if log.slowest else 0.0,
        ceiling=most,
    )


def odd_run(left: Sequence[Dependence], shapes: Sequence[Shape]) -> int | None:
    """Number of the run that the largest remaining structure is confined to, beside single moments."""
    pairs = zip(left, shapes, strict=False)
    return next((s.only_run for d, s in pairs if d.moment is None), None)


def in_run(log: Log, system: System, run: int) -> InRun | None:
    """The effect that would explain a run, or None where none does."""
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
