"""Identification that knows of the loop: which estimate to print, and how far feedback may have bent it.

Ordinary estimates are right under feedback from the log. Where the test of the loop says that inputs know more than
the log, or were made from other sensors (`loop_test`), they are not, and the interval is widened by what cannot be
known: with X the whitened slopes, e = X b + a part that X foretells and the fit has swallowed. Of channel i let that
part have length z_i. Then the bias of parameter j is at most (a bound by partial correlations: Cinelli and Hazlett,
Journal of the Royal Statistical Society B 82 (2020))

    sum_i z_i sqrt((M^-1 M_i M^-1)_jj),     M_i = X_i' X_i,   M = sum_i M_i

z_i is the larger one of two (`LoopTest.hidden`). Both are assumptions that no data can test:

- inputs know `FACTOR` = 3 times as much of a step as inputs of earlier steps may be seen to foretell of it, which is
  the upper 95 % limit of the share: that it is not significant does not say that it is nothing. On simulated loops
  whose truth is known 3 held nearly always with strong sticks and mostly with weak ones
  (docs/content/results/feedback.md);
- inputs that were made from other sensors may have moved between rows of the log, by half of what they move from row to
  row, always to the same side of what was logged. A rate loop at 1 kHz below an attitude loop at 100 Hz does so: each
  logged command stands at the start of a decay, and a gain seems 5 % too small whatever moves the sticks.

With instruments that are strong and exogenous only the second is needed, and what estimates lean on parameters that the
instruments do not show. Their estimates are printed where they differ, or where inputs know more than the log, unless
they show that an effect is missing. Where inputs of a faster controller may have moved between rows of the log, they
are made with inputs held and with the mean of each row and the next; the smaller statistic of Sargan decides, and what
it cannot decide widens the interval.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.sysid.by_likelihood import by_likelihood
from nsde_torch.sysid.guard import guarded
from nsde_torch.sysid.identify import Settled, identification, settled
from nsde_torch.sysid.inferred_rates import in_turn
from nsde_torch.sysid.instruments import Instrumented, adopted, between, instrumental, with_columns
from nsde_torch.sysid.longer_boxes import LENGTHS_S, LONGER, asks_for_longer_boxes
from nsde_torch.sysid.loop_test import LoopTest, tested
from nsde_torch.sysid.regression import ITERATIONS, Regression, regression_of
from nsde_torch.sysid.restored_states import narrowed
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.signals import row_weights
from nsde_torch.systems import System

Array = NDArray[np.float64]

_TOLD = 4.0  # difference of statistics from which on data tell what inputs do between rows


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
        system: The machine; its values are where the iteration starts. It is not changed.
        runs: Recordings, all on one step.
        clock: Physical seconds per logged second.
        method: See `identify`.
        iterations: Largest number of steps.
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

    fit = partial(_over_boxes, clock=clock, method=method, iterations=iterations, instruments=instruments)

    def over(width: float | None) -> Identification:
        first = begun if width is None else None
        return in_turn(system, runs, clock, partial(fit, width=width, begun=first))

    found = over(None)
    if method != "weak":
        return found
    found = in_longer_boxes(found, over)
    by, loop = found.instrumented, found.loop
    if not likelihood or (by is not None and loop is not None and adopted(by, loop)):
        return found
    return by_likelihood(found, system, runs, clock)


def _over_boxes(
    system: System,
    runs: Sequence[Run],
    *,
    clock: float,
    method: str,
    width: float | None,
    iterations: int,
    instruments: Sequence[str],
    begun: Settled | None,
) -> Identification:
    """As `identify_in_loop`, over boxes of one length, whatever the guard says of it."""
    at = begun or settled(system, runs, clock=clock, method=method, width=width, iterations=iterations)
    regression, runs = at.regression, at.runs
    found = identification(regression, method, standing=at.left_out)
    if method != "weak":
        why = "finite differences of smoothed states have no innovations"
        return replace(found, loop=LoopTest(why_not=why), guard=guarded(regression, runs, clock=clock))
    loop = tested(regression, runs)
    doubt, by = hidden_bias(regression, loop), None
    if instruments:
        by, apart = _by_instruments(regression, runs, instruments, bool(loop.hidden), clock, width)
        if adopted(by, loop):
            # instruments are solved for at once; the others need what had settled
            found = replace(
                found, values=by.values, covariance=by.covariance, degrees=by.degrees, converged=True
            )
            bias = doubt + (0.0 if regression.converged else np.nan)
            leans, ordinary = np.abs(by.leans), np.where(by.moved, 0.0, bias)
            leaning = (leans * np.where(leans > 0, ordinary, 0.0)).sum(1)
            moving = largest_bias(regression, loop.moving)
            doubt = np.where(by.moved, np.maximum(apart, moving) + leaning, bias)
    doubt = np.maximum(doubt, hangs_on_band(regression, runs, clock=clock, width=width))
    guard = guarded(regression, runs, clock=clock, theta=found.values, covariance=found.covariance)
    return replace(found, loop=loop, instrumented=by, doubt=doubt, guard=guard)


def _by_instruments(
    regression: Regression,
    runs: Sequence[Run],
    names: Sequence[str],
    hidden: bool,
    clock: float,
    width: float | None,
) -> tuple[Instrumented, Array]:
    """Estimates by instruments, and by how much (k,) they hang on what inputs do between rows of the log."""
    held = instrumental(regression, names)
    sure = np.zeros(len(held.values))
    if not hidden:  # then the log has the inputs as they were
        return held, sure
    system = regression.physics.vector.system
    moving = regression_of(system, between(runs, system.nu), clock=clock, width=width)
    moving.run(ITERATIONS)
    other = replace(instrumental(moving, names, ordinary=regression), between_rows=True)
    if not other.moved.any() or len(other.refused) > len(held.refused):
        return held, sure
    if not held.moved.any() or len(other.refused) < len(held.refused):
        return other, sure
    better = other.misfit - held.misfit
    apart = np.abs(held.values - other.values) if abs(better) < _TOLD else sure
    return (held if better >= 0 else other), apart


def in_longer_boxes(found: Identification, again: Callable[[float], Identification]) -> Identification:
    """An identification in longer boxes where its guard asks for it and believes that one; else as it is."""
    first, second = LENGTHS_S
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


def hidden_bias(regression: Regression, loop: LoopTest) -> Array:
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


def hangs_on_band(
    regression: Regression, runs: Sequence[Run], *, clock: float = 1.0, width: float | None = None
) -> Array:
    """How far parameters (k,) hang on the band up to which smoothed states were restored; zero where none were.

    It is twice what they change by with half of the band: a bias that halves when the band doubles is as large as that
    change. nan where nothing settles in half of the band.
    """
    half = narrowed(runs, regression.physics.vector.system, clock)
    if half is None:
        return np.zeros(len(regression.vector))
    return 2.0 * _changed(regression, half, clock, width)


def _changed(regression: Regression, runs: Sequence[Run], clock: float, width: float | None) -> Array:
    """What parameters (k,) change by in other runs or boxes; nan where nothing settles there."""
    system = copy.deepcopy(regression.physics.vector.system)
    try:
        other = regression_of(system, runs, clock=clock, width=width)
        other.run(ITERATIONS)
    except (DataError, NonFiniteError):
        return np.full(len(regression.vector), np.nan)
    return np.asarray(np.abs(regression.theta - other.theta))


def largest_bias(regression: Regression, hidden: Mapping[str, float | Array]) -> Array:
    """The largest bias (k,) of each parameter that `LoopTest.hidden` parts of such lengths, by channel, may cause."""
    out = np.zeros(len(regression.vector))
    if not hidden:
        return out
    for channel, weighs in zip(regression.rows, row_weights(regression), strict=True):
        out += hidden.get(regression.physics.names[channel], 0.0) * np.linalg.norm(weighs, axis=0)
    return out
