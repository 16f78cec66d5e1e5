"""Drag of multirotors: forces over mass [m/s2] in the FLU body frame, from the velocity v_body = R(q)^T v."""

from typing import final

import torch
from torch import Tensor

from nsde_torch.columns import split_columns
from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.rotation import rotate_back

TWO_SPEEDS = "fly at two more speeds, in several directions"


def body_velocity(x: Tensor) -> Tensor:
    """Velocity in the body frame (N, 3) [m/s] of multirotor states (N, 13)."""
    _, v, q, _ = split_columns(x, 3, 3, 4, 3)
    return rotate_back(q, v)


@final
class LinearDrag(Effect):
    """Rotor drag: in proportion to body velocity, one coefficient per axis."""

    name = "linear_drag"
    port = Port.BODY_FORCE
    formula = "-d * v_body"
    source = "Faessler, Franchi, Scaramuzza, IEEE RA-L 3 (2018)"
    PARAMETERS = {"drag": Parameter((0.1, 0.1, 0.1), "1/s", low=0.0, help="drag over mass, body x y z")}
    along = "speed"
    null = {"drag": 0.0}
    amplitudes = ("drag",)
    sentence = "The air brakes in proportion to the speed: rotor drag of {drag} along forward, left and up."
    separate = TWO_SPEEDS

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("drag") * body_velocity(x)


@final
class QuadraticDrag(Effect):
    """Body drag: in proportion to speed times body velocity."""

    name = "quadratic_drag"
    port = Port.BODY_FORCE
    formula = "-d * |v| v_body"
    source = "aerodynamic drag of a bluff body"
    PARAMETERS = {"drag": Parameter((0.02, 0.02, 0.02), "1/m", low=0.0, help="drag over mass, body x y z")}
    along = "speed"
    null = {"drag": 0.0}
    amplitudes = ("drag",)
    sentence = "The air brakes with the square of the speed: {drag} along forward, left and up."
    separate = TWO_SPEEDS

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        v = body_velocity(x)
        return -self.value("drag") * v * torch.sqrt((v * v).sum(1, keepdim=True) + 1e-12)


@final
class ConstantWind(Effect):
    """Rotor drag in air that moves: in proportion to the velocity relative to the air."""

    name = "constant_wind"
    port = Port.BODY_FORCE
    formula = "-d * R^T (v - w)"
    source = "Tomic, Schmid, Lutz, Mathers, Haddadin, IROS (2016): drag on the velocity relative to the air"
    PARAMETERS = {
        "drag": Parameter((0.1, 0.1, 0.1), "1/s", low=0.0, help="drag over mass, body x y z"),
        "wind": Parameter((0.0, 0.0), "m/s", scale=1.0, help="velocity of the air, east and north"),
    }
    null = {"drag": 0.0}
    amplitudes = ("drag",)
    shapes = {"wind": ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0))}
    smooth = ("wind",)
    includes = ("linear_drag",)
    sentence = "The air moves with {wind} to east and north and drags with {drag} along forward, left and up."
    separate = "fly the same path twice, the second time turned by a quarter"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        wind = self.value("wind")
        air = torch.cat((wind, torch.zeros_like(wind[:1])))
        return -self.value("drag") * rotate_back(x[:, 6:10], x[:, 3:6] - air)
