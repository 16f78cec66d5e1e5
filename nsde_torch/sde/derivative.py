"""Slopes d g_i / d z_i of a diagonal diffusion, and the drift that turns one calculus into the other.

dz = f dt + g o dW (Stratonovich)  equals  dz = (f + c) dt + g dW (Ito)  with  c_i = g_i (d g_i / d z_i) / 2
(Kloeden and Platen 1992, section 4.9), for diagonal noise, coupled or not.
"""

from typing import Literal, final

import torch
from torch import Tensor

from nsde_torch.errors import SolverError
from nsde_torch.sde.protocol import SDE, HasDiagonalDerivative, HoldsColumns, Time, within


def diffusion_and_slope(sde: SDE, t: Time, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The diffusion, and the slope of each of its channels in its own state, exact and differentiable.

    An equation with `diffusion_diagonal_derivative` answers itself. Otherwise nz reverse-mode products run as
    one batch and each gives its diagonal entry: the work of about nz diffusions, memory O(N nz) a layer, and
    no Jacobian (N, nz, nz) is kept. (Forward mode would do too, but torch 2.13 cannot compile its gradient.)

    Args:
        sde: The equation.
        t: Time [s], a number, 0-d, or (N,).
        z: State (N, nz).
        u: Input (N, nu).

    Returns:
        g and d g_i / d z_i, each (N, nz), in units of z and in 1 per square root of a second.
    """
    if isinstance(sde, HasDiagonalDerivative):
        return sde.diffusion(t, z, u), sde.diffusion_diagonal_derivative(t, z, u)

    result = torch.func.vjp(lambda state: sde.diffusion(t, state, u), z)
    g: Tensor = result[0]
    pull_back = result[1]

    def entry(channel: Tensor) -> Tensor:
        return torch.sum(pull_back(channel.expand_as(g))[0] * channel, -1)

    basis = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    return g, torch.vmap(entry, out_dims=-1)(basis)


def drift_correction(sde: SDE, t: Time, z: Tensor, u: Tensor) -> Tensor:
    """The drift c = g g' / 2 to add to a Stratonovich drift for the Ito equation of the same process.

    Args:
        sde: The equation.
        t: Time [s], a number, 0-d, or (N,).
        z: State (N, nz).
        u: Input (N, nu).

    Returns:
        c, (N, nz), in units of z per second.
    """
    g, slope = diffusion_and_slope(sde, t, z, u)
    return 0.5 * g * slope


@final
class _Converted:
    """The same process as `source`, written in the other calculus."""

    def __init__(self, source: SDE, calculus: Literal["ito", "stratonovich"]) -> None:
        self.source = source
        self.calculus: Literal["ito", "stratonovich", "either"] = calculus
        self._sign = 1.0 if calculus == "ito" else -1.0

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.source.drift(t, z, u) + self._sign * drift_correction(self.source, t, z, u)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.source.diffusion(t, z, u)

    def project(self, z: Tensor) -> Tensor:
        return self.source.project(z)

    def set_step(self, dt: float) -> None:
        if isinstance(self.source, HoldsColumns):
            self.source.set_step(dt)

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        return within(self.source, z, y)


def with_calculus(sde: SDE, calculus: Literal["ito", "stratonovich"]) -> SDE:
    """The same process written in the other calculus, so that a step of that calculus may integrate it.

    Args:
        sde: An equation that declares "ito" or "stratonovich".
        calculus: The calculus to write it in.

    Returns:
        `sde` itself if it is in that calculus already, else an equation with the drift correction added or
        taken.

    Raises:
        SolverError: `sde.calculus` is "either", so there is no process to preserve.
    """
    if sde.calculus == "either":
        raise SolverError('`sde.calculus` must be "ito" or "stratonovich" to be converted; got "either".')
    return sde if sde.calculus == calculus else _Converted(sde, calculus)
