"""Milstein's step for the noise with Heun's for the drift: accurate where the noise is small and the step is not.

    y  = z + f(z) dt + g(z) dW
    z' = z + (f(z) + f(y)) dt / 2 + g dW + (g(s) - g) (dW^2 - dt) / (2 sqrt(dt)),    s = z + f dt + g sqrt(dt)

With noise of size eps its mean square error over a fixed time is O(dt^2 + eps^2 dt) where g_i depends on z_i alone:
second order as the noise vanishes, where Milstein's is O(dt) for any noise (Milstein and Tretyakov, Stochastic
Numerics for Mathematical Physics, 2004, chapter 3, small noise). The limit is that of Ito, also with multiplicative
noise: f(y) is f(z) + f'(z) (f dt + g dW) + f''(z) g^2 dW^2 / 2 + ..., and what stands beside the deterministic terms,
f' g dW dt / 2, has mean zero and is of order dt^(3/2); half of it is the mean of the iterated integral of dW ds given
dW, and the mean of the rest is O(dt^2).
"""

from typing import final

from torch import Tensor

from nsde_torch.sde.protocol import SDE, Time, within
from nsde_torch.sde.step import Step


@final
class MilsteinHeun(Step):
    """Derivative-free Ito Milstein with a predictor-corrector for the drift: two drifts and two diffusions.

    Strong order 1 needs g_i to depend on z_i alone; with coupled diagonal noise it falls to 0.5. Second order in dt
    where g = 0.
    """

    name = "milstein_heun"
    calculus = "ito"
    strong_order = 1.0
    condition = "diagonal noise with g_i a function of t, u and z_i only; 0.5 on coupled diagonal noise"
    summary = "Ito, strong order 1 on uncoupled noise, 2 as the noise vanishes, two drifts and two diffusions"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        """See `Step.advance`."""
        assert dw is not None
        root = dt**0.5
        f, g = sde.drift(t, z, u), sde.diffusion(t, z, u)
        predicted, moved = z + f * dt, g * dw
        support = sde.diffusion(t, predicted + g * root, u)
        after = sde.drift(t + dt, within(sde, z, predicted + moved), u)
        return z + 0.5 * (f + after) * dt + moved + (support - g) * (dw * dw - dt) * (0.5 / root)
