"""What `rollout` refuses before the first step, and how it reports numbers that are not finite."""

import torch
from torch import Tensor

from nsde_torch.errors import NonFiniteError, ShapeError, SolverError
from nsde_torch.sde.step import SDE, Step

# Brownian increments dW ~ N(0, dt), drawn from a generator that the caller holds.
#
# Increments of one path on a step dt add up to those on a multiple of dt: W(t + k dt) - W(t) = dW_1 + ... +
# dW_k.


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

    They are drawn on the generator's device and moved, so a CPU generator gives the same noise on every device.

    Args:
        particles, batch, horizon, nz: Numbers P, B, T, nz of particles, rows, steps and channels.
        dt: Length of a step [s], > 0.
        generator: Source of the randomness.
        device: Where the increments shall lie; default: the generator's device.
        dtype: Floating type; default: torch's default.

    Returns:
        dW (P, B, T, nz) with variance dt. Steps lie outermost in memory, so that `rollout` reads them in one piece.

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
    """The same Brownian paths on a step `factor` times longer: dW (..., T / factor, nz) of dW (..., T, nz).

    Raises:
        ShapeError: `factor` does not divide the number of steps.
    """
    steps = dw.shape[-2]
    if factor < 1 or steps % factor:
        raise ShapeError(f"`factor` must divide the {steps} steps of `dw` {tuple(dw.shape)}; got {factor}.")
    return dw.reshape(*dw.shape[:-2], steps // factor, factor, dw.shape[-1]).sum(-2)


def check_dt(dt: float) -> None:
    """Refuse a step length that is not a positive finite number of seconds (SolverError)."""
    if not 0.0 < dt < float("inf"):
        raise SolverError(f"`dt` must be a positive, finite number of seconds; got {dt!r}.")


def check_arguments(
    sde: SDE, z0: Tensor, u: Tensor, *, dt: float, step: Step, noise: Tensor | None, t0: float | Tensor
) -> int:
    """Refuse what does not fit together; the number of particles otherwise.

    Raises:
        ShapeError: A tensor has the wrong axes.
        SolverError: Calculus, noise, dtype, device or `dt` do not fit.
    """
    if not isinstance(step, Step):
        raise SolverError(f"`step` must be a Step; got {step!r}. Make one with make_step(name).")
    check_dt(dt)
    if z0.ndim != 2:
        raise ShapeError(f"`z0` must be (batch, nz); got {tuple(z0.shape)}. Add a batch axis.")
    batch, nz = z0.shape
    if u.ndim != 3 or u.shape[0] != batch:
        raise ShapeError(
            f"`u` must be (batch={batch}, horizon, nu); got {tuple(u.shape)}. Add the missing axis."
        )
    _check_like("u", u, z0)
    if isinstance(t0, Tensor) and t0.ndim and t0.shape != (batch,):
        raise ShapeError(f"`t0` must be one time or (batch={batch},); got {tuple(t0.shape)}.")
    step.check(sde)
    if step.deterministic:
        if noise is not None:
            raise SolverError(
                f"`noise` must be None with {step.name!r}, which solves sigma = 0; take a stochastic step."
            )
        return 1
    if noise is None:
        raise SolverError(
            f"`noise` must be given with {step.name!r}; draw it with brownian(), or take rk4 or midpoint."
        )
    if noise.ndim != 4 or noise.shape[1:] != (batch, u.shape[1], nz) or not noise.shape[0]:
        raise ShapeError(
            f"`noise` must be (particles, batch={batch}, horizon={u.shape[1]}, nz={nz}); "
            f"got {tuple(noise.shape)}. Draw it with brownian()."
        )
    _check_like("noise", noise, z0)
    return noise.shape[0]


def _check_like(name: str, value: Tensor, z0: Tensor) -> None:
    if not z0.is_floating_point():
        raise SolverError(f"`z0` must hold floating-point numbers; got {z0.dtype}.")
    if value.dtype != z0.dtype or value.device != z0.device:
        raise SolverError(
            f"`{name}` must have the dtype and device of `z0`, {z0.dtype} on {z0.device}; "
            f"got {value.dtype} on {value.device}. Move it with .to(z0)."
        )


def check_finite(
    path: Tensor,
    *,
    dt: float,
    t0: float | Tensor,
    remedy: str = "Shorten dt, clip the drift, or look for bad initial states.",
) -> None:
    """Report the first state of a rollout (P, B, T + 1, nz) that is infinite or not a number, with its remedy.

    Raises:
        NonFiniteError: With step, time [s], and the rows (particle, batch) hit at that step.
    """
    # A sum is infinite or NaN if one term is; it may also overflow, hence the exact test behind it.
    if bool(torch.isfinite(path.detach().sum())):
        return
    bad = ~torch.isfinite(path.detach()).all(-1)
    if not bool(bad.any()):
        return
    k = int(bad.any(0).any(0).nonzero()[0])
    rows = bad[:, :, k].nonzero()
    shown = ", ".join(f"({p}, {b})" for p, b in rows[:5].tolist())
    start = t0[rows[0, 1]] if isinstance(t0, Tensor) and t0.ndim else t0
    where = f"step {k} of {path.shape[2] - 1} (t = {float(start) + k * dt:g} s)"
    raise NonFiniteError(
        f"the rollout left the finite numbers at {where} in {len(rows)} of {bad[:, :, k].numel()} rows; "
        f"(particle, batch): {shown}{', ...' if len(rows) > 5 else ''}. {remedy}"
    )
