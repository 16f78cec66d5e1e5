"""One-step methods without a library: Euler and Maruyama, Runge and Kutta, Heun, Milstein.

midpoint  z' = z + dt f(t + dt/2, z + dt/2 f)
rk4       z' = z + dt (k1 + 2 k2 + 2 k3 + k4) / 6

(Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.1)

Milstein's steps are Euler-Maruyama plus the first iterated integral (Kloeden and Platen 1992, 10.3 and 11.1).

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

Strong order 1 needs diagonal noise whose g_i depend on t, u and z_i alone. With a distance-aware diffusion every g_i
depends on all of z, the mixed iterated integrals are missing (no increment dW holds the Levy areas), and the measured
order is 0.5, with errors slightly above those of Euler-Maruyama.
"""

from typing import final

from torch import Tensor

from nsde_torch.sde.derivative import diffusion_and_slope
from nsde_torch.sde.step import SDE, Step, Time, within


@final
class EulerMaruyama(Step):
    """The simplest Ito method, of f and g Lipschitz with linear growth; order 1 if g does not depend on z."""

    name = "euler_maruyama"
    calculus = "ito"
    strong_order = 0.5

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        return z + sde.drift(t, z, u) * dt + sde.diffusion(t, z, u) * dw


@final
class Midpoint(Step):
    """Explicit midpoint rule, two drifts; the diffusion is never evaluated. f smooth in z within a step."""

    name = "midpoint"
    calculus = "none"
    strong_order = 2.0
    deterministic = True

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        half = 0.5 * dt
        middle = z + sde.drift(t, z, u) * half
        return z + sde.drift(t + half, within(sde, z, middle), u) * dt


@final
class RungeKutta4(Step):
    """Classical Runge-Kutta, four drifts; the diffusion is never evaluated. f smooth in z within a step."""

    name = "rk4"
    calculus = "none"
    strong_order = 4.0
    deterministic = True

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        half = 0.5 * dt
        k1 = sde.drift(t, z, u)
        k2 = sde.drift(t + half, within(sde, z, z + k1 * half), u)
        k3 = sde.drift(t + half, within(sde, z, z + k2 * half), u)
        k4 = sde.drift(t + dt, within(sde, z, z + k3 * dt), u)
        return z + (k1 + 2.0 * (k2 + k3) + k4) * (dt / 6.0)


@final
class Heun(Step):
    """Stratonovich predictor-corrector, two drifts and two diffusions; second order in dt where g = 0.

    Averaging g over both ends of the step makes the limit that of Stratonovich, on coupled noise too (Ruemelin, SIAM
    J. Numer. Anal. 19, 1982).
    """

    name = "heun"
    calculus = "stratonovich"
    strong_order = 1.0

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        f, g = sde.drift(t, z, u), sde.diffusion(t, z, u)
        y = z + f * dt + g * dw
        after = sde.drift(t + dt, within(sde, z, y), u)
        return z + 0.5 * ((f + after) * dt + (g + sde.diffusion(t + dt, y, u)) * dw)


@final
class MilsteinItoFree(Step):
    """Derivative-free Ito Milstein, the paper's solver: one drift and two diffusions."""

    name = "milstein"
    calculus = "ito"
    strong_order = 1.0

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        root = dt**0.5
        g = sde.diffusion(t, z, u)
        predicted = z + sde.drift(t, z, u) * dt
        support = sde.diffusion(t, predicted + g * root, u)
        return predicted + g * dw + (support - g) * (dw * dw - dt) * (0.5 / root)


@final
class MilsteinStratonovichFree(Step):
    """Derivative-free Stratonovich Milstein: one drift and two diffusions; on coupled noise the limit stays."""

    name = "milstein_stratonovich_free"
    calculus = "stratonovich"
    strong_order = 1.0

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        g = sde.diffusion(t, z, u)
        predicted = z + sde.drift(t, z, u) * dt
        return predicted + 0.5 * (g + sde.diffusion(t, predicted + g * dw, u)) * dw


@final
class MilsteinIto(Step):
    """Ito Milstein with the exact slopes d g_i / d z_i (see `diffusion_and_slope` for their cost)."""

    name = "milstein_ito"
    calculus = "ito"
    strong_order = 1.0

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        g, slope = diffusion_and_slope(sde, t, z, u)
        return z + sde.drift(t, z, u) * dt + g * (dw + 0.5 * slope * (dw * dw - dt))


@final
class MilsteinStratonovich(Step):
    """Stratonovich Milstein with the exact slopes d g_i / d z_i (see `diffusion_and_slope` for their cost)."""

    name = "milstein_stratonovich"
    calculus = "stratonovich"
    strong_order = 1.0

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        g, slope = diffusion_and_slope(sde, t, z, u)
        return z + sde.drift(t, z, u) * dt + g * (dw + 0.5 * slope * (dw * dw))


@final
class MilsteinHeun(Step):
    """Derivative-free Ito Milstein for the noise, Heun for the drift: accurate where noise is small and steps are not.

        y  = z + f(z) dt + g(z) dW
        z' = z + (f(z) + f(y)) dt / 2 + g dW + (g(s) - g) (dW^2 - dt) / (2 sqrt(dt)),    s = z + f dt + g sqrt(dt)

    Two drifts and two diffusions; second order in dt where g = 0. With noise of size eps the error on one Brownian path
    is O(dt^2 + eps dt) where g_i depends on z_i alone, and that of Milstein's step O(dt) however small the noise
    (Milstein and Tretyakov, Stochastic Numerics for Mathematical Physics, 2004, chapter 3).

    The limit is that of Ito, also with multiplicative noise: (f(y) - f(z)) dt / 2 is f' f dt^2 / 2 + f' g dW dt / 2 +
    f'' g^2 dW^2 dt / 4 up to higher orders. The first is Heun's, the second the mean of f' g times the integral of W
    over the step, given dW, with mean zero and of order dt^(3/2); the third has the mean f'' g^2 dt^2 / 4 of Ito's
    formula.
    """

    name = "milstein_heun"
    calculus = "ito"
    strong_order = 1.0

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        assert dw is not None
        root = dt**0.5
        f, g = sde.drift(t, z, u), sde.diffusion(t, z, u)
        predicted, moved = z + f * dt, g * dw
        support = sde.diffusion(t, predicted + g * root, u)
        after = sde.drift(t + dt, within(sde, z, predicted + moved), u)
        return z + 0.5 * (f + after) * dt + moved + (support - g) * (dw * dw - dt) * (0.5 / root)
