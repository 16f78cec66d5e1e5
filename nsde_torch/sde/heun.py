"""Heun's predictor and corrector, with and without the terms of Milstein.

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
        assert dw is not None
        f, g = sde.drift(t, z, u), sde.diffusion(t, z, u)
        y = z + f * dt + g * dw
        after = sde.drift(t + dt, within(sde, z, y), u)
        return z + 0.5 * ((f + after) * dt + (g + sde.diffusion(t + dt, y, u)) * dw)


# Milstein's step for the noise with Heun's for the drift: accurate where the noise is small and the step is
# not.
#
#     y  = z + f(z) dt + g(z) dW
#     z' = z + (f(z) + f(y)) dt / 2 + g dW + (g(s) - g) (dW^2 - dt) / (2 sqrt(dt)),    s = z + f dt + g sqrt(dt)
#
# With noise of size eps the error on one Brownian path is O(dt^2 + eps dt) where g_i depends on z_i alone,
# and that of Milstein's step O(dt) however small the noise (Milstein and Tretyakov, Stochastic Numerics for
# Mathematical Physics, 2004, chapter 3, numerical methods for equations with small noise).
#
# The limit is that of Ito, also with multiplicative noise: (f(y) - f(z)) dt / 2 is f' f dt^2 / 2 + f' g dW dt
# / 2 + f'' g^2 dW^2 dt / 4 up to higher orders. The first is Heun's, the second the mean of f' g times the
# integral of W over the step, given dW, with mean zero and of order dt^(3/2); the third has the mean f'' g^2
# dt^2 / 4 of Ito's formula.


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
        assert dw is not None
        root = dt**0.5
        f, g = sde.drift(t, z, u), sde.diffusion(t, z, u)
        predicted, moved = z + f * dt, g * dw
        support = sde.diffusion(t, predicted + g * root, u)
        after = sde.drift(t + dt, within(sde, z, predicted + moved), u)
        return z + 0.5 * (f + after) * dt + moved + (support - g) * (dw * dw - dt) * (0.5 / root)
