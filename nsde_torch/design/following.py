"""Inputs that keep a simulated machine near a recorded path: feedback about the record, optimal for small deviations.

    u_k = u_k(log) + K_k (x_k(log) - x_k(measured)),      K by Riccati's recursion backwards along the path

with deviations of states and of inputs weighed by how much they vary in the log (linear quadratic regulation: Anderson
and Moore, Optimal Control, 1990, chapter 2). A machine that does not stay by itself is simulated this way; so it is in
a loop, as the measured one was, if not in the same one.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.design.drives import OpenLoop
from nsde_torch.design.rollout import Drive
from nsde_torch.systems import System

Array = NDArray[np.float64]

_LEAST = 1e-6  # spread of a column that does not vary


def replayed(inputs: Sequence[Array], copies: int) -> Drive:
    """Inputs as they were logged, whatever the machine does.

    Args:
        inputs: Of each stretch (n, nu).
        copies: Machines of each stretch, one after another.
    """
    return OpenLoop()(_stacked(inputs, copies))


def following(
    system: System, states: Sequence[Array], inputs: Sequence[Array], *, dt: float, copies: int
) -> Drive:
    """Inputs that follow recorded stretches, between the smallest and largest that were logged.

    Args:
        system: The machine.
        states, inputs: Of each stretch (n, nx), (n, nu and what is logged beside).
        dt: Step [s].
        copies: Machines of each stretch, one after another.
    """
    system, every, nu = copy.deepcopy(system).double(), np.concatenate(inputs), system.nu
    x_scale = np.concatenate(states).std(0).clip(_LEAST)
    u_scale = every[:, :nu].std(0).clip(_LEAST)
    gains = [
        _gains(system, x, u, np.diag(x_scale**-2), np.diag(u_scale**-2), dt)
        for x, u in zip(states, inputs, strict=True)
    ]
    low, high = (torch.from_numpy(end) for end in (every.min(0), every.max(0)))
    x, u = (torch.from_numpy(_stacked(parts, copies)) for parts in (states, inputs))
    gain = torch.from_numpy(_stacked([k.reshape(len(k), -1) for k in gains], copies))

    def drive(k: int, measured: Tensor) -> Tensor:
        away = (x[:, k] - measured)[:, :, None]
        change = (gain[:, k].view(-1, nu, x.shape[2]) @ away)[:, :, 0]
        whole = torch.cat((u[:, k, :nu] + change, u[:, k, nu:]), 1)
        return torch.minimum(torch.maximum(whole, low), high)

    return drive


def _gains(system: System, x: Array, u: Array, q: Array, r: Array, dt: float) -> Array:
    """Gains of each row (n, nu, nx)."""
    nx, nu = system.nx, system.nu

    def step(now: Tensor, push: Tensor) -> Tensor:
        z = system.augment(now[None], push[None])
        middle = z + 0.5 * dt * system.drift(0.0, z, push[None])
        return now + dt * system.drift(0.0, middle, push[None])[0, :nx]

    slopes = torch.func.vmap(torch.func.jacfwd(step, (0, 1)))
    a, b = (part.detach().numpy() for part in slopes(torch.tensor(x), torch.tensor(u)))
    b, out, p = b[:, :, :nu], np.zeros((len(x), nu, nx)), q
    for k in range(len(x) - 1, -1, -1):
        pb = p @ b[k]
        out[k] = np.linalg.solve(r + b[k].T @ pb, pb.T @ a[k])
        p = q + a[k].T @ p @ (a[k] - b[k] @ out[k])
        p = 0.5 * (p + p.T)
    return out


def _stacked(parts: Sequence[Array], copies: int) -> Array:
    """Stretches side by side, the last row of shorter ones again, each so many times (B, N, columns)."""
    rows = max(len(p) for p in parts)
    whole = [np.concatenate((p, np.repeat(p[-1:], rows - len(p), 0))) for p in parts]
    return np.repeat(np.stack(whole), copies, 0)
