"""Forces on multirotors beside drag, over mass [m/s2]; T is the thrust over mass that the declared physics gives."""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port


@final
class ConstantWorldForce(Effect):
    """A force that never changes in the world, as a cable's."""

    name = "constant_world_force"
    port = Port.WORLD_FORCE
    needs = (Port.BODY_FORCE,)
    formula = "c"
    source = "a lasting disturbance force; Tomic, Ott, Haddadin, IEEE T-RO 33 (2017)"
    PARAMETERS = {
        "acceleration": Parameter((0.0, 0.0, 0.0), "m/s2", scale=0.1, help="force over mass, east north up")
    }
    null = {"acceleration": 0.0}
    amplitudes = ("acceleration",)
    sentence = "A force that never changes pushes with {acceleration} to east, north and up."
    separate = (
        "hover with the nose in several directions: a force of the world stays, one of the body turns with it"
    )

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return self.value("acceleration").expand(x.shape[0], 3)


@final
class GroundEffect(Effect):
    """More thrust near the ground, which is where p_z = 0."""

    name = "ground_effect"
    port = Port.BODY_FORCE
    quantities = {"thrust": 1}
    formula = "T a / (p_z^2 + h^2), along body z"
    source = (
        "Cheeseman, Bennett, ARC R&M 3021 (1955), 1 / (1 - (R / 4 z)^2) to first order, softened within h"
    )
    PARAMETERS = {
        "area": Parameter(0.01, "m2", low=0.0, help="a = (R / 4)^2 of a rotor of radius R"),
        "height": Parameter(0.2, "m", low=0.0, help="h, height below which it grows no more"),
    }
    null = {"area": 0.0}
    amplitudes = ("area",)
    shapes = {"height": (0.1, 0.3)}
    sentence = (
        "Near the ground the rotors lift more: by {area} over height squared, softened within {height}."
    )
    separate = "hover at several heights, from a quarter of a metre to two"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        z, h = x[:, 2:3], self.value("height")
        lift = self.channel("thrust", u) * self.value("area") / (z * z + h * h)
        return torch.cat((torch.zeros_like(lift), torch.zeros_like(lift), lift), 1)


@final
class ThrustMisalignment(Effect):
    """The thrust axis is tilted against the body axis of the log."""

    name = "thrust_misalignment"
    port = Port.BODY_FORCE
    quantities = {"thrust": 1}
    formula = "T (a_x, a_y, 0)"
    source = "small rotation of the thrust vector; mounting of motors or of the flight controller"
    PARAMETERS = {
        "tilt": Parameter((0.0, 0.0), "rad", scale=0.01, help="tilt of the thrust towards body x and y")
    }
    null = {"tilt": 0.0}
    amplitudes = ("tilt",)
    sentence = "The thrust does not point along the body's axis: it is tilted by {tilt} to forward and left."
    separate = "hover with the nose in several directions: a tilted thrust turns with the body, a wind stays"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        sideways = self.value("tilt") * self.channel("thrust", u)
        return torch.cat((sideways, torch.zeros_like(sideways[:, :1])), 1)
