"""A pure delay of the inputs, as a rational approximation with two states a, b per input.

    exp(-s T)  ~  (1 - s T / 3) / (1 + 2 s T / 3 + (s T)^2 / 6)                          (Pade, order [1/2])

    da/dt = b / T,   db/dt = (6 u - 6 a - 4 b) / T,   u_eff = a - b / 3

It is strictly proper, so that a step of the input does not jump through, and right to the third order in s T: the
phase is within 0.01 rad up to s T = 1. Where inputs are held over steps, as a log has them, the mean of what arrives
over step k is exact: T = (n + r) h gives (1 - r) u_{k-n} + r u_{k-n-1}. An integrator whose steps are longer than T / 2
gets a first-order lag of the same mean delay (see `lag`), with a alone.
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
        n, delay = self.n_inputs, self.value("delay")
        a, b = memory[:, :n], memory[:, n:]
        fine = a - b / 3.0 - u[:, :n]
        if not self.step:
            return fine
        return torch.where(self._coarse(delay), (a - u[:, :n]) * (delay / self.step).clamp_max(1.0), fine)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.memory_rate`."""
        n, delay = self.n_inputs, self.value("delay")
        a, b = memory[:, :n], memory[:, n:]
        fine = torch.cat((b, 6.0 * (u[:, :n] - a) - 4.0 * b), 1) / delay
        if not self.step:
            return fine
        return torch.where(
            self._coarse(delay), torch.cat((u[:, :n] - a, -b), 1) / delay.clamp_min(self.step), fine
        )

    def _coarse(self, delay: Tensor) -> Tensor:
        return delay < 2.0 * self.step

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
