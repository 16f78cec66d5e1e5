"""Stochastic Heun: y = z + f dt + g dW;  z' = z + (f + f(y)) dt / 2 + (g + g(y)) dW / 2.

Averaging g over both ends of the step makes the limit that of Stratonovich (Ruemelin, SIAM J. Numer. Anal.
19, 1982).
"""

from typing import final

from torch import Tensor

from nsde_torch.sde.protocol import SDE, Time, within
from nsde_torch.sde.step import Step


@final
class Heun(Step):
    """Stratonovich predictor-corrector: two drifts and two diffusions; second order in dt where g = 0.

    Strong order 1 needs g_i to depend on z_i alone. Where the channels share their diffusion (a
    distance-aware model) the limit stays right and the order falls to 0.5, because no increment dW holds the
    Levy areas.
    """

    name = "heun"
    calculus = "stratonovich"
    strong_order = 1.0
    condition = "diagonal noise with g_i a function of t, u and z_i only; 0.5 on coupled diagonal noise"
    summary = "Stratonovich, strong order 1 on uncoupled noise, two drifts and two diffusions a step"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        """See `Step.advance`."""
        assert dw is not None
        f, g = sde.drift(t, z, u), sde.diffusion(t, z, u)
        y = z + f * dt + g * dw
        after = sde.drift(t + dt, within(sde, z, y), u)
        return z + 0.5 * ((f + after) * dt + (g + sde.diffusion(t + dt, y, u)) * dw)
