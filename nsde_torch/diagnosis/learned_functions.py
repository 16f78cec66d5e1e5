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

from nsde_torch.diagnosis.hidden import allowances_of_tests
from nsde_torch.diagnosis.regressors import machine_variables
from nsde_torch.effects import Port
from nsde_torch.evaluation.bootstrap import FEWEST_BLOCKS
from nsde_torch.inference import Optimum, nearly_maximised
from nsde_torch.inference.functions import Functions, Variables, learned
from nsde_torch.sysid.loop_test import LoopTest
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import named_inputs, vocabulary

Array = NDArray[np.float64]

_MOVES = 0.3  # of the largest change of a channel: rows of ports that move it


@dataclass(frozen=True)
class RowGain:
    """What functions on one row of a port explain."""

    row: str  # its name, `body_force[z]`
    unit: str  # of a force there
    port: int  # number of the disturbance of the likelihood
    size: float  # root mean square of the functions over the data
    nats: float  # held-out log likelihood that they bring
    error: float  # its standard error
    variables: Mapping[str, float]
    """What they are of, with the log likelihood that is lost without these [nats], the most first."""
    channels: frozenset[str]  # those that the row moves


@dataclass(frozen=True)
class FunctionGain:
    """Functions beside physics."""

    at: Optimum  # the optimum of the physics
    functions: Functions
    rows: tuple[RowGain, ...]
    """What they explain beyond what feedback may hide, by row of a port, the most first."""

    @property
    def nats(self) -> float:
        """What the rows explain [nats]."""
        return sum(row.nats for row in self.rows)


@torch.no_grad()
def functions_beside(at: Optimum, most: int) -> Functions | None:
    """Functions beside the physics of an optimum; None where they would say nothing.

    Args:
        at: The optimum.
        most: Most groups of functions of one row.
    """
    space, system = at.of.space, at.of.vector.system
    if not most or len(at.blocks) < FEWEST_BLOCKS:
        return None
    ports = [k for k, (port, _) in enumerate(space.disturbances) if port in system.residual_ports]
    return learned(at, _variables(at), ports, most=most)


@torch.no_grad()
def function_gain(at: Optimum, found: Functions, tested: LoopTest) -> FunctionGain:
    """What functions explain beyond what feedback may hide, row by row.

    Args:
        at: The optimum of the physics that they stand beside.
        found: The functions.
        tested: What the data say of the loop.
    """
    space, system, variables = at.of.space, at.of.vector.system, _variables(at)
    counted = space.chunks.counted
    table = variables.values(at.x[counted], space.chunks.u[counted]).numpy()
    values = {name: table[:, k] for k, name in enumerate(variables.names)}
    moved, allowed = _moved(at), allowances_of_tests(tested)
    rows = []
    for port, nats in found.nats.items():
        if nats > 0.5 * max((allowed.get(name, 0.0) for name in moved[port]), default=0.0):
            name, unit = _row(system, *space.disturbances[port])
            size = float(np.sqrt(np.square(found.force(values, port)[0]).mean()))
            rows.append(
                RowGain(name, unit, port, size, nats, found.error[port], found.importance(port), moved[port])
            )
    return FunctionGain(at, found, tuple(sorted(rows, key=lambda r: -r.nats)))


def optimum_of(system: System, near: Optimum) -> Optimum:
    """The optimum of a machine on the rows of another one; that itself where it is of the same physics."""
    if near.of.vector.system.effect_names == system.effect_names:
        return near
    return nearly_maximised(near.of.of(system), near)[1]


def _variables(at: Optimum) -> Variables:
    """All that the machine measures; an angle whose sine and cosine are there is not one of them."""
    system, chunks = at.of.vector.system, at.of.space.chunks
    some = machine_variables(system, at.x[0], chunks.u[0], inputs=True)
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
