"""Friction on the port `force`; v is the velocity that the force acts on, all terms are over mass.

The sign of v is smoothed, tanh(v / width), so that friction is a function with a slope at rest.
(Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
control of machines with friction", Automatica 30, 1994.)
"""

from typing import ClassVar, final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port

SURVEY = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
WIDTHS = (0.02, 0.1)
"""Widths to try, as multiples of the speeds in the data: developed almost at once, and gently."""
SLOW_AND_FAST = "run at several steady speeds, slow and fast, in both directions"


def width(unit: str) -> Parameter:
    """The parameter that smooths a sign."""
    return Parameter(0.01, unit, low=0.0, help="speed at which it is 76 % developed")


class Viscous(Effect):
    """Friction in proportion to one velocity; subclasses say which."""

    column: ClassVar[int]
    """State that is the velocity."""
    formula = "-b v"
    along = "speed"
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    separate = SLOW_AND_FAST

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("damping") * x[:, self.column : self.column + 1]


class Coulomb(Effect):
    """Dry friction of constant size against one velocity, smoothed at rest; subclasses say which."""

    column: ClassVar[int]
    """State that is the velocity."""
    formula = "-c tanh(v / v0)"
    along = "speed"
    null = {"size": 0.0}
    amplitudes = ("size",)
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    separate = SLOW_AND_FAST

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("size") * torch.tanh(x[:, self.column : self.column + 1] / self.value("width"))


@final
class ViscousFriction(Viscous):
    """Friction in proportion to velocity."""

    name = "viscous_friction"
    port = Port.FORCE
    column = 1
    source = "supplement B: m q'' = -b q' - k q"
    PARAMETERS = {"damping": Parameter(0.3, "1/s", low=0.0, help="damping over mass")}
    sentence = "The motion is braked in proportion to its speed, with {damping} over mass."

    @classmethod
    def candidate(cls, system: str) -> bool:
        """Not on the cart and pole, where `cart_viscous_friction` is the same term."""
        return system != "cartpole"


@final
class CoulombFriction(Coulomb):
    """Dry friction of constant size against the motion, smoothed at rest."""

    name = "coulomb_friction"
    port = Port.FORCE
    column = 1
    source = SURVEY
    PARAMETERS = {
        "size": Parameter(0.1, "m/s2", low=0.0, help="friction force over mass"),
        "width": width("m/s"),
    }
    sentence = "Dry friction brakes the motion with {size}, whatever its speed."

    @classmethod
    def candidate(cls, system: str) -> bool:
        """Not on the cart and pole, where `cart_coulomb_friction` is the same term."""
        return system != "cartpole"


@final
class AsymmetricFriction(Effect):
    """Dry friction of another size in each direction."""

    name = "asymmetric_friction"
    port = Port.FORCE
    formula = "-c+ max(s, 0) - c- min(s, 0), s = tanh(v / v0)"
    source = SURVEY + ", section on direction-dependent friction"
    PARAMETERS = {
        "size_forward": Parameter(0.1, "m/s2", low=0.0, help="friction over mass where v > 0"),
        "size_backward": Parameter(0.1, "m/s2", low=0.0, help="friction over mass where v < 0"),
        "width": width("m/s"),
    }
    along = "speed"
    null = {"size_forward": 0.0, "size_backward": 0.0}
    amplitudes = ("size_forward", "size_backward")
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    includes = ("coulomb_friction", "cart_coulomb_friction")
    same = {"size_forward": "size", "size_backward": "size"}
    sentence = "Dry friction brakes with {size_forward} forwards and {size_backward} backwards."
    separate = "run at the same speeds in both directions, and let it come to rest from both sides"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        s = torch.tanh(x[:, 1:2] / self.value("width"))
        return -self.value("size_forward") * s.clamp_min(0.0) - self.value("size_backward") * s.clamp_max(0.0)


@final
class StribeckFriction(Effect):
    """Dry friction that is larger at low speed, where surfaces stick."""

    name = "stribeck_friction"
    port = Port.FORCE
    formula = "-(c + e exp(-(v / vs)^2)) tanh(v / v0)"
    source = SURVEY
    PARAMETERS = {
        "size": Parameter(0.1, "m/s2", low=0.0, help="friction over mass at speed"),
        "extra": Parameter(0.05, "m/s2", low=0.0, help="what is added at low speed"),
        "speed": Parameter(0.1, "m/s", low=0.0, help="speed at which 37 % of the extra is left"),
        "width": width("m/s"),
    }
    along = "speed"
    null = {"size": 0.0, "extra": 0.0}
    amplitudes = ("size", "extra")
    shapes = {"speed": (0.1, 0.3), "width": (0.02,)}
    relative = {"speed": "speed", "width": "speed"}
    includes = ("coulomb_friction", "cart_coulomb_friction")
    sentence = "Dry friction brakes with {size} at speed and {extra} more near rest, below about {speed}."
    separate = "creep at several speeds below the usual ones, in both directions"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        v = x[:, 1:2]
        ratio = v / self.value("speed")
        size = self.value("size") + self.value("extra") * torch.exp(-ratio * ratio)
        return -size * torch.tanh(v / self.value("width"))


@final
class QuadraticDamping(Effect):
    """Friction in proportion to the square of the velocity, as a fluid's."""

    name = "quadratic_damping"
    port = Port.FORCE
    formula = "-d |v| v"
    source = "drag of a body in a fluid at high Reynolds number"
    PARAMETERS = {"damping": Parameter(0.1, "1/m", low=0.0, help="drag over mass")}
    along = "speed"
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    sentence = "The motion is braked in proportion to the square of its speed, with {damping} over mass."
    separate = SLOW_AND_FAST

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        v = x[:, 1:2]
        return -self.value("damping") * v.abs() * v
