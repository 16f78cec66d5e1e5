"""Machines of one degree of freedom, q'' = gain u + what effects add; the mass on a spring among them.

Mass-spring-damper: m q'' = -b q' - k q + F (supplement B), divided by the mass, which cannot be told from the spring:
the parameters are k/m, b/m and 1/m.
"""

from collections.abc import Mapping
from typing import ClassVar, final

import torch
from torch import Tensor

from nsde_torch.effects import Parameter, Port
from nsde_torch.systems.base import System
from nsde_torch.systems.constants import Defaults, ErrorGroup, ResidualPort


class OneDegreeOfFreedom(System):
    """A position, its rate and one input. A machine names its states, units and parameters; what brakes or pulls is an
    effect.

    Attributes:
        gain: Name of the parameter that the input is multiplied by.
    """

    gain: ClassVar[str] = "force_gain"
    ports = {Port.FORCE: 1}
    sensor_noise = True

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        """See `System.dynamics`."""
        acceleration = self.value(self.gain) * u
        if Port.FORCE in forces:
            acceleration = acceleration + forces[Port.FORCE]
        return torch.cat((x[:, 1:], acceleration), 1)

    def features(self, x: Tensor) -> Tensor:
        """Position and rate (N, 2)."""
        return x


@final
class MassSpringDamper(OneDegreeOfFreedom):
    """A mass on a spring with a damper and an optional force. `declared=[]` leaves q'' wholly to the network."""

    name = "mass_spring_damper"
    state_names = ("q", "q_dot")
    state_units = ("m", "m/s")
    input_names = ("force",)
    input_units = ("N",)
    declared = ("linear_spring", "viscous_friction")
    residual_ports = {Port.FORCE: ResidualPort(1, 0.1, "m/s2")}
    defaults = Defaults(0.01, 50, (0.001, 0.02), 0.05, 1.0, "euler_maruyama")
    error_names = ("q", "q_dot")
    error_groups = (ErrorGroup("position", (0,), "m"), ErrorGroup("velocity", (1,), "m/s"))
    feature_names = state_names
    feature_units = state_units
    optional_inputs = ("force",)
    position_derivatives = (("q", "q_dot", "world"),)
    PARAMETERS = {"force_gain": Parameter(1.0, "1/kg", low=0.0, help="1 / mass")}

    @property
    def physics_ports(self) -> set[Port]:
        """The force, unless spring and damper were taken out (`declared=[]`)."""
        return {effect.port for effect in self.effects}  # type: ignore[misc]
