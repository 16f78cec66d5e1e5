"""Theta and noise levels of largest likelihood, and whether the innovations are what they should be.

Steps of Gauss and Newton for theta and of Fisher scoring for the levels in turn, each taken only where the likelihood
of the nonlinear filter rises: the objective is `log_likelihood`, and a step costs at most the nat by which the filter
may differ from its linearisation where friction has a sign. They end where they bring less than a nat, times how far
the scatter of scores over blocks exceeds what it should be (`Grams.inflation`). A wrong model of noise or sensors would
be confidently wrong, so that innovations that are not white, or larger or smaller than the filter says, speak against
the estimate (`MaximumLikelihood.objections`).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite
from typing import Any, Generic, TypeVar, final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.data import Run
from nsde_torch.effects import Port
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.inference.filtering import (
    Linearisation,
    Pass,
    Start,
    filtered,
    linearised_about,
    moved_to,
    with_gains,
    with_parameters,
    within_gate,
)
from nsde_torch.inference.levels import FOURTH, Levels, first_levels
from nsde_torch.inference.maximum import evenly, level_columns, likeliest
from nsde_torch.inference.sensitivity import Grams, grams
from nsde_torch.inference.spread import Spread
from nsde_torch.inference.state_space import StateSpace
from nsde_torch.inference.steps import (
    Chunks,
    Steps,
    band_of,
    data_sizes,
    inferred_columns,
    rows_apart,
    steps_of,
)
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector
from nsde_torch.time_limit import check_time

ARITHMETIC = 1e-5  # of the measured changes: what integrators and the digits of a log leave of exact physics
_TURNS = 12
_AHEAD = 10.0  # times what a turn brought, what all that follow may bring
_FIRST_ROWS = 5000  # enough for noise levels beside a first theta
# standard errors that theta may still move by, nats that new noise levels may bring
_SETTLED, _GAIN = 0.05, 0.5
_NEAR, _NEAR_GAIN = 0.3, 1.0  # the same, where physics are compared
# the outlier of a camera system (1 cm, 0.4 m/s, ten rows of 17,000: NanoBench, B2_circle_fast_rep2) cost a flight of
# which all else is sound 4,700,000 nats
_GATE = 8.0  # standard deviations of an innovation, beyond which a measurement is an outlier
_RARE = 0.01  # largest share of rows with outliers: more of them are noise, or physics
_CLOSE = 1.0  # those of a step beyond which slopes of the physics are made anew: they take most of the time
_STUCK = 0.5  # those below which a step that is no better is rounding
# of steps: shares of the undamped one, and then damping (Marquardt) in units of the information
_SHARES, _DAMPINGS = (1.0, 0.5, 0.25, 0.1), (1e-4, 1e-3, 0.01, 0.1, 1.0, 10.0, 100.0)
# damping of a second step, across a ridge. Of a servo whose current settles in 1 ms and whose input is 6 ms late data
# show the sum of both times: each fit ended where it began, 8 nats below, and the delay was not named
_ACROSS = 1e-3
_SHOWN = 1.0  # nats that a step may bring, for a parameter to be stepped
# slopes leave out what theta does to covariances: where the likelihood has its optimum, they may ask for a step of a
# standard error that loses half a nat, again in each of ten turns (the declared physics of NanoBench, a minute)
_FALLEN = 2  # steps one after the other that lost something, after which there is no way up
_PASSES, _PASSES_TO_STATES = 4, 3  # until the states that a filter is linearised about have settled
_LOST = 1.0  # nats by which the nonlinear filter may differ from its linearisation
_LATE = 30  # rows after the start of a stretch in which unmeasured states are known from later ones
_SHORTEST, _FEWEST = 32, 50  # steps of a stretch, rows in all
_SHORTEST_OF_STATES = 10
# times what is not known of an inferred rate, and times the size of a memory: where a filter starts
_UNKNOWN = 3.0
_DIFFERENCES, _OVER = 4, 10
_LAGS = 10  # of the autocorrelation of innovations
_WHITE = 0.02  # largest share of their variance that the past of whitened innovations may predict
_LARGE = 0.25  # by how much their mean square may differ from 1
_AT_BOUND = 1e-5  # of a parameter's scale
# of the largest eigenvalue of scaled information: not shown below it (`sysid.regression.shown`)
_SINGULAR = 1e-10
T = TypeVar("T")


@dataclass(frozen=True)
class MaximumLikelihood:
    """Parameters and noise levels of largest likelihood."""

    vector: ParameterVector  # names, units and bounds of the parameters
    theta: Array  # their values (k,)
    free: Labels  # numbers of those that stand at no bound and that the data show
    spread: Spread  # Jackknife of these over blocks of time
    levels: Levels  # noise levels
    likelihood: float  # log likelihood [nats]
    settled: bool
    """Whether the last step was a twentieth of a standard error at most, by the scatter of scores."""
    square: Array
    """Mean square of the whitened innovations of each measured channel (m,): 1 where the model is right."""
    predictable: Array
    """Share of their variance that those of the ten rows before surely predict (m,): 0 where the model is right."""
    driven: Array  # share of the variance of their innovations that is not the sensor's noise (m,)
    inflation: float  # of the variance of scores over blocks of time, at least 1 (`Grams.inflation`)
    channels: tuple[str, ...]  # names of the measured error channels
    disturbances: tuple[tuple[Port, int], ...]  # ports that disturbances act on, and their columns

    @property
    def standard_errors(self) -> Array:
        """Of each parameter (k,); nan of those that are not free."""
        out = np.full(len(self.theta), np.nan)
        out[self.free] = np.sqrt(np.diag(self.spread.covariance))
        return out

    @property
    def objections(self) -> list[str]:
        """What speaks against the estimate, in words; empty where nothing does."""
        unsettled = [] if self.settled else ["the parameters of largest likelihood did not settle"]
        return [*unsettled, *self.misfit]

    @property
    def misfit(self) -> list[str]:
        """How the innovations are not what they should be, in words: not white, or of another size than predicted."""
        out = []
        for name, square, share in zip(self.channels, self.square, self.predictable, strict=True):
            if not abs(square - 1.0) < _LARGE:
                out.append(
                    f"prediction errors of {name} are {square:.2f} times as large (squared) as predicted"
                )
            if not share < _WHITE:
                out.append(f"{100 * share:.0f} % of the prediction errors of {name} could be predicted")
        return out

    def worst(self, driven: Array) -> float:
        """How far the innovations are from what they should be, in what `misfit` allows; nan where it diverged.

        Channels weigh by `driven` (m,): of one whose innovations are nearly all sensor noise little is known of the
        physics, whatever that noise is like (velocities from positions 1000 times as precise, the published flights).
        """
        off = np.maximum(np.abs(self.square - 1.0) / _LARGE, self.predictable / _WHITE)
        return float((driven * off).max())

    def as_dict(self) -> dict[str, Any]:
        system = self.vector.system
        units = dict(zip(system.state_names, system.state_units, strict=True))  # of an attitude's errors: rad
        columns = [f"{port.value}[{j}]" for port, j in self.disturbances]
        sensor, *sizes = (torch.exp(part).tolist() for part in vars(self.levels).values())
        rows = zip(self.channels, sensor, self.square.tolist(), self.predictable.tolist(), strict=True)
        return {
            "log_likelihood": self.likelihood,
            "used": not self.objections,
            "objections": self.objections,
            "sensors": {
                name: {"std": s, "unit": units.get(name, "rad"), "mean_square": square, "predictable": share}
                for name, s, square, share in rows
            },
            "disturbances": {
                name: {"white_density": white, "gust_std": gust, "gust_s": lasts}
                for name, white, gust, lasts in zip(columns, *sizes, strict=True)
            },
        }


class Latest(Generic[T]):
    """What was made last, and for whom."""

    def __init__(self) -> None:
        self._kept: tuple[object, T] | None = None

    def keep(self, owner: object, value: T) -> T:
        """Keep a value, in the place of the one before."""
        self._kept = owner, value
        return value

    def of(self, owner: object) -> T | None:
        """The value of an owner; None where it is not kept any more."""
        return self._kept[1] if self._kept is not None and self._kept[0] is owner else None


@final
class LogLikelihood:
    """The likelihood of a log as a function of theta and the noise levels.

    Args:
        runs: Recordings, all on one step; rates marked as inferred are taken for unmeasured.
        clock: Physical seconds per logged second.
        run_in: Whether the first rows of each stretch only bring up memory; None: where an effect has any. Physics that
            are compared need the same.
        states: Whether states alone are asked for (`states`): short logs do, and rates start as they were inferred.
        apart: Least time from one measurement to the next [s]; rows between bring their inputs alone.
        disturbances: Columns of the ports on which the machine is disturbed; None: all that push in ways of their own.

    Attributes:
        apart_s: `apart`.
        passes: The last pass of an optimum, and what it is linearised about: of 180 s of a hexacopter's flight 150 MB.
        scores: The last `nsde_torch.inference.force_scores` of an optimum, 120 MB.

    Raises:
        DataError: no run, no stretch that is long enough, or nothing moves.
    """

    def __init__(
        self,
        system: System,
        runs: Sequence[Run],
        clock: float = 1.0,
        *,
        run_in: bool | None = None,
        states: bool = False,
        apart: float = 0.0,
        disturbances: tuple[tuple[Port, int], ...] | None = None,
    ) -> None:
        self._unknown = inferred_columns(system, runs)
        self._floor: Tensor | None = None  # `StateSpace.least_sensor`
        self.passes, self.scores = Latest[tuple[Linearisation, Pass]](), Latest[Any]()
        shortest, fewest = (_SHORTEST_OF_STATES, 1) if states else (_SHORTEST, _FEWEST)
        rows = int(not states)
        steps = steps_of(
            system, runs, clock=clock, shortest=shortest, run_in=run_in, differences=rows, low_passed=True
        )
        self._band = band_of(runs)
        self.apart_s = apart
        self._least = max(1, round(apart / steps.dt))
        self.sizes = data_sizes(system, steps)
        self._apart = rows_apart(runs, self._band, steps.dt)
        slowest = max([self._least, *self._apart.values()])
        chunks = Chunks(steps, late=_LATE if self._unknown else 0, every=slowest)
        if int(chunks.counted.sum()) < fewest:
            raise DataError(
                f"{int(chunks.counted.sum())} rows are too few for a likelihood of physics and noise; give {fewest} "
                "or more, in stretches without a gap."
            )
        self._set(system, steps, chunks, disturbances)

    def of(self, system: System, estimates: tuple[str, ...] | None = None) -> "LogLikelihood":
        """That of the same rows under other physics of the machine, disturbed on the same ports; see `StateSpace`."""
        out = copy.copy(self)
        out._set(system, self.space.steps, self.space.chunks, self.space.disturbances, estimates)
        out.space.measured = self.space.measured  # without the same outliers
        out.space.stiff, out.space.fastest = self.space.stiff, self.space.fastest
        return out

    def speed(self, x: Tensor) -> float:
        """How fast the machine's own states settle in a step, by its first values (`StateSpace.speed`)."""
        self.space.use(self.vector.inside(self.vector.start))
        return self.space.speed(x)

    def part(self, rows: int) -> Tensor | None:
        """Numbers of chunks, evenly from the log, of which so many rows count; None where that is more than half."""
        chunks = self.space.chunks
        share = rows / max(int(chunks.counted.sum()), 1)
        return None if share > 0.5 else evenly(chunks.count, round(share * chunks.count))

    def some(self, which: Tensor) -> "LogLikelihood":
        """That of some of the chunks, by number, with the values in use."""
        out = copy.copy(self)
        out.space, out.passes, out.scores = self.space.some(which), Latest(), Latest()
        out.start = self.start.of(which)
        return out

    def _set(
        self,
        system: System,
        steps: Steps,
        chunks: Chunks,
        disturbances: tuple[tuple[Port, int], ...] | None,
        estimates: tuple[str, ...] | None = None,
    ) -> None:
        unknown = self._unknown
        self.vector = vector = ParameterVector(system)
        vector.follow(steps.dt)
        vector.limit(self.sizes)
        vector.measure(*steps.some())
        further = vector.raised & (vector.start < vector.low)  # a fit that has come there goes on
        vector.low = np.where(further, 0.5 * vector.start, vector.low)
        inner = self.vector.system
        hidden = [inner.state_names[j] for j in unknown]
        self.channels = tuple(name for name in inner.error_names if name not in hidden)
        observed = [i for i, name in enumerate(inner.error_names) if name not in hidden]
        # an attitude's errors stand where the first three columns of its quaternion do
        after = len(inner.state_names) if inner.quaternion is None else inner.quaternion.stop - 1
        names = [inner.state_names[i if i < after else i + 1] for i in range(len(inner.error_names))]
        every = [max(self._least, self._apart.get(names[i], 1)) for i in observed]
        band = {i: self._band[name] for i, name in enumerate(names) if name in self._band}
        self.space = StateSpace(self.vector, steps, chunks, observed, every, band, disturbances, estimates)
        if self._floor is None:  # of the same rows it is the same, whatever the physics is
            change = inner.error(chunks.y[1:], chunks.y[:-1]).square().flatten(0, -2).mean(0).sqrt()[observed]
            self._floor = torch.log((ARITHMETIC * change).clamp_min(1e-300))
        self.space.least_sensor = self._floor
        std = torch.ones(len(inner.error_names), dtype=torch.float64)
        for j, value in unknown.items():
            std[inner.error_names.index(inner.state_names[j])] = _UNKNOWN * value
        of_memory, begun = std.new_zeros(chunks.count, 0), None
        if self.space.estimated:
            noise = chunks.y.diff(n=_DIFFERENCES, dim=0).square().mean((0, 1)).div(FOURTH).sqrt()
            if inner.quaternion is not None:
                noise[inner.quaternion] = 0.0
            follows, begins, begun = self.space.first_memory(self.vector.start, noise)
            of_memory = torch.where(chunks.follows[:, None], follows, _UNKNOWN * begins)
        self.start = Start(chunks.y[0], std, of_memory, begun)

    def first(self, theta: Array) -> tuple[Levels, Linearisation]:
        """First noise levels, and the linearisation about the measured states."""
        space, system = self.space, self.vector.system
        space.use(theta)
        y = space.chunks.y
        about = linearised_about(space, space.states(y), self.start)
        fourths = []  # mean squares of fourth differences, over rows from one measurement of a channel to the next
        for channel, apart in zip(space.observed, space.every, strict=True):
            rows = max(1, min(apart, (len(y) - 1) // _DIFFERENCES))
            out = system.error(y[rows:], y[:-rows])[..., channel]
            for _ in range(_DIFFERENCES - 1):
                out = out[rows:] - out[:-rows]
            fourths.append(out.square().mean())
        over = min(_OVER, len(y) - 2)
        x = about.x
        moved = space.error(x[over:], x[:-over]) - over * space.error(about.after[:-over], x[:-over])
        pushed = about.slopes[..., space.ne :].reshape(-1, space.ne, space.nd)
        of_steps = moved.reshape(-1, space.ne), pushed, space.h, space.steps.pace
        return first_levels(torch.stack(fourths, -1), *of_steps, space.least_sensor), about

    @property
    def outliers(self) -> Tensor:
        """Whether a measurement counts as none because nothing explains it (T, C, m)."""
        logged, now = self.space.logged, self.space.measured
        lost = torch.zeros_like(logged) if now is None else logged & ~now
        return lost & self.space.chunks.counted[..., None]

    def without_outliers(self, levels: Levels, about: Linearisation) -> Linearisation | None:
        """The linearisation without measurements far beyond their noise; None where there are none, or too many.

        Noise levels are those of all rows, so that what is far beyond them is rare. Where it is not, it is noise of
        another kind, or physics, and stays.
        """
        counted = self.space.chunks.counted
        measured = within_gate(self.space, levels, about, _GATE)
        lost = (self.space.logged & ~measured).any(-1)
        if not bool(lost.any()) or float((lost & counted).sum()) > _RARE * float(counted.sum()):
            return None
        self.space.measured = measured
        return replace(about, measured=measured)

    def filtered(self, levels: Levels, about: Linearisation) -> Pass:
        """A pass over the log with the parameters in use."""
        return filtered(self.space, levels, about, self.space.chunks.counted)

    def tried(self, levels: Levels, about: Linearisation, held: Pass) -> Pass:
        """The pass with the parameters in use, its covariances those of another about the same slopes."""
        there = with_parameters(self.space, about, self.start)
        return with_gains(self.space, levels, there, held.whitening, held.gain, self.space.chunks.counted)

    def followed(self, levels: Levels, about: Linearisation, at: Pass) -> tuple[Linearisation, Pass]:
        """The linearisation with the same slopes about the states that a pass found, and the pass about it."""
        x = self._found(levels, about, at)
        about = moved_to(self.space, about, x, self.start)
        return about, with_gains(self.space, levels, about, at.whitening, at.gain, self.space.chunks.counted)

    def settled(
        self, levels: Levels, about: Linearisation, at: Pass, passes: int
    ) -> tuple[Linearisation, Pass]:
        """The linearisation about the states that a pass found, and the pass about it, some times over."""
        for _ in range(passes):
            about = linearised_about(self.space, self._found(levels, about, at), self.start)
            at = self.filtered(levels, about)
        return about, at

    def _found(self, levels: Levels, about: Linearisation, at: Pass) -> Tensor:
        """States that a pass found (T, C, nx); each chunk then starts with what the one before it knows of memory.

        Memory along measured states has their noise: where it is what a chunk starts with, parameters that lessen it
        explain the log better (a hidden mass of 19 % was one of 130 %).
        """
        space, chunks, inside = self.space, self.space.chunks, len(self.space.estimated)
        x = space.shifted(about.x, at.delta[..., : space.ne])
        # beyond the end of a stretch nothing is measured: a cart's pole fell there at 1,000 rad/s, and slopes that were
        # no numbers left no likelihood to any fit of rows in which the cart moves
        x = torch.where(chunks.beyond[..., None], about.x, x)
        if inside:
            before = chunks.follows[:, None]
            known = space.begun[0] if self.start.memory is None else self.start.memory
            memory = torch.where(before, chunks.in_turn(x[..., -inside:]), known)
            here = filtered(space, levels, about, chunks.counted, covariances=space.nd + inside)
            assert here.covariance is not None
            variance = here.covariance[..., space.ne - inside : space.ne, :inside].diagonal(dim1=-2, dim2=-1)
            std = torch.where(before, chunks.in_turn(variance).sqrt(), self.start.memory_std)
            self.start = Start(self.start.x, self.start.std, std, memory)
        return x


@torch.no_grad()
def log_likelihood(system: System, runs: Sequence[Run], *, levels: Levels, clock: float = 1.0) -> float:
    """Log likelihood of some runs, all on one step, under a machine with its present values and noise levels [nats].

    `clock` is in physical seconds per logged second.
    """
    problem = LogLikelihood(system, runs, clock)
    _, about = problem.first(problem.vector.start)
    return problem.settled(levels, about, problem.filtered(levels, about), _PASSES)[1].total


@final
class Optimum:
    """Where the likelihood is largest, for those who go on from there.

    What a pass leaves is a hundred times as large as the states that it is about. So it is made again where it is asked
    for, and kept for the last one (1.7 GB for 184 s of a hexacopter's flight with the passes of all fitted physics).

    Args:
        of: The likelihood, with theta of the optimum in use.
        about: What the last pass is linearised about.
        free: Numbers of the parameters that the data show.
    """

    def __init__(
        self, of: LogLikelihood, levels: Levels, about: Linearisation, at: Pass, free: Labels
    ) -> None:
        self.of, self.levels, self.x, self.free = of, levels, about.x, free
        self.theta, chunks = of.space.theta.numpy(), of.space.chunks
        self.blocks = chunks.blocks(torch.stack([at.rows[a:b].sum(0) for a, b in chunks.parts]))
        """Log likelihood of each block of time (B,) [nats]."""
        of.passes.keep(self, (about, at))

    @property
    def about(self) -> Linearisation:
        """What the last pass is linearised about."""
        return self._pass()[0]

    @property
    def at(self) -> Pass:
        """The last pass."""
        return self._pass()[1]

    @cached_property
    def innovations(self) -> Array:
        """Innovations of each measured channel over their size, by step (N, m); 0 where none counts."""
        errors = self.at.errors
        size = errors[self.of.space.chunks.counted].square().mean(0).sqrt().clamp_min(1e-300)
        return self.by_step(errors / size)

    def by_step(self, values: Tensor) -> Array:
        """Values of rows (T, C, m) by the step that brought the row (N, m); 0 where none counts."""
        chunks = self.of.space.chunks
        out = np.zeros((len(self.of.space.steps), values.shape[-1]))
        live = chunks.counted[1:]  # that of a row is what the step before it brought
        out[chunks.row[:-1][live].numpy()] = values[1:][live].numpy()
        return out

    @cached_property
    def by_channel(self) -> Array:
        """Log likelihood of each measured channel given those before it (m,), but for a constant [nats]."""
        at, live = self.at, self.of.space.chunks.counted
        logs = at.whitening.diagonal(dim1=-2, dim2=-1).abs().clamp_min(1e-300).log()
        every = torch.where(live[..., None], logs - 0.5 * at.white.square(), 0.0)
        shown = every if self.of.space.measured is None else torch.where(self.of.space.measured, every, 0.0)
        return np.asarray(shown.sum((0, 1)).numpy())

    @cached_property
    def outlier_times(self) -> dict[int, list[float]]:
        """Logged times of rows with outliers, in order, by number of the run [s].

        Rows that an effect explains are none any more: those in which an input was cut to its limit are rare, and were
        left out while nobody knew of the limit.
        """
        of, chunks, runs = self.of, self.of.space.chunks, self.of.space.steps.runs
        lost = of.outliers
        if bool(lost.any()):
            about, _ = self._pass()
            logged = replace(about, measured=of.space.logged)
            lost = lost & ~within_gate(of.space, self.levels, logged, _GATE)
        out: dict[int, list[float]] = {}
        for k, c in lost.any(-1).nonzero().tolist():
            out.setdefault(runs[int(chunks.stretch[c])], []).append(float(chunks.t[k, c]))
        return {run: sorted(times) for run, times in sorted(out.items())}

    def some(self, which: Tensor) -> "Optimum":
        """The same in some of the chunks, by number."""
        about, at = self._pass()
        self.of.space.use(self.theta)
        return Optimum(self.of.some(which), self.levels, about.of(which), at.of(which), self.free)

    def _pass(self) -> tuple[Linearisation, Pass]:
        known = self.of.passes.of(self)
        if known is not None:
            return known
        space = self.of.space
        space.use(self.theta)
        # a fit whose last steps held slopes may end just beyond: of a servo that acts late the scores were no numbers
        fastest, space.fastest = space.fastest, inf
        try:
            about = linearised_about(space, self.x, self.of.start)
        finally:
            space.fastest = fastest
        return self.of.passes.keep(self, (about, self.of.filtered(self.levels, about)))


def fit(system: System, runs: Sequence[Run], *, clock: float = 1.0) -> MaximumLikelihood:
    """Fit all parameters of a machine and the noise of its sensors and disturbances.

    Args:
        system: The machine; its values are where the iteration starts. It is not changed.
        runs: Recordings, all on one step; rates marked as inferred are taken for unmeasured.
        clock: Physical seconds per logged second.

    Raises:
        DataError: no run, no stretch that is long enough, or nothing moves.
        NonFiniteError: the physics leaves the finite numbers within steps of the log.
    """
    problem = LogLikelihood(system, runs, clock)
    try:
        return maximised(problem)[0]
    except np.linalg.LinAlgError as error:
        raise NonFiniteError(
            f"the likelihood of {system.name!r} leaves the finite numbers on steps of {runs[0].dt:.3g} s, within which "
            "its physics may diverge. Record faster, or begin with other values."
        ) from error


def nearly_maximised(
    problem: LogLikelihood, near: Optimum | None = None, *, wanted: float = -inf, turns: int = _TURNS
) -> tuple[MaximumLikelihood, Optimum]:
    """As `maximised`, as near to the optimum as comparing physics needs, and intervals at the noise levels found."""
    return maximised(
        problem, near, settled_at=_NEAR, gain=_NEAR_GAIN, nuisances=False, wanted=wanted, turns=turns
    )


@torch.no_grad()
@np.errstate(over="ignore", invalid="ignore")  # what diverges has no likelihood, and that is looked at
def maximised(
    problem: LogLikelihood,
    near: Optimum | None = None,
    *,
    settled_at: float = _SETTLED,
    gain: float = _GAIN,
    nuisances: bool = True,
    held: Levels | None = None,
    wanted: float = -inf,
    turns: int = _TURNS,
) -> tuple[MaximumLikelihood, Optimum]:
    """Theta and noise levels of largest likelihood, from the first values of the physics.

    Args:
        near: The optimum of physics close to these on the same rows, whose states and noise levels are begun with.
        settled_at, gain: Where the iteration ends: standard errors of a step of theta, nats that new levels bring.
        nuisances: Whether intervals allow for noise levels that are not known.
        held: Noise levels that are known and stay; None finds them.
        wanted: Log likelihood that is asked for: where there is no way to it the iteration ends.
        turns: Most steps of theta.

    Raises:
        DataError: known levels are of other disturbances: which ones push alike depends on where a log goes.
    """
    space, vector = problem.space, problem.vector
    if held is not None and len(held.white) != space.nd:
        raise DataError(
            f"noise levels of {len(held.white)} disturbances do not fit a log that tells {space.nd} apart."
        )
    theta, everything = vector.inside(vector.start), range(len(vector))
    if near is None:
        first, about = problem.first(theta)
        first = first if held is None else held
    else:
        space.use(theta)
        x = near.x
        if near.of.space.estimates != space.estimates:
            x = space.states(x[..., : vector.system.nx])
        first, about = near.levels, linearised_about(space, x, problem.start)
    levels, at = first, problem.filtered(first, about)
    known: Tensor | None = None
    sound = near is not None or held is not None
    if near is None or space.estimated:
        about, at = problem.settled(levels, about, at, 1)
    if near is None and held is None:  # of the right size first: theta weighs channels by them
        levels, known, _ = likeliest(space, first, first, about, rows=_FIRST_ROWS)
        at = problem.filtered(levels, about)
    settled, away, fallen, columns = False, inf, 0, torch.zeros(0)
    # where each measurement costs a nat there is no way back, and fits take a minute (a wind on NeuroBEM)
    ahead = float(space.measurements)
    for _ in range(turns):
        check_time()
        if away > _CLOSE:
            columns = space.columns(about.x, about.slopes, everything, about.after)
        if at.total + ahead < wanted:
            break
        here = grams(space, levels, about, at, columns)
        # where innovations are not as predicted, a nat is worth less: of racing flights (NeuroBEM) a tenth
        worth, begun = here.inflation(_free(vector, theta, here)), at.total
        theta, about, at, away = _step(problem, here, theta, levels, about, at, columns)
        settled = away < settled_at * worth**0.5
        fallen = 0 if at.total > begun else fallen + 1
        if held is not None:
            if settled:
                break
            continue
        if not sound:
            sound, within = True, problem.without_outliers(levels, about)
            if within is not None:
                about, at = within, problem.filtered(levels, within)
                begun = at.total
        # whichever brings more goes on: levels beside a wrong theta take its errors for noise
        before = at.total
        levels, known, there = likeliest(
            space, levels, first, about, known, least=max(before - begun, gain * worth)
        )
        at = there or problem.filtered(levels, about)
        # to compare physics, steps that promise much and bring nothing do too: friction has a sign. Final fits go
        # on: unsettled, they have no intervals (two_frictions.py, seed 1: 17 of 18 held, and 18 so). So do those that
        # all others begin from: half a nat short of it a wind promised 35 nats for 42 (test_named.py)
        compared = not nuisances and near is not None
        over = settled or fallen >= _FALLEN or (compared and at.total < begun + gain * worth)
        if over and at.total < before + gain * worth:
            break
        ahead = _AHEAD * (at.total - begun)
    beside = None
    if nuisances:  # to compare physics, slopes less than a standard error away do
        about = linearised_about(space, about.x, problem.start)
        at = problem.filtered(levels, about)
        columns = space.columns(about.x, about.slopes, everything, about.after)
        beside = level_columns(space, levels, about)
    final = grams(space, levels, about, at, columns, beside)
    references, theta = _from_references(vector, theta, final)
    space.use(theta)
    free = np.setdiff1d(_free(vector, theta, final), references)
    square, predictable = _whiteness(at.white, space)
    found = vector, theta, free, final.spread(free), levels, at.total, settled
    innovations = square, predictable, _driven(at, levels, space), final.inflation(free)
    best = MaximumLikelihood(*found, *innovations, problem.channels, space.disturbances)
    return best, Optimum(problem, levels, about, at, free)


def _step(
    problem: LogLikelihood,
    held: Grams,
    theta: Array,
    levels: Levels,
    about: Linearisation,
    at: Pass,
    columns: Tensor,
) -> tuple[Array, Linearisation, Pass, float]:
    """Theta after the least damped step by which the likelihood rises, with the linearisation and the pass there.

    The last is the length of the undamped step in standard errors; 0 where that is short and no step is better.
    """
    vector, space = problem.vector, problem.space
    gram = held.total[1 : 1 + held.parameters, 1 : 1 + held.parameters]
    away = 0.0
    for share, damping in (*((share, 0.0) for share in _SHARES), *((1.0, d) for d in _DAMPINGS)):
        check_time()
        if share < 1.0 and away < _SETTLED:
            continue
        change = share * bounded_change(vector, held, theta, damping)
        if not np.isfinite(change).all():  # the filter has diverged: there is no way from here
            away = inf
            break
        if share == 1.0 and not damping:
            count = max(int((change != 0).sum()), 1)
            away = float(np.sqrt(max(float(change @ gram @ change), 0.0) / count))
        space.use(theta + change)
        moved = problem.tried(levels, about, at)
        if not damping and away > _SETTLED and isfinite(moved.total) and moved.total < at.total:
            # where the likelihood is a ridge that bends, a long step ends beside it: back by the slopes that there are
            again = grams(space, levels, about, moved, columns)
            back = change + bounded_change(vector, again, theta + change, _ACROSS)
            if np.isfinite(back).all():
                space.use(theta + back)
                nearer = problem.tried(levels, about, at)
                if nearer.total > moved.total:
                    change, moved = back, nearer
        if moved.total >= at.total:
            if away > _CLOSE:
                near, after = problem.settled(levels, about, moved, 1)
            else:
                near, after = problem.followed(levels, about, moved)
            if after.total >= at.total - (_LOST if away > _STUCK else 0.0):
                return theta + change, near, after, away
    space.use(theta)
    if away > _CLOSE:
        # steps may have been held against a filter about states that it has left since (an outlier of NanoBench)
        near, there = problem.settled(levels, about, at, 1)
        if there.total < at.total - _LOST:
            return theta, near, there, away
    return theta, *problem.followed(levels, about, at), away if away > _STUCK else 0.0


def bounded_change(vector: ParameterVector, held: Grams, theta: Array, damping: float = 0.0) -> Array:
    """The damped step (k,) of largest linearised likelihood inside the bounds."""
    low, high = (end - theta for end in vector.reach(theta))
    free, change = _free(vector, theta, held), np.zeros(len(theta))
    # what brings no nat however far a step goes stays: beside no drag a wind may be anything (test_named.py)
    most = 0.5 * np.diag(held.total)[1 : 1 + len(theta)] * np.square(np.maximum(-low, high))
    free = free[most[free] > _SHOWN]
    if len(free):
        change[free] = held.step(free, damping, low[free], high[free])
    return np.asarray(vector.inside(theta + change) - theta)


def _free(vector: ParameterVector, theta: Array, held: Grams) -> Labels:
    """Numbers of the parameters that the data show and that are not pressed against a bound."""
    gram, pull = np.diag(held.total)[1 : 1 + held.parameters], held.total[1 : 1 + held.parameters, 0]
    # a slow store of 3200 s did not move: a second of it shows nothing, and a part of it all
    size = gram * np.square(vector.size(theta))
    shown = size > 1e-12 * max(float(size.max()), 1e-300)
    margin = _AT_BOUND * vector.scale
    pressed = ((theta <= vector.low + margin) & (pull < 0)) | ((theta >= vector.high - margin) & (pull > 0))
    return np.flatnonzero(shown & ~pressed)


def _from_references(vector: ParameterVector, theta: Array, held: Grams) -> tuple[list[int], Array]:
    """Columns that are held by convention (`ParameterVector.references`), and theta with nothing there.

    It goes there along what the data do not show, where the likelihood is the same.
    """
    if not vector.per_input:
        return [], theta
    gram = held.total[1 : 1 + held.parameters, 1 : 1 + held.parameters]
    size = 1.0 / np.sqrt(np.diag(gram).clip(1e-300))
    values, directions = np.linalg.eigh(gram * size * size[:, None])
    lost = values < _SINGULAR * values[-1]
    references = vector.references(theta, np.square(directions[:, lost]).sum(1) < 1e-6)
    free = size[:, None] * directions[:, lost]
    for j in references:
        theta = vector.inside(theta - theta[j] * free @ free[j] / max(float(free[j] @ free[j]), 1e-300))
    theta[references] = 0.0
    return references, theta


def _driven(at: Pass, levels: Levels, space: StateSpace) -> Array:
    """Share of the variance of the innovations of each measured channel that is not its sensor's noise (m,)."""
    live = space.chunks.counted[..., None].expand_as(at.errors)
    live = live if space.measured is None else live & space.measured
    variance = torch.where(live, at.errors, 0.0).square().sum((0, 1)) / live.sum((0, 1)).clamp_min(1)
    return (1.0 - torch.exp(2.0 * levels.sensor) / variance.clamp_min(1e-300)).clamp(0.0, 1.0).numpy()


def _whiteness(white: Tensor, space: StateSpace) -> tuple[Array, Array]:
    """Mean square of whitened innovations (m,), and share that the ten before predict (m,), surely beyond chance.

    Of white ones the lags explain chi-squared with their number over the number of rows: that mean and twice its
    standard deviation are no misfit (of the 480 rows of the EMPS drive 0.05 s apart, 2 % and another 2 %).
    """
    squares, shares = [], []
    for j, every in enumerate(space.every):
        live = space.chunks.counted
        live = live if space.measured is None else live & space.measured[..., j]
        own = torch.where(live, white[..., j], 0.0)
        square = own.square().sum() / live.sum().clamp_min(1)
        share = torch.zeros_like(square)
        for lag in range(every, every * _LAGS + 1, every):
            pairs = (live[lag:] & live[:-lag]).sum().clamp_min(1)
            share += ((own[lag:] * own[:-lag]).sum() / pairs / square).square() - 1.0 / pairs
        share -= 2.0 * (2.0 * _LAGS) ** 0.5 / pairs
        squares.append(square)
        shares.append(share)
    return torch.stack(squares).numpy(), torch.stack(shares).clamp(0.0, 1.0).numpy()


# ---- states at given physics -------------------------------------------------------------------------


@dataclass(frozen=True)
class Filtered:
    """A log under physics with their present values."""

    of: LogLikelihood  # the likelihood, with these values in use
    levels: Levels  # noise levels, from differences of the residuals of the physics
    about: Linearisation  # what the pass is linearised about
    at: Pass  # the pass, with the covariances of the states

    def states(self, runs: Sequence[Run]) -> list[Array]:
        """States of each run (n, nx); as they were read in rows that no stretch holds."""
        space, steps, chunks = self.of.space, self.of.space.steps, self.of.space.chunks
        x = space.shifted(self.about.x, self.at.delta[..., : space.ne])[..., : runs[0].x.shape[1]].numpy()
        out = [np.array(run.x) for run in runs]
        begun = np.array([a for a, _ in steps.segments])
        for c in reversed(range(chunks.count)):  # where two overlap, that which has forgotten its start
            first = int(chunks.row[0, c])
            k = int(np.searchsorted(begun, first, side="right")) - 1
            (a, b), n = steps.segments[k], steps.runs[k]
            row = int(np.searchsorted(runs[n].t, float(steps.t[a]))) + first - a
            count = min(chunks.size, b + 1 - first)
            out[n][row : row + count] = x[:count, c]
        return out

    def square(self) -> Tensor:
        """Mean square of the whitened innovations of each measured channel (m,)."""
        return self.at.white[self.of.space.chunks.counted].square().mean(0)

    def unknown(self) -> Tensor:
        """What is not known of each error channel (ne,), as a standard deviation over the log."""
        assert self.at.covariance is not None
        variances = self.at.covariance.diagonal(dim1=-2, dim2=-1)[..., : self.of.space.ne]
        return variances[self.of.space.chunks.counted].mean(0).sqrt()


@torch.no_grad()
def filtered_at(of: LogLikelihood) -> Filtered:
    """A log under the first values of its physics; of positions alone best that of `states=True`."""
    system = of.vector.at_first()
    wide = ParameterVector(system)  # a friction narrower than all speeds has slopes that no step follows
    wide.limit(data_sizes(wide.system, of.space.steps))
    levels, about = of.first(of.vector.inside(wide.inside(wide.start)))
    about, _ = of.settled(levels, about, of.filtered(levels, about), _PASSES_TO_STATES)
    at = filtered(of.space, levels, about, of.space.chunks.counted, covariances=of.space.n)
    return Filtered(of, levels, about, at)
