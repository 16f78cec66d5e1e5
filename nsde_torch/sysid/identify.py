"""Identify the declared parameters of a system in one call; the regression itself is `regression`."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsde_torch.data import Run
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.sysid.explained import bump, explained
from nsde_torch.sysid.narrow_shapes import narrower
from nsde_torch.sysid.regression import ITERATIONS, Regression, regression_of
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.standing import SHARE, moving, slowest
from nsde_torch.systems import System


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
        method: "weak" as above, or "differences": finite differences of states that a spline has smoothed, in
            ordinary least squares, the classical way; only its covariance is that of above.
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
    return identification(at.regression, method, standing=at.left_out)


@dataclass(frozen=True)
class Settled:
    """A regression after its last step."""

    regression: Regression
    runs: Sequence[Run]  # its runs, without rows in which what has dry friction stands
    left_out: float  # share of the rows that were left out of them


def settled(
    system: System,
    runs: Sequence[Run],
    *,
    clock: float,
    method: str,
    width: float | None,
    iterations: int,
) -> Settled:
    """The regression of some runs after its last step.

    Rows in which what has dry friction stands are left out, once the noise of its speed is known (`standing`).
    """
    regression = regression_of(system, runs, clock=clock, method=method, width=width)
    regression.run(iterations)
    regression = narrower(regression, iterations)
    speeds = slowest(system, regression.physics.sensor_std, runs) if method == "weak" else {}
    some, share = moving(runs, speeds)
    if share < SHARE:
        return Settled(regression, runs, 0.0)
    try:
        again = regression_of(system, some, clock=clock, method=method, width=width, start=regression.theta)
        again.run(iterations)
        again = narrower(again, iterations)
    except (DataError, NonFiniteError):  # too little is left
        return Settled(regression, runs, 0.0)
    return Settled(again, some, share)


def identification(regression: Regression, method: str, *, standing: float = 0.0) -> Identification:
    """What a regression that has settled found; see `identify`. `standing` is the share of rows that were left out."""
    weak = method == "weak"
    vector, physics, steps = regression.vector, regression.physics, regression.physics.steps
    sure, blocks = regression.spread(), regression.blocks
    basis, window = regression.shown.basis, bump(steps.dt)
    left = physics.residual(regression.theta)[:, regression.rows]
    alone = explained(physics, left + regression.shift(sure.parts @ basis.T, blocks), regression.rows, window)
    channels = explained(physics, left, regression.rows, window)
    return Identification(
        vector=vector,
        method=method,
        values=regression.theta,
        covariance=basis @ sure.covariance @ basis.T,
        degrees=sure.degrees(basis),
        shown=regression.shown,
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
        standing=standing,
    )
