"""Identify the declared parameters of a system, in a loop too: which estimate to print, and how far feedback biases it.

Ordinary estimates (`regression`) are right under feedback from the log. Where inputs know more than the log, or were
made from other sensors (`feedback_test`), intervals are widened by the largest bias of parameter j (a bound by partial
correlations: Cinelli and Hazlett, Journal of the Royal Statistical Society B 82 (2020))

    sum_i z_i sqrt((M^-1 M_i M^-1)_jj),     M_i = X_i' X_i,   M = sum_i M_i

with X_i the whitened slopes of channel i, and z_i the length of the part of its residuals that these predict and the
fit has swallowed (`FeedbackTest.hidden`). With instruments only inputs that move between rows of the log count, and
what estimates owe to parameters that the instruments do not show. Where inputs may have moved so, instruments are used
with inputs held and with the mean of each row and the next; the smaller statistic of Sargan decides, and what it cannot
decide widens the interval.

Values and intervals are those of largest likelihood (`nsde_torch.inference`), unless simple fits speak against it,
states were smoothed before they were logged, or innovations are not white; then the regression's stay. Rates that no
sensor measured are inferred from positions with the physics in the loop, by a filter that knows no later row: what it
lacks is independent of the noise that comes. Physics and rates settle in turn (`in_turn`).
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.data.system_info import rate_pairs
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.inference import LogLikelihood, Optimum, maximised, nearly_maximised
from nsde_torch.inference.estimate import filtered_at
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.steps import inferred_columns
from nsde_torch.sysid.feedback_test import FeedbackTest, tested
from nsde_torch.sysid.guard import LENGTHS_S, LONGER, asks_for_longer_boxes, guarded
from nsde_torch.sysid.instruments import Instrumented, adopted, instrumental, with_columns
from nsde_torch.sysid.measured_inputs import later
from nsde_torch.sysid.physics import bump, explained
from nsde_torch.sysid.regression import ITERATIONS, Regression, narrower, regression_of
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.signals import row_weights
from nsde_torch.sysid.standstill import SHARE, moving, slowest
from nsde_torch.systems import System

_TOLD = 4.0  # difference of statistics from which on data show what inputs do between rows


@dataclass(frozen=True)
class Settled:
    """A regression after its last step."""

    regression: Regression
    runs: Sequence[Run]  # its runs, without rows in which what has dry friction stands
    left_out: float  # share of the rows that were left out of them


def identify_in_loop(
    system: System,
    runs: Sequence[Run],
    *,
    clock: float = 1.0,
    method: str = "weak",
    iterations: int = ITERATIONS,
    instruments: Sequence[str] = (),
    likelihood: bool = True,
    begun: Settled | None = None,
) -> Identification:
    """Identify declared parameters, test the loop, and use signals from outside it.

    Args:
        system, runs, clock, method, iterations: As for `identify`.
        instruments: Names of logged columns (`Run.extra`) that nothing inside the loop moves: sticks, setpoints.
        likelihood: Whether values are those of largest likelihood, where that can be relied on.
        begun: The regression of the same runs, where it has settled already.

    Returns:
        Estimates with `loop`, `instrumented`, `doubt` and `guard` filled in.

    Raises:
        DataError: a run lacks an instrument, or one never changes; and as `identify`.
        ConfigError: instruments with `method="differences"`; and as `identify`.
    """
    if instruments:
        if method != "weak":
            raise ConfigError(
                f"`data.instruments` needs model.method=weak; got {method!r} (inputs that were smoothed know the "
                "future). Leave the instruments out."
            )
        system, runs = with_columns(system, runs, instruments)
    if instruments or any(run.inferred for run in runs):
        begun = None  # of other columns

    def over(width: float | None) -> Identification:
        def fit(machine: System, rows: Sequence[Run]) -> Identification:
            at = begun if width is None else None
            at = at or settled(machine, rows, clock=clock, method=method, width=width, iterations=iterations)
            return _over_boxes(at, clock, method, width, instruments)

        return in_turn(system, runs, clock, fit)

    found = over(None)
    if method != "weak":
        return found
    found = in_longer_boxes(found, over, runs[0].pace)
    by, loop = found.instrumented, found.loop
    if not likelihood or (by is not None and loop is not None and adopted(by, loop)):
        return found
    return by_likelihood(found, system, runs, clock)


def _over_boxes(
    at: Settled, clock: float, method: str, width: float | None, instruments: Sequence[str]
) -> Identification:
    """As `identify_in_loop`, over boxes of one length, whatever the guard says of it."""
    regression, runs = at.regression, at.runs
    found = identification(regression, method, standstill=at.left_out)
    if method != "weak":
        why = "finite differences of smoothed states have no innovations"
        return replace(found, loop=FeedbackTest(why_not=why), guard=guarded(regression, runs, clock=clock))
    loop = tested(regression, runs, None)
    doubt, by = hidden_bias(regression, loop), None
    if instruments:
        by, apart = _by_instruments(at, instruments, bool(loop.hidden), clock, width)
        if adopted(by, loop):
            # instruments are solved for at once; the others need what had settled
            own = {key: getattr(by, key) for key in ("values", "covariance", "degrees")}
            found = replace(found, **own, converged=True)
            bias = doubt + (0.0 if regression.converged else np.nan)
            leans, ordinary = np.abs(by.leans), np.where(by.moved, 0.0, bias)
            leaning = (leans * np.where(leans > 0, ordinary, 0.0)).sum(1)
            moving = largest_bias(regression, loop.moving)
            doubt = np.where(by.moved, np.maximum(apart, moving) + leaning, bias)
    machine = regression.vector.at(regression.theta)
    band = dependence_on_band(machine, regression.theta, runs, clock, width or 0.0)
    doubt = np.maximum(doubt, band)
    guard = guarded(regression, runs, clock=clock, theta=found.values, covariance=found.covariance)
    return replace(found, loop=loop, instrumented=by, doubt=doubt, guard=guard)


def _by_instruments(
    at: Settled, names: Sequence[str], hidden: bool, clock: float, width: float | None
) -> tuple[Instrumented, Array]:
    """Estimates by instruments, and by how much (k,) they hang on what inputs do between rows of the log."""
    regression, runs = at.regression, at.runs
    held = instrumental(regression, names)
    sure = np.zeros(len(held.values))
    if not hidden:  # then the log has the inputs as they were
        return held, sure
    system = regression.physics.vector.system
    moving = regression_of(system, later(runs, range(system.nu), 0.5), clock=clock, width=width)
    moving.run(ITERATIONS)
    other = replace(instrumental(moving, names, ordinary=regression), between_rows=True)
    if not other.moved.any() or len(other.refused) > len(held.refused):
        return held, sure
    if not held.moved.any() or len(other.refused) < len(held.refused):
        return other, sure
    better = other.misfit - held.misfit
    apart = np.abs(held.values - other.values) if abs(better) < _TOLD else sure
    return (held if better >= 0 else other), apart


def in_longer_boxes(
    found: Identification, again: Callable[[float], Identification], pace: float
) -> Identification:
    """An identification in longer boxes where its guard asks for it and accepts that one; else as it is."""
    first, second = (pace * seconds for seconds in LENGTHS_S)
    if not asks_for_longer_boxes(found.guard) or first < LONGER * found.box_s:
        return found
    try:
        longer, longest = again(first), again(second)
    except (DataError, NonFiniteError):  # runs that are too short for them
        return found
    if not (longer.believed and longest.believed):
        return found
    moved = np.abs(longer.values - longest.values)
    doubt = moved if longer.doubt is None else longer.doubt + moved
    return replace(longer, doubt=doubt, finer=found)


def hidden_bias(regression: Regression, loop: FeedbackTest) -> Array:
    """Largest bias (k,) of each parameter that knowledge of the inputs may have caused; zero where none was found.

    nan of parameters that rest mostly on channels whose inputs are nearly a function of the state: nothing is known.
    """
    bound = {c for way in loop.functions_of_state for c in loop.driven[way]}
    out = largest_bias(regression, loop.hidden)
    if not bound:
        return out
    names = [regression.physics.names[channel] for channel in regression.rows]
    of_channels = np.square(regression.slopes).sum(1)
    free = of_channels[[name not in bound for name in names]].sum(0)
    return np.where(free < 0.5 * of_channels.sum(0), np.nan, out)


def dependence_on_band(
    system: System, theta: Array, runs: Sequence[Run], clock: float = 1.0, apart: float = 0.0
) -> Array:
    """How far parameters (k,) depend on the band up to which smoothed states were restored; zero where none were.

    It is twice what they change by with half of the band: a bias that halves when the band doubles is as large as that
    change. nan where nothing can be fitted in half of the band. `apart` is the least time between two measurements [s].
    """
    if not any(run.band for run in runs):
        return np.zeros(len(theta))
    half = [replace(run, low_pass={name: 0.5 * hz for name, hz in run.band.items()}) for run in runs]
    try:
        other = nearly_maximised(LogLikelihood(system, half, clock, run_in=True, apart=apart))[0]
    except (DataError, NonFiniteError, np.linalg.LinAlgError):
        return np.full(len(theta), np.nan)
    return np.asarray(2.0 * np.abs(theta - other.theta))


def largest_bias(regression: Regression, hidden: Mapping[str, float | Array]) -> Array:
    """Largest bias (k,) of each parameter that `FeedbackTest.hidden` parts of such lengths, by channel, may cause."""
    out = np.zeros(len(regression.vector))
    if not hidden:
        return out
    for channel, weighs in zip(regression.rows, row_weights(regression), strict=True):
        out += hidden.get(regression.physics.names[channel], 0.0) * np.linalg.norm(weighs, axis=0)
    return out


def identify(
    system: System,
    runs: Sequence[Run],
    *,
    clock: float = 1.0,
    method: str = "weak",
    width: float | None = None,
    iterations: int = ITERATIONS,
) -> Identification:
    """Identify the declared parameters of a system by least squares.

    Args:
        system: The machine; its values are where the iteration starts. It is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.
        method: "weak" (`regression`), or "differences": finite differences of states that a spline has smoothed, in
            ordinary least squares, the classical way; only its covariance is that of "weak".
        width: Length of the boxes that the equations are integrated over [s]; None takes one step of the data, or
            10 ms if that is longer.
        iterations: Largest number of steps.

    Returns:
        Estimates, their covariance, and what the data do not show.

    Raises:
        ConfigError: no such method, no declared parameter, or a width that is shorter than a step.
        DataError: no run, or nothing moves.
        NonFiniteError: the physics leaves the finite numbers.

    Example:
        >>> found = identify(make_system("hexacopter"), data.runs)  # doctest: +SKIP
        >>> dict(zip(found.vector.labels, found.values))  # doctest: +SKIP
    """
    at = settled(system, runs, clock=clock, method=method, width=width, iterations=iterations)
    return identification(at.regression, method, standstill=at.left_out)


def settled(
    system: System, runs: Sequence[Run], *, clock: float, method: str, width: float | None, iterations: int
) -> Settled:
    """The regression of some runs after its last step.

    Rows in which what has dry friction stands are left out, once the noise of its speed is known (`standstill`).
    """

    def fitted(runs: Sequence[Run], start: Array | None = None) -> Regression:
        out = regression_of(system, runs, clock=clock, method=method, width=width, start=start)
        out.run(iterations)
        return narrower(out, iterations)

    regression = fitted(runs)
    speeds = slowest(system, regression.physics.sensor_std, runs) if method == "weak" else {}
    some, share = moving(runs, speeds)
    if share >= SHARE:
        with suppress(DataError, NonFiniteError):  # too little is left
            return Settled(fitted(some, regression.theta), some, share)
    return Settled(regression, runs, 0.0)


def identification(regression: Regression, method: str, *, standstill: float = 0.0) -> Identification:
    """What a regression that has settled found; see `identify`. `standstill` is the share of rows left out."""
    weak = method == "weak"
    vector, physics, steps = regression.vector, regression.physics, regression.physics.steps
    sure, blocks = regression.spread(), regression.blocks
    known = regression.shown
    basis, window = known.basis, bump(steps.dt, steps.pace)
    left = physics.residual(regression.theta)[:, regression.rows]
    alone = explained(physics, left + regression.shift(sure.parts @ basis.T, blocks), regression.rows, window)
    channels = explained(physics, left, regression.rows, window)
    return Identification(
        vector=vector,
        method=method,
        values=regression.theta,
        covariance=basis @ sure.covariance @ basis.T,
        degrees=sure.degrees(basis),
        shown=known,
        channels=tuple(
            replace(c, noise=n if weak else None) for c, n in zip(channels, regression.noises, strict=True)
        ),
        sensor_std=physics.sensor_std,
        unexplained=float(np.mean([c.residual / c.measured for c in alone if c.measured > 0] or [0.0])),
        width_s=len(window) * steps.dt,
        box_s=regression.dt,
        iterations=regression.iterations,
        converged=regression.converged,
        linear=physics.linear(regression.theta),
        blocks=int(blocks.max()) + 1,
        standstill=standstill,
    )


# ---- by likelihood -------------------------------------------------------------------------------------


def by_likelihood(
    found: Identification,
    system: System,
    runs: Sequence[Run],
    clock: float = 1.0,
    near: tuple[System, Optimum] | None = None,
    held: Levels | None = None,
) -> Identification:
    """An identification, its values and intervals by the likelihood.

    Args:
        near: The same machine where a fit of it has ended, whose values `found` has, and the optimum there.
        held: Noise levels that are known; None finds them.

    Returns:
        `found` with `likelihood`, and its values and intervals of all that the data show and that stands at no bound,
        where it settled and nothing speaks against it; or, with `near`, that does not speak against `found` as well.
    """
    objected = found.guard is not None and found.guard.objections
    # inputs that answer the states know of noise what a smoother took out of them (`diagnosis.feedback_bias`)
    closed = near is None and found.loop is not None and bool(found.loop.closed_loop)
    answered = closed and any(run.band for run in runs)
    if objected or answered:
        return found
    machine = copy.deepcopy(system)
    found.vector.write(machine, found.values)
    try:
        if near is None:
            best, at = maximised(LogLikelihood(machine, runs, clock), held=held, nuisances=held is None)
        else:
            best, at = maximised(near[1].of.of(near[0]), near[1])
    except (DataError, NonFiniteError, np.linalg.LinAlgError):
        return found
    found = replace(found, likelihood=best, optimum=at)
    if not best.settled or (best.misfit and near is None):
        return found
    free = best.free
    covariance, degrees = found.covariance.copy(), found.degrees.copy()
    covariance[free], covariance[:, free] = 0.0, 0.0
    covariance[np.ix_(free, free)] = best.spread.covariance
    degrees[free] = best.spread.degrees(np.eye(len(free)))
    return replace(found, values=best.theta, covariance=covariance, degrees=degrees, converged=True)


# ---- inferred rates ------------------------------------------------------------------------------------

TURNS = 4  # times that rates are inferred, at most
SETTLED = 0.2  # standard errors that parameters may still move by
_DIVERGED = 1e3  # times all that a position moves, between two rows


def with_rates(system: System, runs: Sequence[Run], clock: float = 1.0) -> list[Run]:
    """Runs with inferred rates as the physics of a system predicts them; the runs themselves where none are inferred.

    Rows too few for a filter keep their rates.

    Raises:
        DataError: the physics diverges between rows.
    """
    columns = inferred_columns(system, runs) if runs else {}
    if not columns:
        return list(runs)
    try:
        likelihood = LogLikelihood(system, runs, clock, states=True)
    except DataError:
        return list(runs)
    found = filtered_at(likelihood)
    states, unknown, square = found.states(runs), found.unknown(), found.square()
    names, channels, told = system.state_names, list(likelihood.vector.system.error_names), dict[str, float]()
    for i, j in ((i, j) for i, j in rate_pairs(system) if j in columns):
        most = _DIVERGED * max(float(np.ptp(run.x[:, i])) for run in runs)
        if not all(np.abs(x[:, j]).max() * runs[0].dt * clock <= most for x in states):
            raise DataError(
                f"{names[j]} cannot be inferred from {names[i]}: over steps of {runs[0].dt * clock:.3g} s the declared "
                "physics diverges. Log the rate, record at a higher rate, or give first values nearer to those of the "
                "machine (system.parameters.NAME=...)."
            )
        # innovations that are larger than their covariance says have states that are known less
        larger = float(square[likelihood.channels.index(names[i])]) ** 0.5
        told[names[j]] = larger * float(unknown[channels.index(names[j])])
    out = []
    for run, x in zip(runs, states, strict=True):
        own = np.array(run.x)
        own[:, list(columns)] = x[:, list(columns)]
        out.append(replace(run, x=own, inferred=told))
    return out


def in_turn(
    system: System,
    runs: Sequence[Run],
    clock: float,
    identified: Callable[[System, Sequence[Run]], Identification],
) -> Identification:
    """What an identification finds at rates that its own physics predicts."""
    if not (runs and runs[0].inferred):
        return identified(system, runs)
    machine = copy.deepcopy(system)
    found = identified(machine, with_rates(machine, runs, clock))
    for _ in range(TURNS - 1):
        before = found.values
        found.vector.write(machine, before)
        found = identified(machine, with_rates(machine, runs, clock))
        error = np.sqrt(np.diag(found.covariance).clip(0.0))
        if (np.abs(found.values - before) <= SETTLED * error)[found.shown.known].all():
            break
    return found
