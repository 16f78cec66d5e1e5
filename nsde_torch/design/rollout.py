"""Experiments of a member, many at once, each with parameters of its own.

    dx = (f(x, u; theta) + B d) dt,  Runge and Kutta's fourth order;     measured_k = x_k + s_k

with d and s drawn from the noise levels of the likelihood (`ModelNoise`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.effects import Port
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.state_space import StateSpace, forces_on, moved
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

Drive = Callable[[int, Tensor], Tensor]
"""Inputs (B, nu) from the number of the step and the measured states (B, nx)."""
_SUBSTEPS = 8


@dataclass(frozen=True)
class Disturbances:
    """What acts on experiments beside the inputs."""

    forces: Array  # disturbances held over each step (B, N, nd)
    ports: tuple[tuple[Port, int], ...]  # columns of the ports that these act on
    errors: Array  # errors of the sensors (B, N + 1, ne)


@dataclass(frozen=True)
class ModelNoise:
    """Noise of largest likelihood."""

    space: StateSpace  # of the machine as the filter sees it
    levels: Levels

    def drawn(self, count: int, steps: int, rng: np.random.Generator) -> Disturbances:
        """What acts on `count` experiments."""
        space, levels, nd = self.space, self.levels, len(self.space.disturbances)
        white, gust, keep = (v.numpy() for v in (levels.white.exp(), levels.gust.exp(), levels.keep(space.h)))
        gusts = gust * rng.standard_normal((count, steps, nd))
        for k in range(1, steps):
            gusts[:, k] = keep * gusts[:, k - 1] + np.sqrt(1.0 - keep**2) * gusts[:, k]
        forces = gusts + white / space.h**0.5 * rng.standard_normal(gusts.shape)
        errors = np.zeros((count, steps + 1, space.ne))
        noise = rng.standard_normal((count, steps + 1, len(space.observed)))
        errors[..., tuple(space.observed)] = levels.sensor.exp().numpy() * noise
        return Disturbances(forces, space.disturbances, errors)


@final
class Rollouts:
    """Experiments of one system.

    Args:
        system: Physics.
        dt: Step [s].
    """

    def __init__(self, system: System, *, dt: float) -> None:
        self.vector, self.dt = ParameterVector(system), dt
        self.system = self.vector.system
        self._fine = self._substeps()
        self.fine_dt = dt / self._fine
        """Step of the integration [s]."""
        self._ports: tuple[tuple[Port, int], ...] = ()
        self._rk4 = torch.func.vmap(self._one)
        self._augmented = torch.func.vmap(self._first)

    @torch.no_grad()
    def run(
        self,
        thetas: Array,
        start: Array,
        drive: Drive,
        steps: int,
        noise: Disturbances | None = None,
        times: Array | None = None,
    ) -> tuple[Array, Array, Array]:
        """Fly experiments from states (B, nx) with parameters (B, k), beginning at `times` (B,) [s] or 0.

        Returns:
            True states (B, N + 1, nx), measured states (B, N + 1, nx) and inputs (B, N, nu).
        """
        theta, x, system = torch.as_tensor(thetas), torch.as_tensor(start), self.system
        nx, nothing = system.nx, torch.zeros(len(x), steps, 0, dtype=torch.float64)
        errors = None if noise is None else torch.as_tensor(noise.errors)
        forces = nothing if noise is None else torch.as_tensor(noise.forces)
        self._ports = () if noise is None else noise.ports
        begun = torch.zeros(len(x), dtype=torch.float64) if times is None else torch.as_tensor(times)

        def measured_at(k: int, x: Tensor) -> Tensor:
            return x if errors is None else system.project(moved(system, x, errors[:, k]))

        true, measured = [x], [measured_at(0, x)]
        inputs = [drive(0, measured[0])]
        z = self._augmented(theta, x, inputs[0])
        for k in range(steps):
            if k:
                inputs.append(drive(k, measured[k]))
            for i in range(self._fine):
                t = begun + (k * self.dt + i * self.fine_dt)
                z = system.project(z + self._rk4(theta, t, z, inputs[k], forces[:, k]))
            true.append(z[:, :nx])
            measured.append(measured_at(k + 1, true[-1]))
        return torch.stack(true, 1).numpy(), torch.stack(measured, 1).numpy(), torch.stack(inputs, 1).numpy()

    def _first(self, theta: Tensor, x: Tensor, u: Tensor) -> Tensor:
        """One state of them; what lags behind another effect of the inputs begins where its parameters say."""
        self.vector.use(theta)
        return self.system.augment(x[None], u[None])[0]

    def _one(self, theta: Tensor, t: Tensor, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """Change of one state over a fine step."""
        self.vector.use(theta)
        h, forces = self.fine_dt, forces_on(self.system, self._ports[: len(d)], d[None])

        def f(share: float, at: Tensor) -> Tensor:
            return self.system.drift((t + share * h)[None], at[None], u[None], forces)[0]

        k1 = f(0.0, z)
        k2 = f(0.5, z + 0.5 * h * k1)
        k3 = f(0.5, z + 0.5 * h * k2)
        k4 = f(1.0, z + h * k3)
        return (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)

    @torch.no_grad()
    def _substeps(self) -> int:
        """Fine steps in a step: as many as follow the fastest mode at rest."""
        x = torch.zeros(1, self.system.nx, dtype=torch.float64)
        if self.system.quaternion is not None:
            x[:, self.system.quaternion.start] = 1.0
        u = torch.zeros(1, self.system.nu + len(self.system.exogenous), dtype=torch.float64)
        slopes = torch.func.jacfwd(lambda z: self.system.drift(0.0, z, u)[0])(self.system.augment(x, u))[:, 0]
        if not bool(torch.isfinite(slopes).all()):
            return _SUBSTEPS
        fastest = float(torch.linalg.eigvals(slopes).abs().max())
        return min(max(1, ceil(0.7 * fastest * self.dt)), _SUBSTEPS)


def open_loop(tables: Array) -> Drive:
    """Inputs of plans (B, N, nu), whatever the machine does."""
    u = torch.as_tensor(tables)
    return lambda k, measured: u[:, k]


def as_run(states: Array, inputs: Array, dt: float) -> Run:
    """An experiment as a run: the last input is held."""
    u = np.concatenate((inputs, inputs[-1:]))
    return Run("experiment", dt * np.arange(len(u), dtype=np.float64), states, u)
