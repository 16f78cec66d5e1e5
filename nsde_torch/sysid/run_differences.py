"""Runs that are not of one machine: parameters of each run alone against those of the others.

With X_r the whitened slopes and e_r the whitened residuals of run r at the optimum of all runs, and b_r = (X_r' X_r)^-1
X_r' e_r how far the run alone would move theta,

    d_r = b_r - mean of the other runs' b, weighed by what each shows,      V_r from blocks of time (`spread`)

A loop whose inputs cancel a disturbance d beside what is asked for, u = r - d / g, makes least squares find
g (1 - s^2), with s^2 = var d / (var r + var d) the share of the measured variance that is left. A difference is
reported only if surely larger than that and than what batteries and air make (docs/content/theory/identification.md).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtrc, stdtr

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.data import Run
from nsde_torch.errors import NsdeError
from nsde_torch.inference.spread import spread
from nsde_torch.sysid.physics import per_second
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.rough import Objection, objection

SHARE = 0.1
"""Relative difference that batteries, air and what is missing make, beside the share s^2 that is left."""
CHANCE, EITHER = 0.02, 0.3
"""Chance of so large a difference beyond what runs differ by, over all runs and parameters: the geometric mean of that
by the whitened rows and that by plain least squares; and the largest of either."""
ALIKE = 0.05
"""Chance of gains so far from one common multiple of the others', above which they have it: a run with a load was
reported by one of its gains (tests/sysid/test_guard.py)."""
WHOLE, TIMES = 0.6, 2.5
"""Share of the measured that an unexplained run leaves as residual; and the ratio to that of each other run."""


def odd_run(regression: Regression, rough: Regression, runs: Sequence[Run]) -> Objection | None:
    """The surest difference of one run from the others; None where there is none, or a single run."""
    answered = _answered(rough)
    sure, beside = _differences(regression, answered), _differences(rough, answered)
    found = [
        (chance, r, j, one.own, one.others)
        for (r, j), one in sure.items()
        if (chance := _joint(one, beside.get((r, j)))) < CHANCE
    ]
    if not found:
        return None
    _, r, j, own, others = min(found)
    vector = regression.vector
    label, unit = vector.labels[j], vector.units[j]
    unit = "" if unit == "1" else f" {unit}"
    shapes = {k for name in vector.system.effect_names for k in {*vector.of(name)} - {*vector.sizes(name)}}
    times = _all_alike([one for (run, k), one in sure.items() if run == r and k not in shapes])
    values: dict[str, Any] = {"label": label, "unit": unit, "own": own, "others": others, "times": times}
    return objection("odd_run", name=repr(runs[r].name), **values)


@dataclass(frozen=True)
class _Difference:
    chance: float  # of its difference beyond what runs differ by
    own: float
    others: float
    error: float  # of own - others


def _joint(one: _Difference, other: _Difference | None) -> float:
    """Chance of a difference by both fits; one where they do not agree."""
    if other is None or (other.own > other.others) != (one.own > one.others):
        return 1.0
    if max(one.chance, other.chance) > EITHER:
        return 1.0
    return float(np.sqrt(one.chance * other.chance))


def _all_alike(gains: Sequence[_Difference]) -> float | None:
    """What all gains of a run are, as a multiple of the others', if they have one; None otherwise, and for one gain."""
    ratios = np.array([one.own / one.others for one in gains])
    errors = np.array([one.error / abs(one.others) for one in gains])
    if len(ratios) < 2 or not (np.isfinite(ratios).all() and (errors > 0).all()):
        return None
    mean = float(np.average(ratios, weights=errors**-2.0))
    apart = float((np.square(ratios - mean) / np.square(errors)).sum())
    return mean if mean > 0 and chdtrc(len(ratios) - 1, apart) > ALIKE else None


def _answered(rough: Regression) -> dict[int, Array]:
    """By run: relative bias (k,) of the parameters in it if inputs cancel all that the physics lacks."""
    owner = rough.whitened_rows(rough.owners)
    measured = rough.single.summed(rough.physics.measured, rough.box)[:, rough.rows]
    out = {}
    for r in np.unique(owner).tolist():
        square = np.square(_left_alone(rough, owner == r))
        share = np.minimum(square / np.maximum(measured[rough.owners == r].var(0), 1e-300), 1.0)
        weight = np.square(rough.slopes[:, owner == r]).sum(1)
        out[r] = share @ weight / np.maximum(weight.sum(0), 1e-300)
    return out


def _differences(regression: Regression, answered: Mapping[int, Array]) -> dict[tuple[int, int], _Difference]:
    owner, blocks = regression.whitened_rows(regression.owners), regression.whitened_rows(regression.blocks)
    numbers = [int(r) for r in np.unique(owner)]
    alone = {r: _alone(regression, owner == r, blocks[owner == r]) for r in numbers}
    # means over 0.15 s may have no row of a short run
    parts = {r: one for r, one in alone.items() if one is not None and r in answered}
    if len(parts) < 2:
        return {}
    basis, tests = regression.shown.basis, len(parts) * len(regression.vector)
    gains = np.flatnonzero(regression.shown.known & (regression.vector.low >= 0.0)).tolist()
    out = {}
    for r, (own, variance, _) in parts.items():
        rest = [parts[s] for s in parts if s != r]
        try:
            back = np.linalg.inv(np.sum([square for *_, square in rest], axis=0))
        except np.linalg.LinAlgError:
            continue
        mean = back @ np.sum([square @ moved for moved, _, square in rest], axis=0)
        scatter = np.sum([square @ covariance @ square for _, covariance, square in rest], axis=0)
        weights = np.array([np.diag(basis @ square @ basis.T) for *_, square in rest])
        shares = np.array([answered[s] for s in parts if s != r])
        bias = answered[r] + (shares * weights).sum(0) / np.maximum(weights.sum(0), 1e-300)
        between = basis @ (variance + back @ scatter @ back) @ basis.T
        others = regression.theta + basis @ mean
        moved = basis @ (own - mean)
        for j in gains:  # only what is nothing at zero has a relative size
            error = float(np.sqrt(max(between[j, j], 0.0)))
            size = max(abs(others[j]), 0.5 * abs(others[j] + moved[j]))
            beyond = float(abs(moved[j]) - (SHARE + bias[j]) * size)
            if error > 0 and others[j] != 0.0:
                chance = 2.0 * float(stdtr(_DEGREES, -beyond / error)) * tests if beyond > 0 else np.inf
                out[r, j] = _Difference(chance, float(others[j] + moved[j]), float(others[j]), error)
    return out


_DEGREES = 15  # degrees of freedom of errors from blocks of time, for Student's t


def unexplained_runs(rough: Regression, runs: Sequence[Run]) -> list[Objection]:
    """Runs of which the declared physics leaves most, whatever its parameters, and much more than of the others."""
    owner = rough.whitened_rows(rough.owners)
    numbers = [int(r) for r in np.unique(owner)]
    if len(numbers) < 2:
        return []
    measured = rough.single.summed(rough.physics.measured, rough.box)[:, rough.rows] / rough.dt
    left = np.array([_left_alone(rough, owner == r) / rough.dt for r in numbers])
    moves = np.array([measured[rough.owners == r].std(0) for r in numbers])
    out = []
    for k, r in enumerate(numbers):
        rest = np.delete(left, k, 0).max(0)
        share = np.delete(left / np.maximum(moves, 1e-300), k, 0).max(0)
        odd = (left[k] > WHOLE * moves[k]) & (left[k] > TIMES * rest) & (share < WHOLE)
        if odd.any():
            i = int(np.argmax(np.where(odd, left[k] / np.maximum(rest, 1e-300), 0.0)))
            order = [i, *(c for c in np.flatnonzero(odd).tolist() if c != i)]
            names = [rough.physics.names[rough.rows[c]] for c in order]
            unit = per_second(rough.physics.units[rough.rows[i]])
            values = {"channels": names, "own": left[k, i], "others": rest[i], "unit": unit}
            out.append(objection("unexplained_run", name=repr(runs[r].name), **values))
    return out


def _left_alone(rough: Regression, rows: Mask) -> Array:
    """Root mean square (channels,) of what is left of some rows at parameters of their own [change over a box]."""
    slopes, white = rough.slopes[:, rows] @ rough.shown.basis, rough.white[:, rows]
    flat = slopes.reshape(white.size, -1)
    left = white - slopes @ np.linalg.lstsq(flat, white.reshape(-1), rcond=None)[0]
    return np.sqrt(np.square(left).mean(1)) * [noise.std for noise in rough.noises]


def _alone(regression: Regression, rows: Mask, blocks: Labels) -> tuple[Array, Array, Array] | None:
    """How far one run moves the parameters, the covariance of that, and X' X; None where it shows too little."""
    slopes = regression.slopes[:, rows] @ regression.shown.basis
    white = regression.white[:, rows]
    flat = slopes.reshape(white.size, -1)
    square = flat.T @ flat
    try:
        own = np.asarray(np.linalg.solve(square, flat.T @ white.reshape(-1)), dtype=np.float64)
        left = white - slopes @ own
        sure = spread(slopes, left, np.unique(blocks, return_inverse=True)[1].reshape(-1), 0)
    except (np.linalg.LinAlgError, NsdeError):
        return None
    if not (np.isfinite(own).all() and np.isfinite(sure.covariance).all()):
        return None
    return own, sure.covariance, square
