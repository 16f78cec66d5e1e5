"""Milstein steps: Euler-Maruyama plus the first iterated integral (Kloeden and Platen 1992, 10.3 and 11.1).

Ito            z' = z + f dt + g dW + g g' (dW^2 - dt) / 2
Stratonovich   z' = z + f dt + g dW + g g' dW^2 / 2

with g' the slope d g_i / d z_i of each channel in its own state. The derivative-free forms replace g g' by a
difference of two values of g:

Ito            y = z + f dt + g sqrt(dt);   g g' ~ (g(y) - g) / sqrt(dt)
Stratonovich   y = z + f dt + g dW;         g g' ~ (g(y) - g) / dW,   so   z' = z + f dt + (g + g(y)) dW / 2

For Stratonovich the textbook's support value takes sqrt(dt) too. Where the noise is coupled (g_i depends on
z_j) that form adds sum_j g_j dg_i/dz_j dt / 2 to the mean instead of g_i dg_i/dz_i dt / 2 and so converges to
the wrong equation; the support value with dW has the same order on uncoupled noise and the right limit on
both. The Ito form needs no such care: its difference is multiplied by dW^2 - dt, which has mean zero.

Order. Strong order 1 needs g_i to depend on t, u and z_i alone. With a distance-aware diffusion every g_i
depends on all of z, the mixed iterated integrals are missing, and the measured order is 0.5, with errors
slightly above those of Euler-Maruyama.
"""

from typing import final

from torch import Tensor

from nsde_torch.sde.derivative import diffusion_and_slope
from nsde_torch.sde.protocol import SDE, Time
from nsde_torch.sde.step import Step


class _Milstein(Step):
    strong_order = 1.0
    condition = "diagonal noise with g_i a function of t, u and z_i only; 0.5 on coupled diagonal noise"


@final
class MilsteinItoFree(_Milstein):
    """Derivative-free Ito Milstein, the paper's solver: one drift and two diffusions."""

    name = "milstein"
    calculus = "ito"
    summary = "Ito, derivative-free, strong order 1 on uncoupled noise, one drift and two diffusions"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        root = dt**0.5
        g = sde.diffusion(t, z, u)
        predicted = z + sde.drift(t, z, u) * dt
        support = sde.diffusion(t, predicted + g * root, u)
        return predicted + g * dw + (support - g) * (dw * dw - dt) * (0.5 / root)


@final
class MilsteinStratonovichFree(_Milstein):
    """Derivative-free Stratonovich Milstein: one drift and two diffusions; on coupled noise the limit stays."""

    name = "milstein_stratonovich_free"
    calculus = "stratonovich"
    summary = "Stratonovich, derivative-free, strong order 1 on uncoupled noise, one drift and two diffusions"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        g = sde.diffusion(t, z, u)
        predicted = z + sde.drift(t, z, u) * dt
        return predicted + 0.5 * (g + sde.diffusion(t, predicted + g * dw, u)) * dw


@final
class MilsteinIto(_Milstein):
    """Ito Milstein with the exact slopes d g_i / d z_i (see `diffusion_and_slope` for their cost)."""

    name = "milstein_ito"
    calculus = "ito"
    summary = "Ito, exact slopes of g, strong order 1 on uncoupled noise"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        g, slope = diffusion_and_slope(sde, t, z, u)
        return z + sde.drift(t, z, u) * dt + g * (dw + 0.5 * slope * (dw * dw - dt))


@final
class MilsteinStratonovich(_Milstein):
    """Stratonovich Milstein with the exact slopes d g_i / d z_i (see `diffusion_and_slope` for their cost)."""

    name = "milstein_stratonovich"
    calculus = "stratonovich"
    summary = "Stratonovich, exact slopes of g, strong order 1 on uncoupled noise"

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        g, slope = diffusion_and_slope(sde, t, z, u)
        return z + sde.drift(t, z, u) * dt + g * (dw + 0.5 * slope * (dw * dw))
