"""What residuals may depend on: flexible functions of everything that was measured, in the middle of each box.

Beside each variable stand its products with the others, itself times the time in the run and times each run (a
parameter that drifts or differs between runs), inputs as they were before (something with a memory), the time and the
run.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.effects import Port
from nsde_torch.effects.by_run import RUN
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.names import MIXED
from nsde_torch.systems.vocabulary import named_inputs

Functions: TypeAlias = Callable[[], tuple[Array, Mask]]
"""Makes the functions of a group (M, q), and which of them are odd (q,): all of them at once take 100 MB."""

_HATS = 7  # bumps over the range of a variable
_WAVES = 6  # cosines over the length of a run
MOST_RUNS = 12  # up to which each run has functions of its own, the constant one under the name `RUN`
_FAR, _FAR_BOTH = 4.0, 6.0  # standard deviations, of one variable and of a product
_BEFORE_S = (0.01, 0.02, 0.04, 0.08)  # how long before
# a drag |w| v of a robot that turns both ways shows in no product a b: 260 nats passed for noise (test_own_machines)
PRODUCTS = ("{} * {}", "abs({}) * {}", "{} * abs({})")
"""How two variables are multiplied in a group of `OTHERS`, for each of the others."""
OTHERS, OVER_TIME, BY_RUN, BEFORE = " times others", " over time", " by run", " before"
"""Ends of the names of groups: a variable times other ones, time or run, and an input as it was before."""
SMOOTH = 5
"""How many of `functions_of`, ahead of the others, one run alone is asked for: blocks of time distinguish no more."""


@dataclass(frozen=True)
class Measured:
    """What the residuals of a regression may be drawn against, in the middle of each box."""

    columns: dict[str, Array]  # variables by name (M,)
    t: Array  # time in the run (M,) [s]


def measured(regression: Regression, *, inputs: bool) -> Measured:
    """All that was measured; states are foreseen from earlier steps, so that gusts and sensor noise are not in them.

    Inputs that were restored from an average err, and what a residual holds of such an error depends on them.
    """
    physics, system = regression.physics, regression.vector.system
    x = physics.middle(regression.theta)[:, : system.nx]
    values = machine_variables(system, x, physics.steps.u, inputs=inputs)
    table = {name: np.asarray(v.numpy()) for name, v in values.items()}
    single, box = regression.single, regression.box
    columns = {k: single.summed(v[:, None], box)[:, 0] / box for k, v in table.items() if v.std() > 1e-9}
    starts = physics.steps.t.numpy()
    return Measured(columns, single.summed(starts[:, None], box)[:, 0] / box)


def machine_variables(system: System, x: Tensor, u: Tensor, *, inputs: bool) -> dict[str, Tensor]:
    """All that a machine measures (N,), by name: features of an attitude in its place, and places.

    Of states (N, nx and more), and of inputs and logged channels (N, nu + n); the `inputs` too, if asked for.
    """
    x = x[:, : system.nx]
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
    columns = zip(system.exogenous, u[:, system.nu :].T, strict=True)
    return out | {name: column for name, column in columns if name != RUN}


def functions_of(v: Array) -> tuple[Array, Mask]:
    """Odd and even functions and bumps of one standardised variable (M, q), and which of them are odd."""
    centre, spread = np.median(v), max(float(np.quantile(v, 0.95) - np.quantile(v, 0.05)) / 2, 1e-12)
    about_zero = v / spread if abs(centre) < spread else (v - centre) / spread
    s = np.clip(about_zero, -3, 3)
    edges = np.unique(np.quantile(v, np.linspace(0.02, 0.98, _HATS)))
    columns = [s, s**3, np.tanh(5 * s), s**2, np.abs(s), s**4, s**5]
    odd = [True, True, True, False, False, False, True]
    if len(edges) > 3:
        width = np.diff(edges)
        for i in range(1, len(edges) - 1):
            up, down = (v - edges[i - 1]) / width[i - 1], (edges[i + 1] - v) / width[i]
            columns.append(np.clip(np.minimum(up, down), 0, 1))
            odd.append(False)
    return np.stack(columns, 1), np.array(odd)


def functions_of_groups(
    system: System,
    columns: Mapping[str, Array],
    t: Array,
    owners: Labels,
    edges: Sequence[tuple[int, int]],
    *,
    before: Sequence[int],
) -> Iterator[tuple[str, Functions]]:
    """Names of groups, and what makes their functions (M, q).

    Of variables by name, time in the run [s] and number of the run (M,); inputs are looked at so many rows `before`, in
    the same stretch.
    """
    for name, v in columns.items():
        yield name, partial(functions_of, v)
    names = list(columns)
    scaled = {k: (v - v.mean()) / max(float(v.std()), 1e-12) for k, v in columns.items()}
    for i, first in enumerate(names[:-1]):
        others = [scaled[second] for second in names[i + 1 :]]
        made = _even(lambda v, w: [p for one in w for p in _products(v, one)], scaled[first], others)
        yield first + OTHERS, made
    runs, phase = np.unique(owners), np.empty(len(t))
    for run in runs:
        own = owners == run
        phase[own] = (t[own] - t[own].min()) / max(float(np.ptp(t[own])), 1e-9)
    drift = [2.0 * phase - 1.0, (2.0 * phase - 1.0) ** 2]
    few = 1 < len(runs) <= MOST_RUNS
    for name, v in scaled.items():
        yield name + OVER_TIME, _even(lambda v: [np.clip(v, -_FAR, _FAR) * d for d in drift], v)
        if few:
            yield name + BY_RUN, _even(lambda v: [np.clip(v, -_FAR, _FAR) * (owners == r) for r in runs], v)
    for name in (n for n in (*MIXED, *system.input_names) if n in columns):
        yield name + BEFORE, _even(lambda v: [_before(v, edges, k) for k in before], columns[name])
    yield "time", _even(lambda: [phase - 0.5, *(np.cos(np.pi * k * phase) for k in range(1, _WAVES + 1))])
    if few:
        yield RUN, _even(lambda: [(owners == r) * 1.0 for r in runs])


def _products(a: Array, b: Array) -> list[Array]:
    """Products of two standardised variables, with the sign of each and of both, as `PRODUCTS` has them."""
    return [np.clip(p, -_FAR_BOTH, _FAR_BOTH) for p in (a * b, np.abs(a) * b, a * np.abs(b))]


def _even(made: Callable[..., Sequence[Array]], *given: Any) -> Functions:
    """What makes functions side by side, none of which is odd."""

    def both() -> tuple[Array, Mask]:
        functions = np.stack(made(*given), 1)
        return functions, np.zeros(functions.shape[1], dtype=bool)

    return both


def rows_before(dt: float, pace: float, *, moved: bool) -> list[int]:
    """How many rows of `dt` [s] before inputs are looked at.

    Between rows, channels curve where inputs change; what `moved` channels to where they belong does not know.
    """
    return sorted({max(1, round(seconds * pace / dt)) for seconds in (_BEFORE_S[1:] if moved else _BEFORE_S)})


def _before(v: Array, edges: Sequence[tuple[int, int]], boxes: int) -> Array:
    """A variable (M,) as it was so many boxes before, in the same stretch."""
    out = v.copy()
    for a, b in edges:
        out[a:b] = v[np.maximum(np.arange(a, b) - boxes, a)]
    return out


_ROWS = 500  # of the data, evenly chosen
_MOVES = 0.3  # of the largest change of a channel


@torch.no_grad()
def moved_channels_of(
    regression: Regression, disturbances: Sequence[tuple[Port, int]]
) -> list[tuple[str, ...]]:
    """Names of the channels that each disturbance moves, what it moves most first."""
    system, physics = regression.vector.system, regression.physics
    s, some = physics.steps, torch.linspace(0, len(physics.steps) - 1, min(len(physics.steps), _ROWS)).long()
    t, u = s.t[some], s.u[some]
    z = system.project(system.augment(s.x0[some, : system.nx], u))
    still, sizes = system.drift(t, z, u), []
    for port, column in disturbances:
        force = z.new_zeros(len(z), system.width_of(port))
        force[:, column] = 1.0
        change = (system.drift(t, z, u, {port: force}) - still)[:, : system.nx]
        turned = physics.turn(change, physics.attitude[some])[:, regression.rows]
        sizes.append(turned.square().mean(0).sqrt().numpy())
    size = np.array(sizes)
    share = size / np.maximum(size.max(0, initial=0.0), 1e-300)
    names = [physics.names[c] for c in regression.rows]
    return [
        tuple(names[i] for i in np.argsort(-own, kind="stable") if i == own.argmax() or own[i] > _MOVES)
        for own in share
    ]
