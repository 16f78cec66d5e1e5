"""Steps of ordinary equations by torchdiffeq: fixed and adaptive methods, and gradients by the adjoint equation.

The input is held over a step, so each step is a problem of its own: z' = solve dz/ds = f(t + s, z, u), s in [0, dt].
The adjoint (Chen et al., Neural Ordinary Differential Equations, 2018) needs memory for the ends of the steps alone.
"""

import inspect
from typing import Any, final

import torch
from torch import Tensor, nn

from nsde_torch.errors import ConfigError
from nsde_torch.sde.protocol import SDE, Time, within
from nsde_torch.sde.step import Step

FIXED = {"euler": 1, "midpoint": 2, "rk4": 4, "heun3": 3}
ADAPTIVE = {"dopri5": 5, "dopri8": 8, "bosh3": 3, "adaptive_heun": 2, "fehlberg2": 2}


@final
class TorchDiffEq(Step):
    """A method of torchdiffeq.

    Args:
        method: One of `FIXED` (one step of the method a step of the model) or `ADAPTIVE`.
        rtol, atol: Tolerances of adaptive methods.
        adjoint: Whether gradients come from the adjoint equation instead of the stored operations.

    Raises:
        ConfigError: There is no such method, or a tolerance is not positive.
    """

    name = "torchdiffeq"
    calculus = "none"
    strong_order = 5.0
    condition = "sigma = 0; the order is that of the method (5 is that of dopri5)"
    summary = "no noise; fixed and adaptive methods of torchdiffeq, with the adjoint on request"
    deterministic = True
    compilable = False

    def __init__(
        self, method: str = "dopri5", rtol: float = 1e-5, atol: float = 1e-6, adjoint: bool = False
    ) -> None:
        if method not in FIXED | ADAPTIVE:
            raise ConfigError(
                f"`solver.method` must be one of {', '.join(FIXED | ADAPTIVE)}; got {method!r}."
            )
        if not (rtol > 0 and atol > 0):
            raise ConfigError(f"`solver.rtol` and `solver.atol` must be above 0; got {rtol!r} and {atol!r}.")
        self.method, self.rtol, self.atol, self.adjoint = method, rtol, atol, adjoint

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        import torchdiffeq  # half a second, which those who integrate otherwise do not pay

        ends = torch.stack((torch.zeros_like(z[0, 0]), torch.ones_like(z[0, 0]) * dt)).detach()
        options: dict[str, Any] = {"method": self.method, "rtol": self.rtol, "atol": self.atol}
        if not self.adjoint:
            path = torchdiffeq.odeint(lambda s, y: sde.drift(t + s, within(sde, z, y), u), z, ends, **options)
            return path[-1]
        parameters = tuple(sde.parameters()) if isinstance(sde, nn.Module) else ()
        wanted = tuple(p for p in (*parameters, u) if p.requires_grad)
        return torchdiffeq.odeint_adjoint(
            lambda s, y: sde.drift(t + s, within(sde, z, y), u), z, ends, adjoint_params=wanted, **options
        )[-1]

    def __repr__(self) -> str:
        given = ", ".join(f"{k}={getattr(self, k)!r}" for k in inspect.signature(type(self)).parameters)
        return f"TorchDiffEq({given})"
