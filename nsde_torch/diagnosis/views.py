"""The residual of a channel against one variable: mean rates over the test function, and their means in bins.

A mean over a bin is that of all overlapping test functions whose variable lies in it; its standard error is that of a
ratio of sums over blocks of time,

    m = sum_b s_b / sum_b n_b,      var m = B / (B - 1) sum_b (s_b - m n_b)^2 / (sum_b n_b)^2

so that noise which lasts inside a block does no harm (Cochran, Sampling Techniques, 1977).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.regressors import BEFORE, BY_RUN, OVER_TIME, Regressors
from nsde_torch.sysid.explained import bump, per_second, smooth_rate
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_BINS, _FEWEST = 18, 4  # of a picture, and blocks of time in one
_BLOCK_S = 2.0  # for the errors of means in bins
_OTHERS = " times others"


@dataclass(frozen=True)
class Rates:
    """Mean residual rates over the test function, wherever it fits."""

    names: tuple[str, ...]
    units: tuple[str, ...]  # names, units: of the channels
    residual: Array  # residual rates (M, channels)
    values: Mapping[str, Array]  # by name of a variable: its mean over the same test function (M,)
    value_units: Mapping[str, str]  # unit of each variable
    run: Labels  # number of the run (M,)
    block: Labels  # block of time (M,)


@dataclass(frozen=True)
class Bins:
    """Means in bins of one variable."""

    centre: Array  # mean of the variable in each bin (B,)
    mean: Array  # mean of the residual (B,)
    error: Array  # standard error of it (B,)


def rates(regression: Regression, variables: Regressors) -> Rates:
    """Mean residual rates of the dynamic channels, and everything that they may depend on."""
    columns, t = variables.columns, variables.t
    edges = regression.series.edges
    window = bump(regression.dt)
    names = [*columns, "time"]
    table = np.column_stack([*columns.values(), t, *regression.residual[:, regression.rows].T])
    # `smooth_rate` divides by the step, as is due to changes over steps
    table[:, : len(names)] *= regression.dt
    smooth = smooth_rate(table, edges, window, regression.dt)
    owners = regression.physics.steps.runs
    counts = [max(b - a - len(window) + 1, 0) for a, b in edges]
    run = np.repeat(np.array(owners, dtype=np.int64), counts)
    place = np.concatenate([np.arange(n) for n in counts]) if sum(counts) else np.zeros(0, dtype=np.int64)
    stretch = np.repeat(np.arange(len(counts)), counts)
    _, block = np.unique(
        np.stack((stretch, (place * regression.dt / _BLOCK_S).astype(np.int64))), axis=1, return_inverse=True
    )
    units = regression.physics.units
    return Rates(
        names=tuple(regression.physics.names[c] for c in regression.rows),
        units=tuple(per_second(units[c]) for c in regression.rows),
        residual=smooth[:, len(names) :],
        values=dict(zip(names, smooth[:, : len(names)].T, strict=True)),
        value_units=variable_units(regression.vector.system),
        run=run,
        block=block.reshape(-1).astype(np.int64),
    )


def rates_width(regression: Regression) -> float:
    """Length of the test function of `rates` [s]."""
    return len(bump(regression.dt)) * regression.dt


def variable_units(system: System) -> dict[str, str]:
    """Unit of each variable that a residual may depend on, as far as it is known."""
    pairs = [
        *zip(system.input_names, system.input_units, strict=True),
        *zip(system.state_names, system.state_units, strict=True),
        *zip(system.feature_names, system.feature_units, strict=True),
    ]
    return {**dict(pairs), "time": "s"}


def is_plain(variable: str) -> bool:
    """Whether a variable can be an axis: no product, and not the number of a run."""
    return not variable.endswith((_OTHERS, OVER_TIME, BY_RUN, BEFORE)) and variable != "run"


def factors(variable: str) -> str | None:
    """The variable that is multiplied with others, or None."""
    return variable.removesuffix(_OTHERS) if variable.endswith(_OTHERS) else None


def bins(value: Array, residual: Array, block: Labels, *, count: int = _BINS) -> Bins:
    """Means in bins of equal numbers, from 1 to 99 % of the values; those of few blocks are left out.

    Args:
        value: The variable (M,).
        residual: The residual (M,).
        block: Block of time (M,).
        count: Number of bins.
    """
    if not len(value):
        return Bins(np.zeros(0), np.zeros(0), np.zeros(0))
    # half of the edges at equal numbers, half at equal distances, so that rare extremes are seen too
    inner = np.linspace(0.01, 0.99, count // 2 + 1)
    low, high = np.quantile(value, [0.01, 0.99])
    edges = np.unique(np.concatenate((np.quantile(value, inner), np.linspace(low, high, count // 2 + 1))))
    edges = edges[np.append(True, np.diff(edges) > 0.01 * (high - low))] if high > low else edges
    place = np.searchsorted(edges, value, side="right") - 1
    out = []
    for k in range(len(edges) - 1):
        inside = place == k
        _, owner = np.unique(block[inside], return_inverse=True)
        blocks = int(owner.max()) + 1 if owner.size else 0
        if blocks < _FEWEST:
            continue
        n, s = np.bincount(owner), np.bincount(owner, weights=residual[inside])
        mean = s.sum() / n.sum()
        error = np.sqrt(np.square(s - mean * n).sum() * blocks / (blocks - 1)) / n.sum()
        out.append((value[inside].mean(), mean, error))
    centre, mean, error = (
        np.array(column, dtype=np.float64) for column in (zip(*out, strict=True) if out else ((), (), ()))
    )
    return Bins(centre, mean, error)
