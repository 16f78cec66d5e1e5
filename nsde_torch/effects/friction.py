"""Friction of one coordinate; v is its velocity.

The sign of v is smoothed, tanh(v / width), so that friction is a function with a slope at rest.
(Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
control of machines with friction", Automatica 30, 1994.)
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Parameter
from nsde_torch.effects.law import Law

SURVEY = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
WIDTHS = (0.02, 0.1)
"""Widths to try, as multiples of the speeds in the data: developed almost at once, and gently."""
SLOW_AND_FAST = "run at several steady speeds, slow and fast, in both directions"


def width() -> Parameter:
    """The parameter that smooths a sign."""
    return Parameter(0.01, "speed", low=0.0, help="speed at which it is 76 % developed")


@final
class ViscousFriction(Law):
    """Friction in proportion to velocity."""

    name = "viscous_friction"
    formula = "-b v"
    source = "supplement B: m q'' = -b q' - k q"
    PARAMETERS = {"damping": Parameter(0.3, "force/speed", low=0.0, help="damping")}
    along = "speed"
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    sentence = "Friction brakes {it} in proportion to its speed, with {damping}."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        return -self.value("damping") * self.v(x)


@final
class CoulombFriction(Law):
    """Dry friction of constant size against the motion, smoothed at rest."""

    name = "coulomb_friction"
    formula = "-c tanh(v / v0)"
    source = SURVEY
    PARAMETERS = {
        "size": Parameter(0.1, "force", low=0.0, help="friction force"),
        "width": width(),
    }
    along = "speed"
    null = {"size": 0.0}
    amplitudes = ("size",)
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    sentence = "Dry friction brakes {it} with {size}, whatever its speed."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        return -self.value("size") * torch.tanh(self.v(x) / self.value("width"))


@final
class AsymmetricFriction(Law):
    """Dry friction of another size in each direction."""

    name = "asymmetric_friction"
    formula = "-c+ max(s, 0) - c- min(s, 0), s = tanh(v / v0)"
    source = SURVEY + ", section on direction-dependent friction"
    PARAMETERS = {
        "size_forward": Parameter(0.1, "force", low=0.0, help="friction where v > 0"),
        "size_backward": Parameter(0.1, "force", low=0.0, help="friction where v < 0"),
        "width": width(),
    }
    along = "speed"
    null = {"size_forward": 0.0, "size_backward": 0.0}
    amplitudes = ("size_forward", "size_backward")
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    includes = ("coulomb_friction",)
    same = {"size_forward": "size", "size_backward": "size"}
    sentence = "Dry friction brakes {it} with {size_forward} forwards and {size_backward} backwards."
    separate = "run at the same speeds in both directions, and let it come to rest from both sides"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        s = torch.tanh(self.v(x) / self.value("width"))
        return -self.value("size_forward") * s.clamp_min(0.0) - self.value("size_backward") * s.clamp_max(0.0)


@final
class StribeckFriction(Law):
    """Dry friction that is larger at low speed, where surfaces stick."""

    name = "stribeck_friction"
    formula = "-(c + e exp(-(v / vs)^2)) tanh(v / v0)"
    source = SURVEY
    PARAMETERS = {
        "size": Parameter(0.1, "force", low=0.0, help="friction at speed"),
        "extra": Parameter(0.05, "force", low=0.0, help="what is added at low speed"),
        "speed": Parameter(0.1, "speed", low=0.0, help="speed at which 37 % of the extra is left"),
        "width": width(),
    }
    along = "speed"
    null = {"size": 0.0, "extra": 0.0}
    amplitudes = ("size", "extra")
    shapes = {"speed": (0.1, 0.3), "width": (0.02,)}
    relative = {"speed": "speed", "width": "speed"}
    dry = True
    includes = ("coulomb_friction",)
    sentence = (
        "Dry friction brakes {it} with {size} at speed and {extra} more near rest, below about {speed}."
    )
    separate = "creep at several speeds below the usual ones, in both directions"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        v = self.v(x)
        ratio = v / self.value("speed")
        size = self.value("size") + self.value("extra") * torch.exp(-ratio * ratio)
        return -size * torch.tanh(v / self.value("width"))


@final
class QuadraticDamping(Law):
    """Friction in proportion to the square of the velocity, as a fluid's."""

    name = "quadratic_damping"
    formula = "-d |v| v"
    source = "drag of a body in a fluid at high Reynolds number"
    PARAMETERS = {"damping": Parameter(0.1, "force/speed2", low=0.0, help="drag")}
    along = "speed"
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    sentence = "Friction brakes {it} in proportion to the square of its speed, with {damping}."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        v = self.v(x)
        return -self.value("damping") * v.abs() * v


@final
class PositionDependentFriction(Law):
    """Dry friction that changes along the way: a bent rail, a joint that binds towards one end."""

    name = "position_dependent_friction"
    kinds = ("rail", "joint")
    reads_position = True
    formula = "-(c + g q) tanh(v / v0)"
    source = SURVEY + ", section on position-dependent friction"
    PARAMETERS = {
        "size": Parameter(0.1, "force", low=0.0, help="friction force at the origin"),
        "slope": Parameter(0.0, "force/position", scale=0.1, help="what it grows by along the way"),
        "width": width(),
    }
    along = "speed"
    null = {"size": 0.0, "slope": 0.0}
    amplitudes = ("size", "slope")
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    includes = ("coulomb_friction",)
    sentence = "Dry friction brakes {it} with {size} at the origin and changes by {slope} along the way."
    separate = "run to and fro at one speed in several places, near both ends"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        size = self.value("size") + self.value("slope") * self.q(x)
        return -size * torch.tanh(self.v(x) / self.value("width"))


@final
class LoadFriction(Law):
    """Dry friction in proportion to a load that the system knows."""

    name = "load_friction"
    reads_load = True
    formula = "-mu |N| tanh(v / v0)"
    source = "Coulomb's law of friction; " + SURVEY
    PARAMETERS = {
        "coefficient": Parameter(0.05, "1", low=0.0, scale=0.1, help="friction over load"),
        "width": width(),
    }
    along = "speed"
    null = {"coefficient": 0.0}
    amplitudes = ("coefficient",)
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    sentence = "Dry friction brakes {it} with {coefficient} of its load."
    separate = "run at one speed under small and large loads"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        size = self.value("coefficient") * self.load(u).abs()
        return -size * torch.tanh(self.v(x) / self.value("width"))
