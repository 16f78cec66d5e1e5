"""Actuators that follow their command with a first-order lag; each input carries one state m.

u_eff = m,   dm/dt = (u - m) / tau

An integrator whose steps of h hold the input gets the exact memory after each, and the exact mean of m over it:

m' = m + (u - m) (1 - e),   mean = u + (m - u) (1 - e) tau / h,   e = exp(-h / tau)
"""

from math import exp

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port


class _Lag(Effect):
    """A first-order lag on every input."""

    port = Port.INPUT
    stage = 2
    whole_steps = True
    formula = "u_eff = m, dm/dt = (u - m) / tau"
    PARAMETERS = {"time_constant": Parameter(0.05, "s", low=0.002, help="time to reach 63 %")}
    null = {"time_constant": 0.0}
    shapes = {"time_constant": (0.02, 0.06, 0.2)}
    resolved = {"time_constant": 0.5}  # Runge-Kutta 4 is stable up to 2.8 time constants a step
    separate = "give steps of the input: a lag rounds their corner, a delay moves it"

    @property
    def n_memory(self) -> int:
        """One state per input."""
        return self.n_inputs

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        late = memory - u[:, : self.n_inputs]
        return late * self._goes() * (self.value("time_constant") / self.step) if self.step else late

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.memory_rate`."""
        late = u[:, : self.n_inputs] - memory
        return late * (self._goes() / self.step) if self.step else late / self.value("time_constant")

    def _goes(self) -> Tensor:
        """Share of what is left that a step makes good."""
        return -torch.expm1(-self.step / self.value("time_constant"))

    def held(self, u: Tensor, dt: float) -> Tensor:
        """See `Effect.held`."""
        from scipy.signal import lfilter  # half a second to import, and only identification needs it

        own = u[:, : self.n_inputs]
        ratio = float(self.value("time_constant")) / dt
        stays = exp(-1.0 / ratio)
        above = (own - own[:1]).numpy()  # it starts at rest at the first input
        memory = own[:1] + torch.from_numpy(lfilter([0.0, 1.0 - stays], [1.0, -stays], above, axis=0)).to(own)
        return own + (memory - own) * ((1.0 - stays) * ratio)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`."""
        return u[:, : self.n_inputs]


class MotorLag(_Lag):
    """Motors follow their command with a first-order lag; each carries one state."""

    name = "motor_lag"
    source = "first-order motor and ESC dynamics"
    needs = (Port.BODY_MOMENT,)
    sentence = "The motors follow their commands late, with a time constant of {time_constant}."


class ActuatorLag(_Lag):
    """The actuator follows its command with a first-order lag; each input carries one state."""

    name = "actuator_lag"
    source = (
        "first-order actuator dynamics; Franklin, Powell, Emami-Naeini, Feedback Control of Dynamic Systems"
    )
    excludes = (Port.BODY_MOMENT,)  # there it is motor_lag
    sentence = "The actuator follows its command late, with a time constant of {time_constant}."
