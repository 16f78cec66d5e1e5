"""Brownian increments dW ~ N(0, dt), drawn from a generator that the caller holds.

Increments of one path on a step dt add up to those on a multiple of dt: W(t + k dt) - W(t) = dW_1 + ... +
dW_k.
"""

import torch
from torch import Tensor

from nsde_torch.errors import ShapeError, SolverError


def brownian(
    particles: int,
    batch: int,
    horizon: int,
    nz: int,
    *,
    dt: float,
    generator: torch.Generator,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Independent increments of a Wiener process in every particle, row, step and channel.

    They are drawn on the generator's device and moved, so a CPU generator gives the same noise on every
    device.

    Args:
        particles: Number of particles P, >= 1.
        batch: Number of rows B, >= 0.
        horizon: Number of steps T, >= 1.
        nz: Number of channels, >= 1.
        dt: Length of a step [s], > 0.
        generator: Source of the randomness.
        device: Where the increments shall lie; default: the generator's device.
        dtype: Floating type; default: torch's default.

    Returns:
        dW (P, B, T, nz) with variance dt. Steps lie outermost in memory, so that `rollout` reads them in one
        piece.

    Raises:
        SolverError: A count is too small or `dt` is not positive and finite.
    """
    for name, value, least in (
        ("particles", particles, 1),
        ("batch", batch, 0),
        ("horizon", horizon, 1),
        ("nz", nz, 1),
    ):
        if value < least:
            raise SolverError(f"`{name}` must be an integer >= {least}; got {value}.")
    check_dt(dt)
    normal = torch.randn(
        horizon, particles, batch, nz, generator=generator, device=generator.device, dtype=dtype
    )
    return normal.mul_(dt**0.5).to(device=device or generator.device).permute(1, 2, 0, 3)


def coarsen(dw: Tensor, factor: int) -> Tensor:
    """The same Brownian paths on a step `factor` times longer.

    Args:
        dw: Increments (..., T, nz) on the short step.
        factor: Number of short steps in a long one, >= 1, a divisor of T.

    Returns:
        Increments (..., T / factor, nz).

    Raises:
        ShapeError: `factor` does not divide the number of steps.
    """
    steps = dw.shape[-2]
    if factor < 1 or steps % factor:
        raise ShapeError(f"`factor` must divide the {steps} steps of `dw` {tuple(dw.shape)}; got {factor}.")
    return dw.reshape(*dw.shape[:-2], steps // factor, factor, dw.shape[-1]).sum(-2)


def check_dt(dt: float) -> None:
    """Refuse a step length that is not a positive finite number of seconds.

    Raises:
        SolverError: As said.
    """
    if not 0.0 < dt < float("inf"):
        raise SolverError(f"`dt` must be a positive, finite number of seconds; got {dt!r}.")
