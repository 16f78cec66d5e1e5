"""A solver: Ralston's method, for equations without noise.

    z' = z + dt (f(z) + 3 f(y)) / 4,        y = z + 2/3 dt f(z)

It is of order 2, like the midpoint rule, and has the least bound on the error of a step (Ralston,
Math. Comp. 16, 1962).
"""

from typing import final

from torch import Tensor

from nsde_torch.sde import SDE, Step, Time, within


@final
class Ralston(Step):
    """Ralston's second-order method; two drifts a step. f smooth in z within a step."""

    name = "ralston"
    calculus = "none"
    strong_order = 2.0
    deterministic = True

    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        """One step of the rows z (N, nz); see `Step.advance`."""
        f = sde.drift(t, z, u)
        y = within(sde, z, z + (2.0 / 3.0) * dt * f)  # memory of the effects stays where a stage needs it
        return z + 0.25 * dt * (f + 3.0 * sde.drift(t + (2.0 / 3.0) * dt, y, u))
