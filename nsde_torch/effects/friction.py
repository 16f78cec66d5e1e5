"""Friction of one coordinate.

The sign of v is smoothed, tanh(v / width), so that friction is a function with a slope at rest.
(Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
control of machines with friction", Automatica 30, 1994.)
"""

import torch
from torch import Tensor

from nsde_torch.effects.base import Parameter, Size
from nsde_torch.effects.law import Law

SURVEY = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
SLOW_AND_FAST = "run at several steady speeds, slow and fast, in both directions"


class _DryFriction(Law):
    """Dry friction against the motion, smoothed at rest over a `width`."""

    width = Parameter(0.01, "speed", low=0.0, help="speed at which it is 76 % developed")
    along = "speed"
    shapes = {"width": (0.02, 0.1)}  # of the speeds in the data: developed almost at once, and gently
    relative = {"width": "speed"}
    dry = True

    def developed(self, x: Tensor) -> Tensor:
        """The smoothed sign of the velocity (N, 1)."""
        return torch.tanh(self.v(x) / self.width)


class CoulombFriction(_DryFriction):
    """Dry friction of constant size against the motion, smoothed at rest."""

    formula = "-c tanh(v / v0)"
    source = SURVEY
    size = Size(0.1, "force", low=0.0, help="friction force")
    sentence = "Dry friction brakes {it} with {size}, whatever its speed."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.size * self.developed(x)


class AsymmetricFriction(_DryFriction):
    """Dry friction of another size in each direction."""

    formula = "-c+ max(s, 0) - c- min(s, 0), s = tanh(v / v0)"
    source = SURVEY + ", section on direction-dependent friction"
    size_forward = Size(0.1, "force", low=0.0, help="friction where v > 0")
    size_backward = Size(0.1, "force", low=0.0, help="friction where v < 0")
    includes = ("coulomb_friction",)
    same = {"size_forward": "size", "size_backward": "size"}
    sentence = "Dry friction brakes {it} with {size_forward} forwards and {size_backward} backwards."
    separate = "run at the same speeds in both directions, and let it come to rest from both sides"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        s = self.developed(x)
        return -self.size_forward * s.clamp_min(0.0) - self.size_backward * s.clamp_max(0.0)


class StribeckFriction(_DryFriction):
    """Dry friction that is larger at low speed, where surfaces stick."""

    formula = "-(c + e exp(-(v / vs)^2)) tanh(v / v0)"
    source = SURVEY
    size = Size(0.1, "force", low=0.0, help="friction at speed")
    extra = Size(0.05, "force", low=0.0, help="what is added at low speed")
    speed = Parameter(0.1, "speed", low=0.0, help="speed at which 37 % of the extra is left")
    shapes = {"speed": (0.1, 0.3), "width": (0.02,)}
    relative = {"speed": "speed", "width": "speed"}
    includes = ("coulomb_friction",)
    sentence = (
        "Dry friction brakes {it} with {size} at speed and {extra} more near rest, below about {speed}."
    )
    separate = "creep at several speeds below the usual ones, in both directions"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        ratio = self.v(x) / self.speed
        size = self.size + self.extra * torch.exp(-ratio * ratio)
        return -size * self.developed(x)


class ViscousFriction(Law):
    """Friction in proportion to velocity."""

    formula = "-b v"
    source = "supplement B: m q'' = -b q' - k q"
    damping = Size(0.3, "force/speed", low=0.0, help="damping")
    along = "speed"
    sentence = "Friction brakes {it} in proportion to its speed, with {damping}."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.damping * self.v(x)


class QuadraticDamping(Law):
    """Friction in proportion to the square of the velocity, as a fluid's."""

    formula = "-d |v| v"
    source = "drag of a body in a fluid at high Reynolds number"
    damping = Size(0.1, "force/speed2", low=0.0, help="drag")
    along = "speed"
    sentence = "Friction brakes {it} in proportion to the square of its speed, with {damping}."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = self.v(x)
        return -self.damping * v.abs() * v


class PositionDependentFriction(_DryFriction):
    """Dry friction that changes along the way: a crooked rail, a joint that binds towards one end."""

    kinds = ("rail", "joint")
    reads_position = True
    formula = "-(c + g q) tanh(v / v0)"
    source = SURVEY + ", section on position-dependent friction"
    size = Size(0.1, "force", low=0.0, help="friction force at the origin")
    slope = Size(0.0, "force/position", scale=0.1, help="what it grows by along the way")
    includes = ("coulomb_friction",)
    sentence = "Dry friction brakes {it} with {size} at the origin and changes by {slope} along the way."
    separate = "run to and fro at one speed in several places, near both ends"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        size = self.size + self.slope * self.q(x)
        return -size * self.developed(x)


class LoadFriction(_DryFriction):
    """Dry friction in proportion to a load that the system knows."""

    reads_load = True
    formula = "-mu |N| tanh(v / v0)"
    source = "Coulomb's law of friction; " + SURVEY
    coefficient = Size(0.05, "1", low=0.0, scale=0.1, help="friction over load")
    sentence = "Dry friction brakes {it} with {coefficient} of its load."
    separate = "run at one speed under small and large loads"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        size = self.coefficient * self.load(u).abs()
        return -size * self.developed(x)
