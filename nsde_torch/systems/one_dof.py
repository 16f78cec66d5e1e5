"""Mass-spring-damper: m q'' = -b q' - k q + F (supplement B), divided by the mass.

The mass cannot be told from the spring: the parameters are k/m, b/m and 1/m.
"""

from collections.abc import Mapping
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Parameter, Port
from nsde_torch.systems.base import System
from nsde_torch.systems.constants import Defaults, ErrorGroup, ResidualPort


@final
class MassSpringDamper(System):
    """A mass on a spring with a damper and an optional force. `declared=[]` leaves q'' wholly to the network."""

    name = "mass_spring_damper"
    state_names = ("q", "q_dot")
    state_units = ("m", "m/s")
    input_names = ("force",)
    input_units = ("N",)
    ports = {Port.FORCE: 1}
    declared = ("linear_spring", "viscous_friction")
    residual_ports = {Port.FORCE: ResidualPort(1, 0.1, "m/s2")}
    defaults = Defaults(0.01, 50, (0.001, 0.02), 0.05, 1.0, "euler_maruyama")
    error_names = ("q", "q_dot")
    error_groups = (ErrorGroup("position", (0,), "m"), ErrorGroup("velocity", (1,), "m/s"))
    feature_names = state_names
    feature_units = state_units
    sensor_noise = True
    optional_inputs = ("force",)
    position_derivatives = (("q", "q_dot", "world"),)
    PARAMETERS = {"force_gain": Parameter(1.0, "1/kg", low=0.0, help="1 / mass")}

    @property
    def physics_ports(self) -> set[Port]:
        """The force, unless spring and damper were taken out (`declared=[]`)."""
        return {effect.port for effect in self.effects}  # type: ignore[misc]

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        """See `System.dynamics`."""
        acceleration = self.value("force_gain") * u
        if Port.FORCE in forces:
            acceleration = acceleration + forces[Port.FORCE]
        return torch.cat((x[:, 1:], acceleration), 1)

    def features(self, x: Tensor) -> Tensor:
        """Position and velocity."""
        return x
