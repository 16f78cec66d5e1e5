"""Steps of order one and more without derivatives of the diffusion: Euler-Maruyama, midpoint, Runge-Kutta.

midpoint  z' = z + dt f(t + dt/2, z + dt/2 f)
rk4       z' = z + dt (k1 + 2 k2 + 2 k3 + k4) / 6

(Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.1)
"""

from typing import final

from torch import Tensor

from nsde_torch.sde.protocol import SDE, Time, within
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
        assert dw is not None
        return z + sde.drift(t, z, u) * dt + sde.diffusion(t, z, u) * dw


_CONDITION = "sigma = 0; f smooth in z within a step (u is held, so its jumps lie between steps)"


@final
class Midpoint(Step):
    """Explicit midpoint rule, order 2, two drifts; the diffusion is never evaluated."""

    name = "midpoint"
    calculus = "none"
    strong_order = 2.0
    condition = _CONDITION
    summary = "no noise, order 2, two drifts a step"
    deterministic = True

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        half = 0.5 * dt
        middle = z + sde.drift(t, z, u) * half
        return z + sde.drift(t + half, within(sde, z, middle), u) * dt


@final
class RungeKutta4(Step):
    """Classical Runge-Kutta, order 4, four drifts; the diffusion is never evaluated."""

    name = "rk4"
    calculus = "none"
    strong_order = 4.0
    condition = _CONDITION
    summary = "no noise, order 4, four drifts a step"
    deterministic = True

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        half = 0.5 * dt
        k1 = sde.drift(t, z, u)
        k2 = sde.drift(t + half, within(sde, z, z + k1 * half), u)
        k3 = sde.drift(t + half, within(sde, z, z + k2 * half), u)
        k4 = sde.drift(t + dt, within(sde, z, z + k3 * dt), u)
        return z + (k1 + 2.0 * (k2 + k3) + k4) * (dt / 6.0)
