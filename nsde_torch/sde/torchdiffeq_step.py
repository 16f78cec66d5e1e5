"""Steps of ordinary equations by torchdiffeq: fixed and adaptive methods, and gradients by the adjoint equation.

The input is held over a step, so each step is a problem of its own: z' = solve dz/ds = f(t + s, z, u), s in [0, dt].
The adjoint (Chen et al., Neural Ordinary Differential Equations, 2018) needs memory for the ends of the steps alone.
"""

from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor, nn

from nsde_torch.errors import ConfigError
from nsde_torch.sde.options import TORCHDIFFEQ_METHODS
from nsde_torch.sde.step import SDE, Step, Time, within


@final
@dataclass(eq=False)
class TorchDiffEq(Step):
    """A method of torchdiffeq; a ConfigError where there is none of that name, or a tolerance is not positive."""

    method: str = "dopri5"  # one of `TORCHDIFFEQ_METHODS`; the first four take one step a step of the model
    rtol: float = 1e-5  # tolerances of the others
    atol: float = 1e-6
    adjoint: bool = False  # whether gradients come from the adjoint equation instead of the stored operations

    name = "torchdiffeq"
    calculus = "none"
    strong_order = 5.0  # of dopri5
    deterministic = True
    compilable = False

    def __post_init__(self) -> None:
        if self.method not in TORCHDIFFEQ_METHODS:
            known = ", ".join(TORCHDIFFEQ_METHODS)
            raise ConfigError(f"`solver.method` must be one of {known}; got {self.method!r}.")
        if not (self.rtol > 0 and self.atol > 0):
            raise ConfigError(
                f"`solver.rtol` and `solver.atol` must be above 0; got {self.rtol!r} and {self.atol!r}."
            )

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        import torchdiffeq  # half a second, which those who integrate otherwise do not pay

        def rate(s: Tensor, y: Tensor) -> Tensor:
            return sde.drift(t + s, within(sde, z, y), u)

        ends = torch.stack((torch.zeros_like(z[0, 0]), torch.ones_like(z[0, 0]) * dt)).detach()
        options: dict[str, Any] = {"method": self.method, "rtol": self.rtol, "atol": self.atol}
        if not self.adjoint:
            return torchdiffeq.odeint(rate, z, ends, **options)[-1]
        parameters = tuple(sde.parameters()) if isinstance(sde, nn.Module) else ()
        wanted = tuple(p for p in (*parameters, u) if p.requires_grad)
        return torchdiffeq.odeint_adjoint(rate, z, ends, adjoint_params=wanted, **options)[-1]
