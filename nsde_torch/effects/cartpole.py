"""Effects of the cart and pole: on the cart (`force`, over total mass), the pole (`torque`) and all (`world_force`).

Friction as in Florian, "Correct equations for the dynamics of the cart-pole system" (2007), which corrects Barto,
Sutton, Anderson (1983). A track at a slope of sin(angle) = s pulls cart and pole alike along it: x'' loses g s, the
pole does not notice, and its angle counts from the normal of the track. A sensor of the angle that reads b too much
puts all of the pole's physics at theta - b.
"""

from typing import final

from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.effects.friction import Coulomb, Viscous, width

FLORIAN = "Florian, Correct equations for the dynamics of the cart-pole system (2007)"
GRAVITY = 9.8
SWING = "let the pole swing out from several heights, the cart held"


@final
class CartCoulombFriction(Coulomb):
    """Dry friction between cart and track."""

    name = "cart_coulomb_friction"
    port = Port.FORCE
    systems = ("cartpole",)
    column = 1
    formula = "-c tanh(x' / v0)"
    source = FLORIAN
    PARAMETERS = {
        "size": Parameter(0.1, "m/s2", low=0.0, help="friction over total mass"),
        "width": width("m/s"),
    }
    sentence = "Dry friction of the track brakes the cart with {size}."


@final
class CartViscousFriction(Viscous):
    """Friction between cart and track in proportion to velocity."""

    name = "cart_viscous_friction"
    port = Port.FORCE
    systems = ("cartpole",)
    column = 1
    formula = "-b x'"
    source = FLORIAN
    PARAMETERS = {"damping": Parameter(0.1, "1/s", low=0.0, help="damping over total mass")}
    sentence = "The cart is braked in proportion to its speed, with {damping} over total mass."


@final
class PoleViscousFriction(Viscous):
    """Friction in the pivot in proportion to the pole's rate."""

    name = "pole_viscous_friction"
    port = Port.TORQUE
    systems = ("cartpole",)
    column = 3
    formula = "-b theta'"
    source = FLORIAN
    PARAMETERS = {"damping": Parameter(0.1, "1/s", low=0.0, help="damping over the pole's inertia")}
    sentence = "The pivot brakes the pole in proportion to its rate, with {damping} over its inertia."
    separate = SWING


@final
class PoleCoulombFriction(Coulomb):
    """Dry friction in the pivot."""

    name = "pole_coulomb_friction"
    port = Port.TORQUE
    systems = ("cartpole",)
    column = 3
    formula = "-c tanh(theta' / w0)"
    source = FLORIAN
    PARAMETERS = {
        "size": Parameter(0.1, "rad/s2", low=0.0, help="friction torque over the pole's inertia"),
        "width": width("rad/s"),
    }
    relative = {"width": "rate"}
    sentence = "Dry friction in the pivot brakes the pole with {size}."
    separate = SWING


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


@final
class AngleBias(Effect):
    """The sensor of the pole's angle reads too much, by the same at every angle."""

    name = "angle_bias"
    port = Port.ANGLE
    systems = ("cartpole",)
    formula = "theta - b"
    source = "zero of a rotary encoder, in the equations of " + FLORIAN
    PARAMETERS = {
        "bias": Parameter(0.0, "rad", scale=0.02, help="angle that is read where the pole is upright")
    }
    null = {"bias": 0.0}
    sentence = "The sensor of the pole's angle reads {bias} too much."
    separate = "let the pole hang at rest, the cart free: its angle is then half a turn and the bias"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return (-self.value("bias")).expand(x.shape[0], 1)
