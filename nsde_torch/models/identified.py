"""System identification's model: the declared physics with fitted parameters, and nothing else.

    dx/dt = f_declared(x, u; theta) c

c is the clock scale (physical seconds per logged second). There is no diffusion and no learned part: what the physics
lacks, this model lacks, and it has no interval.
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, final

import torch
from torch import Tensor

from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.models.model import Capabilities, Model, ModelSpec
from nsde_torch.models.networks import InputFilter
from nsde_torch.models.options import SysidOptions
from nsde_torch.sde import Calculus, make_step, rollout
from nsde_torch.systems.values import Values

METHODS = ("weak", "differences")


@dataclass(frozen=True)
class SysidSpec(ModelSpec):
    """Declared physics fitted by least squares."""

    kinds = ("sysid",)
    options = SysidOptions

    _: KW_ONLY
    step: str = "rk4"  # name of the integrator, one for equations without noise
    solver: Mapping[str, Any] = field(default_factory=dict)  # further arguments of the integrator
    method: str = "weak"  # integral form, whitened; or "differences", finite ones of smoothed states
    max_iterations: int = 20  # largest number of least-squares steps
    filter_reach: int = 0  # type: ignore[misc]


@final
class IdentifiedModel(Model):
    """Declared physics of a system, with initial `values` of its parameters; `generator` plays no part.

    Example:
        >>> spec = SysidSpec("cartpole", dt=0.02, horizon=30)
        >>> model = IdentifiedModel(spec, generator=torch.Generator())
    """

    calculus: Calculus = "either"  # without a diffusion there is no product to be read

    def __init__(self, spec: SysidSpec, *, generator: torch.Generator, values: Values | None = None) -> None:
        super().__init__()
        self.spec: SysidSpec = spec
        self.step = make_step(spec.step, **spec.solver)
        if not self.step.deterministic:
            raise ConfigError(
                f"`model=sysid` has no diffusion, and solver={spec.step} is for equations with noise. "
                "Take solver=rk4, midpoint or torchdiffeq, or leave it out."
            )
        self.system = spec.make_system(values)
        self.system.set_step(spec.dt)
        self.filter = InputFilter(spec.filter_reach, spec.dt) if spec.filter_reach else None

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(has_physics=True)

    @property
    def nz(self) -> int:
        """Number of states with the memory of the effects."""
        return self.system.nz

    def remembered(self, x: Tensor, u: Tensor, u_before: Tensor | None, *, dt: float) -> Tensor:
        """State (N, nx) with the memory that inputs before it left, (N, nz); see `System.remembered`.

        `dt` [s] is on the logged clock.
        """
        return self.system.remembered(x, u, u_before, dt=dt * float(self.clock_scale))

    def set_step(self, dt: float) -> None:
        """Tell the effects the step of the integrator on the logged clock [s]; see `System.set_step`."""
        self.system.set_step(dt * float(self.clock_scale))

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        return self.system.inner(z, y)

    def drift(self, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
        """Rate of the state (N, nz) per logged second, at a time [s] under applied inputs (N, nu).

        Of state and memory of the effects (N, nz); or of the state alone (N, nx), with the memory that is stationary
        under `u`, and then the rate is that of the state.
        """
        nx = self.system.nx
        if z.shape[1] == self.nz:
            return self.clock_scale * self.system.drift(t, z, u)
        self.system.check_rows("z", z, nx)
        return self.clock_scale * self.system.drift(t, self.system.augment(z, u), u)[:, :nx]

    def diffusion(self, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
        """None: zeros (N, nz)."""
        return torch.zeros_like(z)

    def sample(
        self,
        x0: Tensor,
        u: Tensor,
        *,
        dt: float,
        particles: int,
        generator: torch.Generator,
        measurement: bool = True,
        measurement_std: Tensor | None = None,
        applied: bool = False,
        compile: bool = False,
        t0: float | Tensor = 0.0,
        u_before: Tensor | None = None,
    ) -> Tensor:
        """See `Model.sample`; all particles are one path, and a measurement is predicted as the state itself."""
        x0, u = self.checked(x0, u, particles, generator)
        u_before = self.checked_before(u_before, x0)
        if measurement_std is not None:
            if measurement_std.shape != (self.system.nx,):
                raise ShapeError(f"`measurement_std` must be ({self.system.nx},).")
            raise ConfigError(
                "`measurement_std` was given, but a model by system identification has no noise. Leave it out."
            )
        if not applied:
            u, u_before = self.applied_pair(u, dt, u_before)
        z0 = self.remembered(x0, u[:, 0], u_before, dt=dt)
        path = rollout(self, z0, u, dt=dt, step=self.step, noise=None, t0=t0, compile=compile)
        return path[..., : self.system.nx].expand(particles, -1, -1, -1)
