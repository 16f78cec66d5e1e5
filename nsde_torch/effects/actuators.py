"""What an actuator makes of its command, without memory: terms on the port `input`, in the unit of the input.

(Tao, Kokotovic, "Adaptive Control of Systems with Actuator and Sensor Nonlinearities", 1996, for dead band and
saturation.)
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port, elapsed

BOOK = "Tao, Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"
NONE = 1e6
"""A level of saturation that no command reaches."""


@final
class ActuatorDeadband(Effect):
    """Commands near zero do nothing, and larger ones lose as much."""

    name = "actuator_deadband"
    port = Port.INPUT
    stage = 1
    formula = "u_eff = u - clip(u, -w, w)"
    source = BOOK
    PARAMETERS = {
        "width": Parameter(0.1, "input", low=0.0, scale=0.1, help="smallest command that does something")
    }
    null = {"width": 0.0}
    shapes = {"width": (0.05, 0.15, 0.4)}
    relative = {"width": "input"}
    sentence = "Commands below {width} do nothing, and larger ones lose as much."
    separate = "give slow small inputs through zero, and large ones"

    @classmethod
    def no_candidate(cls, system: str) -> str:
        """See `Effect.no_candidate`."""
        flies = system in ("hexacopter", "quadrotor")
        return (
            "motors in flight are far above it, and what they lose is an offset of the thrust"
            if flies
            else ""
        )

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        width = self.value("width")
        return -torch.minimum(torch.maximum(u, -width), width)


@final
class ActuatorSaturation(Effect):
    """Commands beyond a level are cut."""

    name = "actuator_saturation"
    port = Port.INPUT
    stage = 1
    formula = "u_eff = clip(u, -level, level)"
    source = BOOK
    PARAMETERS = {
        "level": Parameter(0.5, "input", low=0.0, scale=0.5, help="largest command that acts in full")
    }
    null = {"level": NONE}
    shapes = {"level": (0.5, 0.75, 0.95, 1.15)}  # above the quantile commands are rare, not absent
    relative = {"level": "input"}
    sentence = "Commands beyond {level} are cut to it."
    separate = "give inputs of several amplitudes, the largest far beyond the usual ones"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        level = self.value("level")
        return torch.minimum(torch.maximum(u, -level), level) - u


@final
class ActuatorGainDrift(Effect):
    """The strength of the actuator changes with time."""

    name = "actuator_gain_drift"
    port = Port.INPUT
    formula = "u_eff = u (1 + r t)"
    source = "warming or wear of an actuator, first order in time"
    PARAMETERS = {"rate": Parameter(0.0, "1/s", scale=0.01, help="relative change of strength per second")}
    null = {"rate": 0.0}
    amplitudes = ("rate",)
    sentence = "The actuator's strength changes by {rate}, counted from the start of the clock."
    separate = "repeat the same inputs early and late in a long run"

    @classmethod
    def no_candidate(cls, system: str) -> str:
        """See `Effect.no_candidate`."""
        return "thrust_sag is the same term" if system in ("hexacopter", "quadrotor") else ""

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return (self.value("rate") * elapsed(t, x)).to(u.dtype) * u
