"""An encoder's zero that differs from run to run: which state, in which runs, and by how much.

With X the whitened slopes of the physics that was found and Z_r what the residual does when one position is read by one
unit too much in run r alone, least squares on the whitened residual e,

    e  ~  X d + sum_r Z_r b_r,        V = covariance of b from blocks of time (`spread`),

Q = (b - m)' (V^-1 on contrasts) (b - m) is chi-square with one degree of freedom less than there are runs where all
runs share one zero. What a steady push that differs from run to run would explain instead is held against it: where
that is as much, as on a linear spring, both are named. Looked for where structure is left alone.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from nsde_torch.effects.coordinates import Bound
from nsde_torch.errors import NsdeError
from nsde_torch.inference.spread import spread
from nsde_torch.sysid.regression import Regression

Array = NDArray[np.float64]

CHANCE = 1e-4
"""Chance of naming zeros that differ between runs that share one."""
ODD = 4.0
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
    sure = [one for one in found if one.p * len(places) < CHANCE and one.values]
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
        if abs(value - middle) > ODD * error
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
