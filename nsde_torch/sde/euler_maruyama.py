"""Euler-Maruyama: z' = z + f dt + g dW (Kloeden and Platen 1992, section 10.2)."""

from typing import final

from torch import Tensor

from nsde_torch.sde.protocol import SDE, Time
from nsde_torch.sde.step import Step


@final
class EulerMaruyama(Step):
    """The simplest Ito method; strong order 0.5 on any noise, 1 if g does not depend on z."""

    name = "euler_maruyama"
    calculus = "ito"
    strong_order = 0.5
    condition = "f and g Lipschitz with linear growth; order 1 if g does not depend on z"
    summary = "Ito, strong order 0.5, one drift and one diffusion a step"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        """See `Step.advance`."""
        assert dw is not None
        return z + sde.drift(t, z, u) * dt + sde.diffusion(t, z, u) * dw
