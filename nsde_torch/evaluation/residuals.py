"""What declared physics leaves of every step of the log, and how a force on a port would move it.

    r_k = (x_{k+1} - x_k) - int f(x(t), u_k; theta) dt,        r_k = h B_k g(y_k) + noise_k

B_k is the slope of the rates in the forces of the ports, g what a network says of features y_k. Both are taken at the
state that the model foresees from some steps earlier (`identify.physics`), so that neither sensor noise of the step nor
a gust inside it is in them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.effects import Port
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.sysid.noise import Series
from nsde_torch.sysid.physics import Physics

_MOVES = 1e-6  # of the largest slope: below that a port does not move a channel


@dataclass(frozen=True)
class Residuals:
    """Residuals of the steps of some runs."""

    states: Tensor  # foreseen states in the middle of each step (N, nx)
    # what physics leaves of the change over each step (N, nx); velocities of a machine with an attitude in body
    # axes
    change: Array
    response: Tensor
    """Change over a step by a unit of each force (N, channels, width), on the channels `rows`."""
    ports: tuple[tuple[Port, int], ...]  # ports in the order of the columns of `response`, with their widths
    rows: NDArray[np.int64]  # numbers of the channels that a force moves
    series: Series  # stretches of the steps
    dt: float  # length of a step [s], physical


def residuals(physics: Physics, theta: Array, ports: Sequence[Port]) -> Residuals:
    """Residuals of physics at theta, and the slopes in the forces on some ports."""
    middle, change = physics.middle(theta), physics.residual(theta)
    system, s = physics.vector.system, physics.steps
    nx = system.nx
    columns = []
    with torch.no_grad():
        rate = system.drift(s.t, middle, s.u)[:, :nx]
        for port in ports:
            for j in range(system.ports[port]):
                push = torch.zeros(len(s), system.ports[port], dtype=middle.dtype)
                push[:, j] = 1.0
                moved = system.drift(s.t, middle, s.u, {port: push})[:, :nx]
                columns.append(physics.in_channels(s.dt * (moved - rate), middle))
    response = torch.stack(columns, 2) if columns else torch.zeros(len(s), nx, 0, dtype=middle.dtype)
    largest = response.abs().amax((0, 2)).numpy() if columns else np.zeros(nx)
    rows = np.flatnonzero(largest > _MOVES * max(float(largest.max()), 1e-300))
    return Residuals(
        states=middle[:, :nx],
        change=change,
        response=response[:, rows],
        ports=tuple((port, system.ports[port]) for port in ports),
        rows=rows,
        series=Series(s.segments),
        dt=s.dt,
    )


def with_networks(physics: Physics, model: NeuralSDE) -> Physics:
    """Physics with the residual networks of a model beside it.

    What physics alone foresees is off where networks do much: of a cart with a quadratic damping of 4.5 m/s2 that they
    had learned to 0.01, 0.15 m/s2 seemed to be left.
    """
    return physics.beside(lambda x: {port: f.double() for port, f in model.residual(x.float()).items()})


def disturbed_channels(model: NeuralSDE, found: Residuals) -> list[int]:
    """Column of `Residuals.rows` that each disturbance of a model moves most."""
    out, at = [], 0
    size = found.response.abs().mean(0)  # (channels, width)
    for port, width in found.ports:
        if port in model.disturbed_ports:
            out += [int(size[:, at + j].argmax()) for j in range(width)]
        at += width
    return out
