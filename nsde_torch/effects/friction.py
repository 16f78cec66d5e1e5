"""Friction, and laws that remember the way a machine came.

The sign of v is smoothed, tanh(v / width), so that friction is a function with a slope at rest.
(Armstrong-Helouvry, Dupont, Canudas de Wit, "A survey of models, analysis tools and compensation methods for the
control of machines with friction", Automatica 30, 1994.)
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.actuators import BOOK
from nsde_torch.effects.base import Effect, Parameter, Port
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
    amplitudes = ("damping",)
    sentence = "Friction brakes {it} in proportion to its speed, with {damping}."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("damping") * self.v(x)


@final
class CoulombFriction(Law):
    """Dry friction of constant size against the motion, smoothed at rest."""

    name = "coulomb_friction"
    formula = "-c tanh(v / v0)"
    source = SURVEY
    PARAMETERS = {"size": Parameter(0.1, "force", low=0.0, help="friction force"), "width": width()}
    along = "speed"
    amplitudes = ("size",)
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    sentence = "Dry friction brakes {it} with {size}, whatever its speed."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
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
    amplitudes = ("size_forward", "size_backward")
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    includes = ("coulomb_friction",)
    same = {"size_forward": "size", "size_backward": "size"}
    sentence = "Dry friction brakes {it} with {size_forward} forwards and {size_backward} backwards."
    separate = "run at the same speeds in both directions, and let it come to rest from both sides"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
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
    amplitudes = ("damping",)
    sentence = "Friction brakes {it} in proportion to the square of its speed, with {damping}."
    separate = SLOW_AND_FAST

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = self.v(x)
        return -self.value("damping") * v.abs() * v


@final
class PositionDependentFriction(Law):
    """Dry friction that changes along the way: a crooked rail, a joint that binds towards one end."""

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
    amplitudes = ("size", "slope")
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    includes = ("coulomb_friction",)
    sentence = "Dry friction brakes {it} with {size} at the origin and changes by {slope} along the way."
    separate = "run to and fro at one speed in several places, near both ends"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
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
    amplitudes = ("coefficient",)
    shapes = {"width": WIDTHS}
    relative = {"width": "speed"}
    dry = True
    sentence = "Dry friction brakes {it} with {coefficient} of its load."
    separate = "run at one speed under small and large loads"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        size = self.value("coefficient") * self.load(u).abs()
        return -size * torch.tanh(self.v(x) / self.value("width"))


# Laws that remember the way a machine came: hysteresis of a coordinate, play between an input and what it
# moves.
#
#     hysteresis    F = -s z,   dz/dt = (v - (|v| z + v |z|) / 2) / d      z in [-1, 1]
#     play          u_eff stays where it is until the command has moved by the gap: |u - u_eff| <= w
#
# (Bouc, Modele mathematique d'hysteresis, Acustica 24 (1971); Wen, Method for random vibration of hysteretic
# systems, Journal of the Engineering Mechanics Division 102 (1976), with exponent 1 and equal weights. Tao,
# Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996), for play.) Where d
# goes to nothing, hysteresis is dry friction.

_QUICK_S = 0.002  # in which play is taken up where no step is known [s]


@final
class Hysteresis(Law):
    """A force that depends on the way it came: a spring that yields, rubber, cables, presliding friction (Bouc-Wen)."""

    name = "hysteresis"
    reads_position = True
    formula = "-s z, dz/dt = (v - (|v| z + v |z|) / 2) / d"
    source = "Bouc, Acustica 24 (1971); Wen, J. Eng. Mech. Div. 102 (1976)"
    PARAMETERS = {
        "size": Parameter(0.1, "force", low=0.0, help="force where it yields"),
        "reach": Parameter(0.05, "position", low=0.0, help="way in which it builds up"),
    }
    amplitudes = ("size",)
    shapes = {"reach": (0.05, 0.2, 0.6)}
    relative = {"reach": "position"}
    includes = ("coulomb_friction",)
    sentence = (
        "The force on {it} remembers the way it came (hysteresis): it builds up within {reach} after each turn and "
        "yields at {size}."
    )
    separate = "move to and fro slowly, with small and large strokes: friction turns at once, hysteresis over its reach"

    @property
    def n_memory(self) -> int:
        """The share z of the force at which it yields."""
        return 1

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * memory

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v, z = self.v(x), memory.clamp(-1.0, 1.0)
        return (v - 0.5 * (v.abs() * z + v * z.abs())) / self.value("reach")

    def followed(self, x: Tensor, dt: float) -> Tensor:
        """See `Effect.followed`."""
        from nsde_torch.effects.recursions import bouc_wen

        v, reach = self.v(x)[:, 0], float(self.value("reach").detach())
        ways = torch.cat((0.5 * (v[1:] + v[:-1]), v[-1:])) * (dt / reach)
        return torch.from_numpy(bouc_wen(ways.double().numpy(), float(v[0].sign())))[:, None].to(x.dtype)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`: it has come this way for long."""
        return self.v(x).sign()


@final
class InputPlay(Effect):
    """Play (backlash) between an input and what it moves: after a turn nothing moves until the gap is taken up."""

    name = "input_play"
    each_input = True
    port = Port.INPUT
    stage = 1
    whole_steps = True
    jumps = True
    excludes = (Port.BODY_MOMENT,)  # rotors have none
    formula = "u_eff = m, |u - m| <= w"
    source = BOOK
    PARAMETERS = {"half_gap": Parameter(0.1, "input", low=0.0, scale=0.1, help="half the play")}
    null = {"half_gap": 0.0}
    shapes = {"half_gap": (0.05, 0.2, 0.5)}
    relative = {"half_gap": "input"}
    sentence = (
        "Between the input and what it moves there is play: it remembers the way it came, and after a turn nothing "
        "moves until the input has gone back by twice {half_gap}."
    )
    separate = (
        "give slow triangles of the input, small and large: a delay shifts them in time, play cuts their tops"
    )

    @property
    def n_memory(self) -> int:
        """One state per input: what acts."""
        return self.n_inputs

    def _taken_up(self, u: Tensor, memory: Tensor) -> Tensor:
        own, gap = u[:, : self.n_inputs], self.value("half_gap")
        return torch.minimum(torch.maximum(memory, own - gap), own + gap)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self._taken_up(u, memory) - u[:, : self.n_inputs]

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return (self._taken_up(u, memory) - memory) / (self.step or _QUICK_S)

    def held(self, u: Tensor, dt: float) -> Tensor:
        from nsde_torch.effects.recursions import play

        own = u[:, : self.n_inputs]
        return torch.from_numpy(play(own.double().numpy(), float(self.value("half_gap").detach()))).to(own)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`: in the middle of the play."""
        return u[:, : self.n_inputs]
