"""Effects that are not in the catalogue: what a diagnosis has to call unexplained, or a lead at most.

On the spring and on the cart (q, v position and speed, over mass), on the pole, and on multirotors:

    quintic stiffness   -k q^5                    friction that depends on the place   -b (q / L)^2 v
    cogging             -c sin(2 pi q / p)        cubic damping       -d v^3
    burst               a exp(-((t - t0) / w)^2)
    pole: magnet        -c sin(2 theta)           air drag     -d |theta'| theta'
    cross drag          d (-v_y, v_x, 0)          fan          a exp(-|p - p0|^2 / 2 r^2) to the east
    cubic drag          -d |v|^2 v                lift with speed   T c (v_x^2 + v_y^2)
    rate cubed          -d omega^3                swing        a sin(2 pi f t) to the east
"""

from collections.abc import Callable
from functools import partial
from math import pi
from typing import Any

import torch
from torch import Tensor

from nsde_torch.columns import columns, stack_columns
from nsde_torch.effects import Effect, Parameter, Port
from nsde_torch.effects.base import elapsed
from nsde_torch.effects.multirotor_forces import body_velocity

Term = Callable[[Effect, Tensor, Any, Tensor, Tensor], Tensor]
"""What acts, of the effect, its size, time, states and inputs."""


class _Outside(Effect):
    source = "made for this benchmark"
    null = {"size": 0.0}
    amplitudes = ("size",)


def _effect(
    name: str, formula: str, unit: str, term: Term, *, scale: float = 0.1, shapes: Any = None, **more: Any
) -> type[Effect]:
    """A class of an effect of one size and some shapes."""

    def forward(self: Effect, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return term(self, self.value("size"), t, x, u)

    parameters = {"size": Parameter(0.0, unit, scale=scale, help="its size"), **(shapes or {})}
    own = {"name": name, "port": Port.FORCE, "formula": formula, "PARAMETERS": parameters, "forward": forward}
    return type(name.title().replace("_", ""), (_Outside,), {**own, **more, "__module__": __name__})


def _gust(e: Effect, a: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    return _east(_burst(e, a, t, x, u))


def _place_friction(e: Effect, b: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    place = x[:, :1] / e.value("length")
    return -b * place * place * x[:, 1:2]


def _cogging(e: Effect, c: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    return -c * torch.sin(2.0 * pi * x[:, :1] / e.value("pitch"))


def _burst(e: Effect, a: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    late = (elapsed(t, x) - e.value("moment")) / e.value("width")
    return (a * torch.exp(-late * late)).to(x.dtype).reshape(-1, 1).expand(len(x), 1)


def _cross_drag(e: Effect, d: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    v_x, v_y, _ = columns(body_velocity(x))
    return d * stack_columns((-v_y, v_x, torch.zeros_like(v_x)))


def _cubic_drag(e: Effect, d: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    v = body_velocity(x)
    return -d * (v * v).sum(1, keepdim=True) * v


def _fan(e: Effect, a: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    away = (x[:, :2] - e.value("place")) / e.value("radius")
    return _east(a * torch.exp(-0.5 * (away * away).sum(1, keepdim=True)))


def _lift(e: Effect, c: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    v = body_velocity(x)[:, :2]
    lift = c * e.channel("thrust", u) * (v * v).sum(1, keepdim=True)
    return torch.cat((torch.zeros_like(lift), torch.zeros_like(lift), lift), 1)


def _swing(e: Effect, a: Tensor, t: Any, x: Tensor, u: Tensor) -> Tensor:
    push = (a * torch.sin(2.0 * pi * e.value("frequency") * elapsed(t, x))).to(x.dtype)
    return _east(push.reshape(-1, 1).expand(len(x), 1))


def _east(push: Tensor) -> Tensor:
    return torch.cat((push, torch.zeros_like(push), torch.zeros_like(push)), 1)


_MOMENT = {"moment": Parameter(2.0, "s", help="t0"), "width": Parameter(0.3, "s", low=0.0, help="w")}
_SPOT = {
    "place": Parameter((0.0, 0.0), "m", scale=1.0, help="p0, east and north"),
    "radius": Parameter(0.6, "m", low=0.0, help="r"),
}
_LENGTH = {"length": Parameter(0.5, "m", low=0.0, help="L")}
_PITCH = {"pitch": Parameter(0.1, "m", low=0.0, help="p")}
_THRUST = {"thrust": 1}
_HERTZ = {"frequency": Parameter(0.7, "Hz", low=0.0, help="f")}
_on_pole = partial(_effect, port=Port.TORQUE, systems=("cartpole",))
_in_world = partial(_effect, port=Port.WORLD_FORCE, needs=(Port.BODY_MOMENT,))

QuinticStiffness = _effect(
    "quintic_stiffness", "-k q^5", "1/(m4 s2)", lambda e, k, t, x, u: -k * x[:, :1] ** 5, scale=1.0
)
PlaceFriction = _effect("place_friction", "-b (q / L)^2 v", "1/s", _place_friction, shapes=_LENGTH)
Cogging = _effect("cogging", "-c sin(2 pi q / p)", "m/s2", _cogging, shapes=_PITCH)
CubicDamping = _effect("cubic_damping", "-d v^3", "s/m2", lambda e, d, t, x, u: -d * x[:, 1:2] ** 3)
Burst = _effect("burst", "a exp(-((t - t0) / w)^2)", "m/s2", _burst, shapes=_MOMENT)
PoleMagnet = _on_pole(
    "pole_magnet", "-c sin(2 theta)", "rad/s2", lambda e, c, t, x, u: -c * torch.sin(2.0 * x[:, 2:3])
)
PoleDrag = _on_pole(
    "pole_drag", "-d |theta'| theta'", "1", lambda e, d, t, x, u: -d * x[:, 3:4].abs() * x[:, 3:4]
)
CrossDrag = _effect("cross_drag", "d (-v_y, v_x, 0)", "1/s", _cross_drag, port=Port.BODY_FORCE)
CubicDrag = _effect("cubic_drag", "-d |v|^2 v", "s/m2", _cubic_drag, port=Port.BODY_FORCE)
Fan = _in_world("fan", "a exp(-|p - p0|^2 / 2 r^2) to the east", "m/s2", _fan, shapes=_SPOT)
LiftWithSpeed = _effect(
    "lift_with_speed",
    "T c (v_x^2 + v_y^2)",
    "s2/m2",
    _lift,
    scale=0.01,
    port=Port.BODY_FORCE,
    quantities=_THRUST,
)
RateCubed = _effect(
    "rate_cubed", "-d omega^3", "s", lambda e, d, t, x, u: -d * x[:, 10:13] ** 3, port=Port.BODY_MOMENT
)
Swing = _in_world("swing", "a sin(2 pi f t) to the east", "m/s2", _swing, shapes=_HERTZ)
GustBurst = _in_world("gust_burst", "a exp(-((t - t0) / w)^2)", "m/s2", _gust, shapes=_MOMENT)
ON_FORCE = (QuinticStiffness, PlaceFriction, Cogging, CubicDamping, Burst)
OUTSIDE: dict[str, tuple[type[Effect], ...]] = {
    "mass_spring_damper": ON_FORCE,
    "cartpole": (*ON_FORCE, PoleMagnet, PoleDrag),
    "hexacopter": (CrossDrag, CubicDrag, Fan, LiftWithSpeed, RateCubed, Swing, GustBurst),
}
