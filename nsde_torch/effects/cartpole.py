"""Effects of the cart and pole: on the cart (`force`, over total mass), the pole (`torque`) and all (`world_force`).

Friction as in Florian, "Correct equations for the dynamics of the cart-pole system" (2007), which corrects Barto,
Sutton, Anderson (1983). A track at a slope of sin(angle) = s pulls cart and pole alike along it: x'' loses g s, the
pole does not notice, and its angle counts from the normal of the track.
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.effects.friction import SLOW_AND_FAST, WIDTHS, width

FLORIAN = "Florian, Correct equations for the dynamics of the cart-pole system (2007)"
GRAVITY = 9.8


@final
class CartCoulombFriction(Effect):
    """Dry friction between cart and track."""

    name = "cart_coulomb_friction"
    port = Port.FORCE
    systems = ("cartpole",)
    formula = "-c tanh(x' / v0)"
    source = FLORIAN
    PARAMETERS = {
        "size": Parameter(0.1, "m/s2", low=0.0, help="friction over total mass"),
        "width": width("m/s"),
    }
    null = {"size": 0.0}
    amplitudes = ("size",)
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    sentence = "Dry friction of the track brakes the cart with {size}."
    separate = SLOW_AND_FAST

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("size") * torch.tanh(x[:, 1:2] / self.value("width"))


@final
class CartViscousFriction(Effect):
    """Friction between cart and track in proportion to velocity."""

    name = "cart_viscous_friction"
    port = Port.FORCE
    systems = ("cartpole",)
    formula = "-b x'"
    source = FLORIAN
    PARAMETERS = {"damping": Parameter(0.1, "1/s", low=0.0, help="damping over total mass")}
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    sentence = "The cart is braked in proportion to its speed, with {damping} over total mass."
    separate = SLOW_AND_FAST

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("damping") * x[:, 1:2]


@final
class PoleViscousFriction(Effect):
    """Friction in the pivot in proportion to the pole's rate."""

    name = "pole_viscous_friction"
    port = Port.TORQUE
    systems = ("cartpole",)
    formula = "-b theta'"
    source = FLORIAN
    PARAMETERS = {"damping": Parameter(0.1, "1/s", low=0.0, help="damping over the pole's inertia")}
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    sentence = "The pivot brakes the pole in proportion to its rate, with {damping} over its inertia."
    separate = "let the pole swing out from several heights, the cart held"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("damping") * x[:, 3:4]


@final
class PoleCoulombFriction(Effect):
    """Dry friction in the pivot."""

    name = "pole_coulomb_friction"
    port = Port.TORQUE
    systems = ("cartpole",)
    formula = "-c tanh(theta' / w0)"
    source = FLORIAN
    PARAMETERS = {
        "size": Parameter(0.1, "rad/s2", low=0.0, help="friction torque over the pole's inertia"),
        "width": width("rad/s"),
    }
    null = {"size": 0.0}
    amplitudes = ("size",)
    shapes = {"width": WIDTHS}
    relative = {"width": "rate"}
    sentence = "Dry friction in the pivot brakes the pole with {size}."
    separate = "let the pole swing out from several heights, the cart held"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("size") * torch.tanh(x[:, 3:4] / self.value("width"))


@final
class TrackTilt(Effect):
    """The track is not level: gravity pulls cart and pole along it."""

    name = "track_tilt"
    port = Port.WORLD_FORCE
    systems = ("cartpole",)
    formula = "-g s, s = sin(angle of the track)"
    source = "gravity along an incline, in the equations of " + FLORIAN
    PARAMETERS = {"slope": Parameter(0.0, "1", scale=0.01, help="rise over length along the track")}
    null = {"slope": 0.0}
    amplitudes = ("slope",)
    sentence = "The track rises by {slope} of its length, so that cart and pole are pulled along it."
    separate = "leave it alone, at rest: a tilt moves cart and pole alike, a force on the cart tilts the pole"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return (-GRAVITY * self.value("slope")).expand(x.shape[0], 1)
