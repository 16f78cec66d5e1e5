"""Moments on multirotors over inertia [rad/s2], body axes; T is the thrust over mass of the declared physics.

Blade flapping and rotor gyroscopics: Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE Robotics and Automation
Magazine 19 (2012).
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.columns import columns, stack_columns
from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.effects.multirotor_drag import body_velocity

TUTORIAL = "Mahony, Kumar, Corke, IEEE Robotics and Automation Magazine 19 (2012)"


@final
class AngularDamping(Effect):
    """A moment against the body rates."""

    name = "angular_damping"
    port = Port.BODY_MOMENT
    formula = "-d * omega"
    source = "blade flapping and inflow, first order in the rates"
    PARAMETERS = {"damping": Parameter((0.1, 0.1, 0.1), "1/s", low=0.0, help="damping over inertia, x y z")}
    null = {"damping": 0.0}
    amplitudes = ("damping",)
    sentence = "Turning is braked in proportion to its rate: {damping} in roll, pitch and yaw."
    separate = "turn at several rates about each axis"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("damping") * x[:, 10:13]


@final
class ComOffset(Effect):
    """The centre of mass lies off the axis of the thrust, which then turns the machine."""

    name = "com_offset"
    port = Port.BODY_MOMENT
    quantities = {"thrust": 1}
    formula = "T (-o_y, o_x, 0), o = c m / J"
    source = "moment -c x F of the thrust about a centre of mass at c"
    PARAMETERS = {
        "offset": Parameter(
            (0.0, 0.0), "1/m", scale=0.1, help="offset forward and left, times mass over inertia"
        )
    }
    null = {"offset": 0.0}
    amplitudes = ("offset",)
    sentence = "The centre of mass is off the middle of the rotors: {offset} forward and left, times mass over inertia."
    separate = "climb and sink: the moment of an offset follows the thrust, that of a weak motor its command"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        o_x, o_y = self.value("offset").unbind(0)
        thrust = self.channel("thrust", u)[:, 0]
        return stack_columns((-o_y * thrust, o_x * thrust, torch.zeros_like(thrust)))


@final
class GyroscopicMoment(Effect):
    """Spinning rotors resist a change of their axis; what they carry together is what the yaw commands leave over."""

    name = "gyroscopic_moment"
    port = Port.BODY_MOMENT
    quantities = {"spin": 1}
    formula = "h S (omega_y, -omega_x, 0), S = sum of signed u_i"
    source = TUTORIAL + "; rotor speed in proportion to its command"
    PARAMETERS = {
        "momentum": Parameter(
            1.0, "1/s", low=0.0, help="angular momentum of a rotor at full command over the machine's inertia"
        )
    }
    null = {"momentum": 0.0}
    amplitudes = ("momentum",)
    sentence = "The spinning rotors act as a gyroscope of {momentum}."
    separate = "roll and pitch fast while turning in yaw both ways"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        wx, wy, _ = columns(x[:, 10:13])
        size = self.value("momentum") * self.channel("spin", u)[:, 0]
        return stack_columns((size * wy, -size * wx, torch.zeros_like(wx)))


@final
class FlappingMoment(Effect):
    """Blades that flap in the wind of flight tilt the machine away from where it goes."""

    name = "flapping_moment"
    port = Port.BODY_MOMENT
    formula = "(f_x v_y, -f_y v_x, 0)"
    source = TUTORIAL
    PARAMETERS = {
        "gain": Parameter(
            (0.0, 0.0), "rad/(m s)", scale=0.1, help="moment over inertia per body velocity, roll and pitch"
        )
    }
    null = {"gain": 0.0}
    amplitudes = ("gain",)
    sentence = "Flight through the air turns the machine against its motion: {gain} in roll and pitch."
    separate = "fly at two more speeds with the same attitude, forwards and sideways"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        v_x, v_y, _ = columns(body_velocity(x))
        f_x, f_y = self.value("gain").unbind(0)
        return stack_columns((f_x * v_y, -f_y * v_x, torch.zeros_like(v_x)))


@final
class InertiaCoupling(Effect):
    """Products of inertia: the principal axes are not the body axes of the log.

    With J = D + P, D the diagonal, P symmetric with zeros on it, to first order in P:

        J^-1 (M - omega x J omega) = a - D^-1 (P a + omega x P omega),     a = D^-1 (M - omega x D omega)
    """

    name = "inertia_coupling"
    port = Port.BODY_MOMENT
    quantities = {"angular_acceleration": 3, "inertia": 2}
    formula = "-D^-1 (P a + omega x P omega), P off the diagonal of J / Jz"
    source = "Euler's equation of a rigid body with products of inertia, to first order in them"
    PARAMETERS = {
        "product": Parameter(
            (0.0, 0.0, 0.0), "1", scale=0.05, help="J_xy, J_xz, J_yz over J_zz (elements of J)"
        )
    }
    null = {"product": 0.0}
    amplitudes = ("product",)
    sentence = "The masses lie askew to the axes of the log: J_xy, J_xz, J_yz are {product} of J_zz."
    separate = "roll, pitch and yaw sharply, one axis at a time"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        xy, xz, yz = self.value("product").unbind(0)
        ax, ay, az = columns(self.channel("angular_acceleration", u))
        jx, jy = columns(self.channel("inertia", u))
        wx, wy, wz = columns(x[:, 10:13])
        px, py, pz = xy * wy + xz * wz, xy * wx + yz * wz, xz * wx + yz * wy  # P omega
        return stack_columns(
            (
                -(xy * ay + xz * az + wy * pz - wz * py) / jx,
                -(xy * ax + yz * az + wz * px - wx * pz) / jy,
                -(xz * ax + yz * ay + wx * py - wy * px),
            )
        )
