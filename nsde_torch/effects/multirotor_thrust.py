"""What becomes of a motor's command before it is thrust: terms on the port `input`, after the lag.

A command u_i in [0, 1] is a share of thrust here, so that thrust and moments of the motor change together.
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port, elapsed

_MULTIROTOR = (Port.BODY_MOMENT,)


@final
class MotorEfficiencyLoss(Effect):
    """Single motors give less than the others: a chipped propeller, a worn bearing."""

    name = "motor_efficiency_loss"
    port = Port.INPUT
    needs = _MULTIROTOR
    formula = "u_eff,i = u_i (1 - l_i)"
    source = "actuator effectiveness factor; Zhang, Jiang, Annual Reviews in Control 32 (2008)"
    PARAMETERS = {
        "loss": Parameter(
            0.01, "1", low=0.0, high=1.0, scale=0.1, help="share lost, one per motor", per_input=True
        )
    }
    null = {"loss": 0.0}
    amplitudes = ("loss",)
    sentence = "Motors have lost {loss} of their strength (one number per motor, in their order)."
    separate = "climb, sink and yaw: a weak motor shows in the moments about all axes at once"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("loss") * u


@final
class ThrustSag(Effect):
    """Thrust per command falls with time, as a battery empties."""

    name = "thrust_sag"
    port = Port.INPUT
    needs = _MULTIROTOR
    formula = "u_eff = u (1 - r t)"
    source = "falling battery voltage, first order in time"
    PARAMETERS = {"rate": Parameter(0.0005, "1/s", low=0.0, scale=0.001, help="share lost per second")}
    null = {"rate": 0.0}
    amplitudes = ("rate",)
    sentence = "Thrust per command falls by {rate}, counted from the start of the clock."
    separate = "log the battery's voltage, and fly one battery longer"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -(self.value("rate") * elapsed(t, x)).to(u.dtype) * u


REFERENCES = ((5.5, 4.0), (8.9, 8.0))
"""Voltages up to which a pack has one cell, and two, and at which thrust per command is then what the gains say [V]."""
REFERENCE = 16.0
"""Voltage at which thrust per command is what the declared gains say, of larger packs [V] (four cells)."""


@final
class BatteryVoltage(Effect):
    """Thrust per command follows the logged voltage of the battery."""

    name = "battery_voltage"
    port = Port.INPUT
    needs = _MULTIROTOR
    exogenous = ("battery_voltage",)
    formula = "u_eff = u (1 + s (V - V_0))"
    source = "motor speed follows the voltage at a given duty; first order around 4 V (one cell), 8 V (two) or 16 V"
    PARAMETERS = {
        "sensitivity": Parameter(0.05, "1/V", low=0.0, scale=0.05, help="relative change of thrust per volt")
    }
    null = {"sensitivity": 0.0}
    amplitudes = ("sensitivity",)
    sentence = "Thrust per command follows the battery's voltage, by {sensitivity}."
    separate = "fly the same path on a full and on an empty battery"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        voltage = self.channel("battery_voltage", u)
        reference = torch.full_like(voltage, REFERENCE)
        for most, own in reversed(REFERENCES):
            reference = torch.where(voltage < most, own, reference)
        return self.value("sensitivity") * (voltage - reference) * u[:, : u.shape[1] - 1]


@final
class ThrustCurve(Effect):
    """Thrust is not proportional to the command: a second degree of the thrust map."""

    name = "thrust_curve"
    port = Port.INPUT
    needs = _MULTIROTOR
    formula = "u_eff = u + c u^2"
    source = "supplement eq. 4: thrust map as a polynomial of the command"
    PARAMETERS = {"curvature": Parameter(0.0, "1", scale=0.1, help="second coefficient over the first")}
    null = {"curvature": 0.0}
    amplitudes = ("curvature",)
    sentence = "Thrust grows with {curvature} times the square of the command beside the command itself."
    separate = "climb and sink hard, for commands far from hover"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return self.value("curvature") * u * u
