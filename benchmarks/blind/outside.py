"""Effects that are not in the catalogue: what a diagnosis has to call unexplained, or a lead at most.

On the spring and on the cart (q, v position and speed, over mass), on the pole, and on multirotors:

    quintic stiffness   -k q^5                    hysteresis   -k m,  s m' = v - (|v| m + v |m|) / 2     (Bouc, Wen)
    cogging             -c sin(2 pi q / p)        friction that depends on the place   -b (q / L)^2 v
    cubic damping       -d v^3                    burst        a exp(-((t - t0) / w)^2)
    pole: magnet        -c sin(2 theta)           air drag     -d |theta'| theta'
    cross drag          d (-v_y, v_x, 0)          fan          a exp(-|p - p0|^2 / 2 r^2) to the east
    cubic drag          -d |v|^2 v                lift with speed   T c (v_x^2 + v_y^2)
    rate cubed          -d omega^3                swing        a sin(2 pi f t) to the east
"""

from math import pi
from typing import final

import torch
from torch import Tensor

from nsde_torch.columns import columns, stack_columns
from nsde_torch.effects import Effect, Parameter, Port
from nsde_torch.effects.base import elapsed
from nsde_torch.effects.multirotor_forces import body_velocity

_OWN = "made for this benchmark"


class _Outside(Effect):
    source = _OWN
    null = {"size": 0.0}
    amplitudes = ("size",)


@final
class QuinticStiffness(_Outside):
    """A spring that hardens with the fifth power."""

    name, port, formula = "quintic_stiffness", Port.FORCE, "-k q^5"
    PARAMETERS = {"size": Parameter(0.0, "1/(m4 s2)", scale=1.0, help="k")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * x[:, :1] ** 5


@final
class Hysteresis(_Outside):
    """A force that remembers where the motion turned (Bouc and Wen)."""

    name, port, formula = "hysteresis", Port.FORCE, "-k m, s m' = v - (|v| m + v |m|) / 2"
    PARAMETERS = {
        "size": Parameter(0.0, "m/s2", scale=0.1, help="k"),
        "reach": Parameter(0.1, "m", low=0.0, help="s, way after which it has turned over"),
    }

    @property
    def n_memory(self) -> int:
        return 1

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * memory

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = x[:, 1:2]
        return (v - 0.5 * (v.abs() * memory + v * memory.abs())) / self.value("reach")

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(x[:, :1])


@final
class PlaceFriction(_Outside):
    """Viscous friction that grows away from the middle."""

    name, port, formula = "place_friction", Port.FORCE, "-b (q / L)^2 v"
    PARAMETERS = {
        "size": Parameter(0.0, "1/s", scale=0.1, help="b"),
        "length": Parameter(0.5, "m", low=0.0, help="L"),
    }

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        place = x[:, :1] / self.value("length")
        return -self.value("size") * place * place * x[:, 1:2]


@final
class Cogging(_Outside):
    """Teeth along the way."""

    name, port, formula = "cogging", Port.FORCE, "-c sin(2 pi q / p)"
    PARAMETERS = {
        "size": Parameter(0.0, "m/s2", scale=0.1, help="c"),
        "pitch": Parameter(0.1, "m", low=0.0, help="p"),
    }

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * torch.sin(2.0 * pi * x[:, :1] / self.value("pitch"))


@final
class CubicDamping(_Outside):
    """Friction with the cube of the speed."""

    name, port, formula = "cubic_damping", Port.FORCE, "-d v^3"
    PARAMETERS = {"size": Parameter(0.0, "s/m2", scale=0.1, help="d")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * x[:, 1:2] ** 3


class _Burst(_Outside):
    """A push at one moment of every run."""

    formula = "a exp(-((t - t0) / w)^2)"
    PARAMETERS = {
        "size": Parameter(0.0, "m/s2", scale=0.1, help="a"),
        "moment": Parameter(2.0, "s", help="t0"),
        "width": Parameter(0.3, "s", low=0.0, help="w"),
    }

    def push(self, t: float | Tensor, x: Tensor) -> Tensor:
        """The push (N, 1)."""
        late = (elapsed(t, x) - self.value("moment")) / self.value("width")
        return (self.value("size") * torch.exp(-late * late)).to(x.dtype).reshape(-1, 1).expand(len(x), 1)


@final
class Burst(_Burst):
    """A push at one moment of every run."""

    name, port = "burst", Port.FORCE

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.push(t, x)


@final
class GustBurst(_Burst):
    """A push to the east at one moment of every flight."""

    name, port, needs = "gust_burst", Port.WORLD_FORCE, (Port.BODY_MOMENT,)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return _east(self.push(t, x))


@final
class PoleMagnet(_Outside):
    """A magnet that holds the pole in four places."""

    name, port, systems = "pole_magnet", Port.TORQUE, ("cartpole",)
    formula = "-c sin(2 theta)"
    PARAMETERS = {"size": Parameter(0.0, "rad/s2", scale=0.1, help="c")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * torch.sin(2.0 * x[:, 2:3])


@final
class PoleDrag(_Outside):
    """Air drag of the pole."""

    name, port, systems = "pole_drag", Port.TORQUE, ("cartpole",)
    formula = "-d |theta'| theta'"
    PARAMETERS = {"size": Parameter(0.0, "1", scale=0.1, help="d")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        rate = x[:, 3:4]
        return -self.value("size") * rate.abs() * rate


@final
class CrossDrag(_Outside):
    """A force to the side of the way."""

    name, port, formula = "cross_drag", Port.BODY_FORCE, "d (-v_y, v_x, 0)"
    PARAMETERS = {"size": Parameter(0.0, "1/s", scale=0.1, help="d")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v_x, v_y, _ = columns(body_velocity(x))
        return self.value("size") * stack_columns((-v_y, v_x, torch.zeros_like(v_x)))


@final
class CubicDrag(_Outside):
    """Drag with the cube of the speed."""

    name, port, formula = "cubic_drag", Port.BODY_FORCE, "-d |v|^2 v"
    PARAMETERS = {"size": Parameter(0.0, "s/m2", scale=0.1, help="d")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = body_velocity(x)
        return -self.value("size") * (v * v).sum(1, keepdim=True) * v


@final
class Fan(_Outside):
    """A stream of air in one place of the room."""

    name, port, needs = "fan", Port.WORLD_FORCE, (Port.BODY_MOMENT,)
    formula = "a exp(-|p - p0|^2 / 2 r^2) to the east"
    PARAMETERS = {
        "size": Parameter(0.0, "m/s2", scale=0.1, help="a"),
        "place": Parameter((0.0, 0.0), "m", scale=1.0, help="p0, east and north"),
        "radius": Parameter(0.6, "m", low=0.0, help="r"),
    }

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        away = (x[:, :2] - self.value("place")) / self.value("radius")
        return _east(self.value("size") * torch.exp(-0.5 * (away * away).sum(1, keepdim=True)))


@final
class LiftWithSpeed(_Outside):
    """Rotors lift more in forward flight."""

    name, port, formula = "lift_with_speed", Port.BODY_FORCE, "T c (v_x^2 + v_y^2)"
    quantities = {"thrust": 1}
    PARAMETERS = {"size": Parameter(0.0, "s2/m2", scale=0.01, help="c")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = body_velocity(x)[:, :2]
        lift = self.value("size") * self.channel("thrust", u) * (v * v).sum(1, keepdim=True)
        return torch.cat((torch.zeros_like(lift), torch.zeros_like(lift), lift), 1)


@final
class RateCubed(_Outside):
    """A moment against the cube of each rate."""

    name, port, formula = "rate_cubed", Port.BODY_MOMENT, "-d omega^3"
    PARAMETERS = {"size": Parameter(0.0, "s", scale=0.1, help="d")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.value("size") * x[:, 10:13] ** 3


@final
class Swing(_Outside):
    """A load that swings to the east and back."""

    name, port, needs = "swing", Port.WORLD_FORCE, (Port.BODY_MOMENT,)
    formula = "a sin(2 pi f t) to the east"
    PARAMETERS = {
        "size": Parameter(0.0, "m/s2", scale=0.1, help="a"),
        "frequency": Parameter(0.7, "Hz", low=0.0, help="f"),
    }

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        angle = 2.0 * pi * self.value("frequency") * elapsed(t, x)
        push = (self.value("size") * torch.sin(angle)).to(x.dtype)
        return _east(push.reshape(-1, 1).expand(len(x), 1))


def _east(push: Tensor) -> Tensor:
    return torch.cat((push, torch.zeros_like(push), torch.zeros_like(push)), 1)


ON_FORCE = (QuinticStiffness, Hysteresis, PlaceFriction, Cogging, CubicDamping, Burst)
OUTSIDE: dict[str, tuple[type[Effect], ...]] = {
    "mass_spring_damper": ON_FORCE,
    "cartpole": (*ON_FORCE, PoleMagnet, PoleDrag),
    "hexacopter": (CrossDrag, CubicDrag, Fan, LiftWithSpeed, RateCubed, Swing, GustBurst),
}
