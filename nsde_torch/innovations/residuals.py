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
from scipy.signal import lfilter
from torch import Tensor, nn

from nsde_torch.effects import Port
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.sysid.noise import Noise, estimate, first_guess
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.series import Series

Array = NDArray[np.float64]

_FADING = (0.0, 0.5, 0.8, 0.9, 0.95)  # share of a memory that is left after a step
_SPANNED = 1e-3  # of the largest singular value: directions that inputs hardly take
_ROUNDING = 1e-9  # of the inputs: what is left of constant ones once their mean is taken off
_ORDERS_S, _ORDERS = 0.4, 40  # longest autoregression [s], [steps]
_MOVES = 1e-6  # of the largest slope: below that a port does not move a channel


@dataclass(frozen=True)
class Residuals:
    """Residuals of the steps of some runs.

    Args:
        states: Foreseen states in the middle of each step (N, nx).
        change: What physics leaves of the change over each step (N, nx); velocities of a machine with an attitude in
            body axes.
        response: Change over a step by a unit of each force (N, channels, width), on the channels `rows`.
        ports: Ports in the order of the columns of `response`, with their widths.
        rows: Numbers of the channels that a force moves.
        series: Stretches of the steps.
        dt: Length of a step [s], physical.
    """

    states: Tensor
    change: Array
    response: Tensor
    ports: tuple[tuple[Port, int], ...]
    rows: NDArray[np.int64]
    series: Series
    dt: float


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


def noise_models(found: Residuals, left: Array, limits: Array, *, first: bool = False) -> list[Noise]:
    """ARMA noise models of the channels that forces move.

    Args:
        found: Says which channels.
        left: What is left of every channel (N, nx).
        limits: Largest moving average of every channel (nx,).
        first: Take the noise for that of the sensors alone, while what is left is not noise.
    """
    orders = int(np.clip(round(_ORDERS_S / found.dt), 2, min(_ORDERS, max(len(found.series) // 50, 2))))
    out = []
    for c in found.rows.tolist():
        if first:
            out.append(first_guess(left[:, c], found.series, float(limits[c])))
        else:
            out.append(estimate(left[:, c], found.series, limit=float(limits[c]), orders=orders))
    return out


def pushed(model: NeuralSDE, networks: nn.Module, found: Residuals, y: Tensor | None = None) -> Tensor:
    """Change over each step by residual networks (channels, N).

    Args:
        model: Says what networks see and how large their unit is.
        networks: One by port; those of the model or others of the same form.
        found: Residuals, whose ports the networks are of.
        y: What the networks see (N, nr); None works it out.
    """
    assert isinstance(networks, nn.ModuleDict)
    if y is None:
        y = model.residual_inputs(model.system.network_features(found.states.float()))
    parts = [model.residual_scale(port) * networks[port.value](y) for port, _ in found.ports]
    return torch.einsum("ncw,nw->cn", found.response.float(), torch.cat(parts, 1))


def input_history(u: Array, series: Series) -> Tensor:
    """Inputs of each step and what several fading memories hold of those before it (N, p), in their own directions.

    Args:
        u: Inputs held over the steps (N, nu).
        series: Stretches of the steps.
    """
    centred = u - u.mean(0)
    _, values, directions = np.linalg.svd(centred, full_matrices=False)
    if not len(values) or values[0] <= _ROUNDING * np.linalg.norm(u):  # of constant inputs rounding is left
        return torch.zeros(len(u), 0)
    own = centred @ directions[values > _SPANNED * values[0]].T
    own = own / own.std(0)
    parts = [own]
    for keep in _FADING:
        faded = np.zeros_like(own)
        for a, b in series.edges:
            faded[a + 1 : b] = lfilter([1.0 - keep], [1.0, -keep], own[a : b - 1] - own[a], axis=0) + own[a]
            faded[a] = own[a]
        parts.append(faded)
    return torch.from_numpy(np.concatenate(parts, 1)).float()
