"""What residuals may depend on: flexible functions of everything that was measured, in the middle of each box.

The functions are taken at states foreseen from earlier steps, so that gusts and sensor noise are not in them. Beside
each variable stand its products with the others, itself times the time in the run and times each run (a parameter that
drifts or differs between runs), inputs as they were before (something with a memory), the time and the run.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions
from nsde_torch.diagnosis.evidence import orthonormal
from nsde_torch.sysid.noise import Series
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.names import MIXED
from nsde_torch.systems.vocabulary import named_inputs

Functions: TypeAlias = Callable[[], tuple[Array, NDArray[np.bool_]]]
"""Makes the functions of a group (M, q), and which of them are odd (q,): all of them at once take 100 MB."""

_HATS = 7  # bumps over the range of a variable


_WAVES = 6  # cosines over the length of a run


_MOST_RUNS = 12  # up to which each run has functions of its own


_FAR = 4.0  # standard deviations


_BEFORE_BOXES = (1, 2, 4, 8)  # how long before, in boxes


OVER_TIME, BY_RUN, BEFORE = " over time", " by run", " before"
"""Ends of the names of groups: a variable times time or run, and an input as it was before."""


SMOOTH = 7
"""How many of `functions_of` are smooth over the whole range, ahead of the hats."""


def _columns(regression: Regression, *, inputs: bool) -> tuple[dict[str, Array], Array]:
    """Variables that a residual may depend on, in the middle of each box (M,), and the time in the run (M,) [s].

    States that are foreseen (positions and rates, of a quaternion what the system's features make of it), inputs if
    asked for, and logged channels.
    """
    physics, system = regression.physics, regression.vector.system
    x = physics.middle(regression.theta)[:, : system.nx]
    values = machine_variables(system, x, physics.steps.u, inputs=inputs)
    table = {name: np.asarray(v.numpy()) for name, v in values.items()}
    single, box = regression.single, regression.box
    columns = {k: single.summed(v[:, None], box)[:, 0] / box for k, v in table.items() if v.std() > 1e-9}
    starts = physics.steps.t.numpy()
    return columns, single.summed(starts[:, None], box)[:, 0] / box


def machine_variables(system: System, x: Tensor, u: Tensor, *, inputs: bool) -> dict[str, Tensor]:
    """All that a machine measures (N,), by name: features of an attitude in its place, and places.

    Args:
        system: The machine.
        x: States (N, nx).
        u: Inputs and logged channels (N, nu + n).
        inputs: Whether inputs are among them.
    """
    q, features = system.quaternion, system.residual_features(x)
    names = [*system.feature_names]
    names += [f"up_{'xyz'[i]}" for i in range(features.shape[1] - len(names))]
    out = dict(zip(names, features.T, strict=True))
    for i, name in enumerate(system.state_names):
        inside = q is not None and q.start <= i < q.stop
        seen = name in out or (q is not None and name.startswith("v_"))
        if not (inside or seen):
            out[name] = x[:, i]
    if inputs:
        out |= named_inputs(system, u)
    return out | dict(zip(system.exogenous, u[:, system.nu :].T, strict=True))


def functions_of(v: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Odd and even functions and bumps of one standardised variable (M, q), and which of them are odd."""
    centre, spread = np.median(v), max(float(np.quantile(v, 0.95) - np.quantile(v, 0.05)) / 2, 1e-12)
    about_zero = v / spread if abs(centre) < spread else (v - centre) / spread
    s = np.clip(about_zero, -3, 3)
    edges = np.quantile(v, np.linspace(0.02, 0.98, _HATS))
    edges = np.unique(edges)
    columns = [s, s**3, np.tanh(5 * s), s**2, np.abs(s), s**4, s**5]
    odd = [True, True, True, False, False, False, True]
    if len(edges) > 3:
        width = np.diff(edges)
        for i in range(1, len(edges) - 1):
            up, down = (v - edges[i - 1]) / width[i - 1], (edges[i + 1] - v) / width[i]
            columns.append(np.clip(np.minimum(up, down), 0, 1))
            odd.append(False)
    return np.stack(columns, 1), np.array(odd)


@dataclass(frozen=True)
class Regressors:
    """All that the residuals of a regression may depend on, in the middle of each box."""

    columns: dict[str, Array]  # variables by name (M,)
    t: Array  # time in the run (M,) [s]
    functions: Mapping[str, Functions]
    """Of each variable, product, drift, difference between runs, input before, time and run (M, q); which are odd."""
    inputs: bool = True  # whether the inputs are what acted
    decisions: Decisions = DECISIONS  # what tests of them decide by
    budgets: Budgets = BUDGETS  # how much they try

    def values(self, variable: str) -> Array:
        """A plain variable, or time (M,)."""
        return self.t if variable == "time" else self.columns[variable]


def regressors(
    regression: Regression,
    *,
    inputs: bool = True,
    moved: bool = False,
    decisions: Decisions = DECISIONS,
    budgets: Budgets = BUDGETS,
) -> Regressors:
    """Everything that the residuals of a regression may depend on.

    Args:
        regression: At its optimum.
        inputs: Whether the inputs are what acted. Those that were restored from an average err, and what a residual
            holds of such an error depends on them.
        moved: Whether channels were moved to where they belong. Between rows, they bend where inputs change, and what
            moves them does not know.
        decisions: What tests of them decide by.
        budgets: How much they try.
    """
    columns, t = _columns(regression, inputs=inputs)
    before = _BEFORE_BOXES[1:] if moved else _BEFORE_BOXES
    functions = dict(_groups(regression, columns, t, before))
    return Regressors(columns, t, functions, inputs, decisions, budgets)


def _groups(
    regression: Regression, columns: dict[str, Array], t: Array, before: Sequence[int]
) -> Iterator[tuple[str, Functions]]:
    """Names of groups, and what makes their functions."""
    for name, v in columns.items():
        yield name, partial(functions_of, v)
    names = list(columns)
    scaled = {k: (v - v.mean()) / max(float(v.std()), 1e-12) for k, v in columns.items()}
    for i, first in enumerate(names[:-1]):
        others = [scaled[second] for second in names[i + 1 :]]
        yield (
            f"{first} times others",
            _even(lambda v, others: [np.clip(v * w, -6, 6) for w in others], scaled[first], others),
        )
    owners, runs = regression.owners, np.unique(regression.owners)
    phase = np.empty(len(t))
    for run in runs:
        own = owners == run
        phase[own] = (t[own] - t[own].min()) / max(float(np.ptp(t[own])), 1e-9)
    drift = [2.0 * phase - 1.0, (2.0 * phase - 1.0) ** 2]
    few = 1 < len(runs) <= _MOST_RUNS
    for name, v in scaled.items():
        yield name + OVER_TIME, _even(lambda v: [np.clip(v, -_FAR, _FAR) * d for d in drift], v)
        if few:
            yield name + BY_RUN, _even(lambda v: [np.clip(v, -_FAR, _FAR) * (owners == r) for r in runs], v)
    for name in _inputs_of(regression, columns):
        yield (
            name + BEFORE,
            _even(lambda v: [_before(v, regression.series, k) for k in before], columns[name]),
        )
    yield "time", _even(lambda: [phase - 0.5, *(np.cos(np.pi * k * phase) for k in range(1, _WAVES + 1))])
    if few:
        yield "run", _even(lambda: [(owners == r) * 1.0 for r in runs])


def _even(made: Callable[..., Sequence[Array]], *given: Any) -> Functions:
    """What makes functions side by side, none of which is odd."""

    def both() -> tuple[Array, NDArray[np.bool_]]:
        functions = np.stack(made(*given), 1)
        return functions, np.zeros(functions.shape[1], dtype=bool)

    return both


def _inputs_of(regression: Regression, columns: Mapping[str, Array]) -> list[str]:
    return [n for n in (*MIXED, *regression.vector.system.input_names) if n in columns]


def _before(v: Array, series: Series, boxes: int) -> Array:
    """A variable (M,) as it was so many boxes before, in the same stretch."""
    out = v.copy()
    for a, b in series.edges:
        out[a:b] = v[np.maximum(np.arange(a, b) - boxes, a)]
    return out


def own_space(regression: Regression, channel: int) -> Array:
    """Orthonormal columns (N, r) of what the parameters can do to a channel's whitened residual."""
    return orthonormal(regression.slopes[channel])


def projected(regression: Regression, channel: int, functions: Array, own: Array) -> Array:
    """Functions per unit of time (M, q), whitened and free of `own_space` (N, q)."""
    z = whitened_functions(regression, channel, functions)
    return np.asarray(z - own @ (own.T @ z))


def whitened_functions(regression: Regression, channel: int, functions: Array) -> Array:
    """Functions per unit of time (M, q), whitened (N, q)."""
    return regression.whitened(regression.noises[channel], functions * regression.dt)
