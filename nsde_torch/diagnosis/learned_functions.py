"""What functions of all that was measured explain beside physics, on blocks of time that they were not fitted to.

The functions are those that residual networks of `nsde train` learn (`nsde_torch.inference.functions`): what a
diagnosis says can be won is what training reaches. In a diagnosis they may be of inputs and places too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.diagnosis.fitted import fitted_system
from nsde_torch.diagnosis.hidden import allowances_of_tests
from nsde_torch.diagnosis.laws import pushes_of
from nsde_torch.diagnosis.regressors import Regressors, machine_variables
from nsde_torch.diagnosis.search import Base
from nsde_torch.effects import Port
from nsde_torch.inference import Optimum, nearly_maximised
from nsde_torch.inference.functions import Functions, Variables, learned
from nsde_torch.sysid.loop_test import LoopTest
from nsde_torch.sysid.noise import Noise
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import named_inputs, vocabulary

Array = NDArray[np.float64]

_MOVES = 0.3  # of the largest change of a channel: rows of ports that move it


@dataclass(frozen=True)
class RowGain:
    """What functions on one row of a port explain.

    Args:
        row: Its name, `body_force[z]`.
        unit: Of a force there.
        port: Number of the disturbance of the likelihood.
        size: Root mean square of the functions over the data.
        nats: Held-out log likelihood that they bring.
        error: Its standard error.
        variables: What they are of, with the log likelihood that is lost without these [nats], the most first.
        channels: Those that the row moves.
    """

    row: str
    unit: str
    port: int
    size: float
    nats: float
    error: float
    variables: Mapping[str, float]
    channels: frozenset[str]


@dataclass(frozen=True)
class FunctionGain:
    """Functions beside physics.

    Args:
        base: The physics.
        at: The optimum of its likelihood.
        functions: The functions.
        rows: What they explain beyond what feedback may hide, by row of a port, the most first.
    """

    base: Base
    at: Optimum
    functions: Functions
    rows: tuple[RowGain, ...]

    @property
    def nats(self) -> float:
        """What the rows explain [nats]."""
        return sum(row.nats for row in self.rows)

    def noises(self, variables: Regressors) -> dict[int, Noise]:
        """Noise models of what the functions leave, by number of the channel among the rows of the regression."""
        r = self.base.regression
        limits, rest = r.carry_limits(), r.residual[:, r.rows].copy()
        pushes = dict(pushes_of(self.base, [r.physics.names[c] for c in r.rows]))
        moved = set()
        for row in self.rows:
            if row.row not in pushes:
                continue
            change = r.single.summed(pushes[row.row], r.box)[:, r.rows]
            rest -= change * self.functions.force(variables.columns, row.port)[0][:, None]
            moved |= {c for c, k in enumerate(r.rows) if r.physics.names[k] in row.channels}
        return {c: r.law(r.rows[c], rest[:, c], float(limits[r.rows[c]]), r.orders) for c in sorted(moved)}


@torch.no_grad()
def function_gain(
    base: Base,
    near: Optimum,
    tested: LoopTest,
    *,
    most: int,
) -> FunctionGain:
    """Look for functions beside physics.

    Args:
        base: The physics at its optimum.
        near: An optimum of the likelihood of the same log: of this physics, or of physics close to it.
        tested: What the data say of the loop.
        most: Most groups of functions of one row.
    """
    at = optimum_of(fitted_system(base.regression), near)
    space, system = at.of.space, at.of.vector.system
    variables = _variables(at)
    ports = [k for k, (port, _) in enumerate(space.disturbances) if port in system.residual_ports]
    found = learned(at, variables, ports, most=most)
    counted = space.chunks.counted
    table = variables.values(at.about.x[counted], space.chunks.u[counted]).numpy()
    values = {name: table[:, k] for k, name in enumerate(variables.names)}
    moved, allowed = _moved(at), allowances_of_tests(tested)
    rows = []
    for port, nats in found.nats.items():
        if nats > 0.5 * max((allowed.get(name, 0.0) for name in moved[port]), default=0.0):
            name, unit = _row(system, *space.disturbances[port])
            size = float(np.sqrt(np.square(found.force(values, port)[0]).mean()))
            rows.append(
                RowGain(
                    name, unit, port, size, nats, found.error[port], _importance(found, port), moved[port]
                )
            )
    return FunctionGain(base, at, found, tuple(sorted(rows, key=lambda r: -r.nats)))


def optimum_of(system: System, near: Optimum) -> Optimum:
    """The optimum of a machine on the rows of another one; that itself where it is of the same physics."""
    if near.of.vector.system.effect_names == system.effect_names:
        return near
    return nearly_maximised(near.of.of(system), near)[1]


def _variables(at: Optimum) -> Variables:
    """All that the machine measures; an angle whose sine and cosine are there is not one of them."""
    system, chunks = at.of.vector.system, at.of.space.chunks
    some = machine_variables(system, at.about.x[0], chunks.u[0], inputs=True)
    names = [n for n in some if not {f"sin_{n}", f"cos_{n}"} <= some.keys()]

    def values(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        known = machine_variables(system, x, u, inputs=True)
        return torch.stack([known[name] for name in names], 1)

    return Variables(tuple(names), values, lambda u: named_inputs(system, u))


def _moved(at: Optimum) -> list[frozenset[str]]:
    """Channels that each disturbance moves."""
    space, names = at.of.space, at.of.vector.system.error_names
    size = at.about.slopes[..., space.ne :].square().mean((0, 1)).sqrt()[: space.ne]
    share = size / size.amax(1, keepdim=True).clamp_min(1e-300)
    return [frozenset(n for n, s in zip(names, own, strict=True) if s > _MOVES) for own in share.T.tolist()]


def _row(system: System, port: Port, column: int) -> tuple[str, str]:
    """Name and unit of the row of a port."""
    rows = dict(vocabulary(type(system)).ports)[port.value]
    return rows.written(port.value)[column], rows.units[column]


def _importance(found: Functions, port: int) -> dict[str, float]:
    """Log likelihood that is lost without the functions of each variable on a row [nats], the most first."""
    out: dict[str, float] = {}
    for group, lost in zip(found.groups, found.lost, strict=True):
        if group.port == port and group.kind != "past":
            for name in group.variables:
                out[name] = out.get(name, 0.0) + lost
    return dict(sorted(out.items(), key=lambda item: -item[1]))
