"""A pure delay of the inputs, as a rational approximation with two states a, b per input.

    exp(-s T)  ~  (1 - s T / 3) / (1 + 2 s T / 3 + (s T)^2 / 6)                          (Pade, order [1/2])

    da/dt = b / T,   db/dt = (6 u - 6 a - 4 b) / T,   u_eff = a - b / 3

It is strictly proper, so that a step of the input does not jump through, and right to the third order in s T: the
phase is within 0.01 rad up to s T = 1. Where inputs are held over steps, as a log has them, the mean of what arrives
over step k is exact: T = (n + r) h gives (1 - r) u_{k-n} + r u_{k-n-1}.

An integrator whose steps of h are longer than T / 2 gets just that. With q = h / T and r = T / h - 1 (not below 0), v1
and v2 are the inputs of the two steps before, less u. Memory holds them so that what is still to arrive and the slope
of the input mean the same as in the formula: it may be handed from a fine grid to a coarse one.

    a + b / 6 - u = (v1 + r v2) / (1 + r),   b = (v1 - v2) / q

With shorter steps it gets the exact solution for held inputs, c = exp(-2 q) cos(w q), s = exp(-2 q) sin(w q) / w and
w^2 = 2, and the mean of u_eff over the step, which follows from u_eff = u - T d(a + b / 6)/dt:

    da = (c - 1 + 2 s) (a - u) + s b,   db = -6 s (a - u) + (c - 1 - 2 s) b,   mean = u - (da + db / 6) / q
"""

from math import floor
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port


@final
class InputDelay(Effect):
    """The inputs act some time after they were logged."""

    name = "input_delay"
    port = Port.INPUT
    stage = 0
    whole_steps = True
    formula = "u_eff(t) = u(t - T), by a rational approximation"
    source = "Pade approximant [1/2] of exp; Golub, Van Loan, Matrix Computations, section 9.3"
    PARAMETERS = {"delay": Parameter(0.02, "s", low=0.001, scale=0.02, help="time from log to effect")}
    null = {"delay": 0.0}
    # a delay by another whole number of steps is another input: what is tried must lie within a step of the truth
    shapes = {"delay": (0.5, 1.5, 2.5, 3.5, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0)}
    relative = {"delay": "step"}
    sentence = "The inputs act {delay} after the log says so."
    separate = "give steps of the input: a lag rounds their corner, a delay moves it"

    @property
    def n_memory(self) -> int:
        """Two states per input."""
        return 2 * self.n_inputs

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        a, b = memory[:, : self.n_inputs] - u[:, : self.n_inputs], memory[:, self.n_inputs :]
        if not self.step:
            return a - b / 3.0
        steps = self.value("delay") / self.step
        da, db = _solved(steps, a, b)
        shifted = steps.clamp_max(1.0) * (a + b / 6.0) - _beyond(steps).square() * b
        return torch.where(steps < 2.0, shifted, -steps * (da + db / 6.0))

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.memory_rate`."""
        a, b = memory[:, : self.n_inputs] - u[:, : self.n_inputs], memory[:, self.n_inputs :]
        delay = self.value("delay")
        if not self.step:
            return torch.cat((b, -6.0 * a - 4.0 * b), 1) / delay
        steps = delay / self.step
        first = a + b / 6.0 + _beyond(steps) / steps * b  # v1, which is v2 a step later
        shifted = torch.cat(((_beyond(steps) + steps / 6.0) * first - a, -steps * first - b), 1)
        return torch.where(steps < 2.0, shifted, torch.cat(_solved(steps, a, b), 1)) / self.step

    def held(self, u: Tensor, dt: float) -> Tensor:
        """See `Effect.held`."""
        steps = float(self.value("delay")) / dt
        whole = floor(steps)
        rows = torch.arange(len(u), device=u.device) - whole
        now, before = u[rows.clamp_min(0), : self.n_inputs], u[(rows - 1).clamp_min(0), : self.n_inputs]
        arriving = now + (steps - whole) * (before - now)
        return torch.cat((arriving, torch.zeros_like(arriving)), 1)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`."""
        own = u[:, : self.n_inputs]
        return torch.cat((own, torch.zeros_like(own)), 1)


def _beyond(steps: Tensor) -> Tensor:
    """Share of a delay that is beyond one step, r / (1 + r)."""
    return (steps - 1.0).clamp_min(0.0) / steps


def _solved(steps: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Changes of both states over a step, from their distances to rest; `steps` is the delay in steps."""
    q, w = 1.0 / steps, 2.0**0.5
    decay = torch.exp(-2.0 * q)
    s = decay * torch.sin(w * q) / w
    c = torch.expm1(-2.0 * q) - 2.0 * decay * torch.sin(0.5 * w * q).square()  # no difference of near numbers
    return (c + 2.0 * s) * a + s * b, (c - 2.0 * s) * b - 6.0 * s * a
