"""Rollouts: one step after another, every particle of every row at once, on noise that the caller gives.

z_0 given;   z_{k+1} = project(advance(t_k, z_k, u_k, dt, dW_k)),   t_k = t_0 + k dt.
"""

import contextlib
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from nsde_torch.columns import by_column
from nsde_torch.sde.checks import check_arguments, check_finite
from nsde_torch.sde.derivative import compiled, eager, quiet_compiler
from nsde_torch.sde.step import SDE, HoldsColumns, Step, Time


def rollout(
    sde: SDE,
    z0: Tensor,
    u: Tensor,
    *,
    dt: float,
    step: Step,
    noise: Tensor | None,
    t0: float | Tensor = 0.0,
    check: bool = True,
    compile: bool = False,
    correct: Callable[[int, Tensor], Tensor] | None = None,
) -> Tensor:
    """Sample paths of a controlled equation on a grid of equal steps.

    Differentiable in `z0`, `u`, `noise` and the parameters of `sde`. Where gradients are disabled the result
    is written into one buffer as it comes; wrap with torch.no_grad() whatever needs none. `z0` is taken as it
    is and not projected.

    Args:
        sde: The equation.
        z0: First state (B, nz).
        u: Inputs (B, T, nu); u[:, k] holds from t_k to t_{k+1}.
        dt: Length of a step [s], > 0.
        step: The method, from make_step.
        noise: Brownian increments (P, B, T, nz) from `brownian` with the same dt (their variance is not
            checked); None with a deterministic step, and only then.
        t0: Time of the first state [s], one for all or (B,).
        check: Raise if a state is not finite. Costs one reduction, and waits for the device.
        compile: Compile one step at the first call (see `compiled`); the same numbers, several times faster.
        correct: Gets the number of a step and the states of all paths (P B, nz) before it, and gives those that it
            begins with: a filter. The states that are returned are those before.

    Returns:
        States (P, B, T + 1, nz), the first of them z0; P = 1 with a deterministic step.

    Raises:
        ShapeError: A tensor has the wrong axes.
        SolverError: Calculus, noise, dtype, device or dt do not fit together.
        NonFiniteError: A state is infinite or not a number, and `check`.

    Example:
        >>> noise = brownian(32, 1, 100, 13, dt=0.01, generator=torch.Generator().manual_seed(0))
        >>> paths = rollout(sde, z0, u, dt=0.01, step=make_step("milstein"), noise=noise)
    """
    particles = check_arguments(sde, z0, u, dt=dt, step=step, noise=noise, t0=t0)
    if isinstance(sde, HoldsColumns):
        sde.set_step(dt)
    batch, nz = z0.shape
    rows, horizon = particles * batch, u.shape[1]

    def tile(x: Tensor) -> Tensor:
        return x if particles == 1 else x.repeat(particles, *(1,) * (x.ndim - 1))

    with torch.set_grad_enabled(torch.is_grad_enabled() and _needs_gradient(sde, z0, u, noise, t0)):
        keep = torch.is_grad_enabled()
        z, start = by_column(tile(z0)), tile(t0) if isinstance(t0, Tensor) and t0.ndim else t0
        length: Time = dt
        inputs = [v.T for v in tile(u).permute(1, 2, 0).contiguous().unbind(0)]
        increments: Sequence[Tensor | None] = [None] * horizon
        if noise is not None:
            increments = noise.permute(2, 0, 1, 3).reshape(horizon, rows, nz).unbind(0)
        times: Sequence[Time] = [start + k * dt for k in range(horizon)]
        advance = eager(step)
        compile = compile and step.compilable
        if compile:
            # Numbers would be compiled in as constants, and every time and dt would make code of its own; a
            # first state without gradient would make its code differ from that of all other steps.
            advance = compiled(step, sde)
            times = [torch.as_tensor(t, dtype=z0.dtype, device=z0.device) for t in times]
            length = torch.as_tensor(dt, dtype=z0.dtype, device=z0.device)
            if keep and not z.requires_grad:
                z = z.detach().requires_grad_()
        states = [z]
        buffer = z0.new_empty(0 if keep else horizon + 1, nz, rows)
        if not keep:
            buffer[0] = z.T
        with quiet_compiler() if compile else contextlib.nullcontext():
            for k in range(horizon):
                if correct is not None:
                    z = by_column(correct(k, z))
                z = advance(sde, times[k], z, inputs[k], length, increments[k])
                if keep:
                    states.append(z)
                else:
                    buffer[k + 1] = z.T
        path = torch.stack([z.T for z in states]) if keep else buffer
    path = path.view(horizon + 1, nz, particles, batch).permute(2, 3, 0, 1)
    if check:
        check_finite(path, dt=dt, t0=t0)
    return path


def _needs_gradient(sde: SDE, *tensors: object) -> bool:
    # An equation that is no module may hold parameters out of sight: it is taken to need gradients.
    if not isinstance(sde, torch.nn.Module) or any(p.requires_grad for p in sde.parameters()):
        return True
    return any(isinstance(x, Tensor) and x.requires_grad for x in tensors)
