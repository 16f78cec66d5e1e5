"""Effects of the cart and pole that are no law of one of its two coordinates: a track in tilt, another gravity.

Equations are those of Florian, "Correct equations for the dynamics of the cart-pole system" (2007), which corrects
Barto, Sutton, Anderson (1983). A track at a slope of sin(angle) = s pulls cart and pole alike along it: x'' loses g s,
the pole does not notice, and its angle counts from the normal of the track.
"""

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Port, Size

FLORIAN = "Florian, Correct equations for the dynamics of the cart-pole system (2007)"
GRAVITY = 9.8


class TrackTilt(Effect):
    """The track is not level: gravity pulls cart and pole along it."""

    port = Port.WORLD_FORCE
    systems = ("cartpole",)
    formula = "-g s, s = sin(angle of the track)"
    source = "gravity along an incline, in the equations of " + FLORIAN
    slope = Size(0.0, "1", scale=0.01, help="rise over length along the track")
    sentence = "The track rises by {slope} of its length, so that cart and pole are pulled along it."
    separate = "leave it alone, at rest: a tilt moves cart and pole alike, a force on the cart tilts the pole"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return (-GRAVITY * self.slope).expand(x.shape[0], 1)


class PoleGravity(Effect):
    """Gravity that is not 9.8 m/s2, as in the gym task: 9.81 turns a pole by a thousandth more.

    The half-length scales what gravity does and what the cart does alike, so that it cannot make up for it. Of eight
    simulated carts with 9.81 m/s2 and little noise, three were surely named a ripple of the pole without this effect.
    """

    name = "gravity"
    port = Port.TORQUE
    systems = ("cartpole",)
    formula = "c sin(theta), c = 3 (g - 9.8 m/s2) / (4 half_length)"
    source = "the gravity term of the equations of " + FLORIAN
    excess = Size(0.0, "1/s2", scale=0.02, help="by how much gravity turns the pole more")
    sentence = "Gravity turns the pole by {excess} times the sine of its angle more than 9.8 m/s2 does."
    separate = "let the pole swing freely, the cart held: how fast it swings tells gravity over its length"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.excess * torch.sin(x[:, 2:3])
