"""Machines of one degree of freedom, q'' = gain u + what effects add; the mass on a spring among them.

Mass-spring-damper: m q'' = -b q' - k q + F (supplement B), divided by the mass, which cannot be identified too:
the parameters are k/m, b/m and 1/m.
"""

from collections.abc import Mapping
from math import pi
from typing import ClassVar

import torch
from torch import Tensor

from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.systems.base import System
from nsde_torch.systems.values import Defaults, ErrorGroup, ResidualPort


class OneDegreeOfFreedom(System):
    """A position, its rate and one input. A machine names its states, units and parameters; what brakes or pulls is an
    effect."""

    gain: ClassVar[str] = "force_gain"  # name of the parameter that the input is multiplied by
    ports = {Port.FORCE: 1}
    sensor_noise = True

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        acceleration = self.value(self.gain) * u
        if Port.FORCE in forces:
            acceleration = acceleration + forces[Port.FORCE]
        return torch.cat((x[:, 1:], acceleration), 1)


class MassSpringDamper(OneDegreeOfFreedom):
    """A mass on a spring with a damper and an optional force. `declared=[]` leaves q'' wholly to the network."""

    name = "mass_spring_damper"
    state_names = ("q", "q_dot")
    state_units = ("m", "m/s")
    input_names = ("force",)
    input_units = ("N",)
    declared = ("linear_spring", "viscous_friction")
    residual_ports = {Port.FORCE: ResidualPort(1, 0.1, "m/s2")}
    defaults = Defaults(0.01, 50, (0.001, 0.02), 0.05, 1.0, "euler_maruyama")
    error_groups = (ErrorGroup("position", (0,), "m"), ErrorGroup("velocity", (1,), "m/s"))
    optional_inputs = ("force",)
    over_mass = ("force_gain",)
    position_derivatives = (("q", "q_dot", "world"),)
    force_gain = Parameter(1.0, "1/kg", low=0.0, help="1 / mass")

    @property
    def physics_ports(self) -> set[Port]:
        """The force, unless spring and damper were taken out (`declared=[]`)."""
        return {effect.port for effect in self.effects}  # type: ignore[misc]


# Cart and pole, theta = 0 upright, a uniform pole of half-length l on a cart.
#
# With M the total and m the pole's mass (Barto, Sutton, Anderson 1983, as in the gym cartpole):
#
#     a      = (F + m l theta'^2 sin theta) / M
#     theta'' = (g sin theta - a cos theta) / (l (4/3 - m cos^2 theta / M))
#     x''     = a - m l theta'' cos theta / M
#
# Only 1/M, m/M and l can be identified from motion; these are the parameters. Forces on the port `force` add to a
# [m/s2]; on `torque`, a torque about the pivot over the pole's inertia about it, 4/3 m l^2, to g sin theta /
# (4/3 l) [rad/s2], so that a cart that is free to move gives way to it; on `world_force` (what pulls cart and
# pole alike, so that the pole does not turn) to x'' [m/s2].

GRAVITY = 9.8
_FRICTION = ("coulomb_friction", "viscous_friction")
_OF_THE_CART = (
    *(*_FRICTION, "asymmetric_friction", "stribeck_friction", "quadratic_damping"),
    *("linear_spring", "cubic_stiffness", "constant_force", "periodic_force"),
)


class Cartpole(System):
    """A pole on a cart that a force pushes; theta is 0 where it stands upright, and grows towards +x."""

    name = "cartpole"
    state_names = ("x", "x_dot", "theta", "theta_dot")
    state_units = ("m", "m/s", "rad", "rad/s")
    input_names = ("force",)
    input_units = ("N",)
    ports = {Port.FORCE: 1, Port.TORQUE: 1, Port.WORLD_FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 0.5, "m/s2"), Port.TORQUE: ResidualPort(1, 1.0, "rad/s2")}
    defaults = Defaults(0.02, 30, (0.001, 0.01, 0.005, 0.01), 0.05, 1.0, "euler_maruyama")
    error_groups = (
        ErrorGroup("position", (0,), "m"),
        ErrorGroup("velocity", (1,), "m/s"),
        ErrorGroup("attitude", (2,), "deg", 180.0 / pi),
        ErrorGroup("rate", (3,), "rad/s"),
    )
    feature_names = ("x_dot", "sin_theta", "cos_theta", "theta_dot")
    feature_units = ("m/s", "1", "1", "rad/s")
    places = (0,)
    sensor_noise = True
    over_mass = ("force_gain", "pole_share")
    position_derivatives = (("x", "x_dot", "world"), ("theta", "theta_dot", "world"))
    coordinates = (
        Coordinate("cart", "x_dot", Port.FORCE, position="x", kind="rail", words="the cart"),
        Coordinate("pole", "theta_dot", Port.TORQUE, position="theta", kind="axis", words="the pole"),
    )
    older_names = {
        **{f"{body}_{law}": f"{law}[{body}]" for body in ("cart", "pole") for law in _FRICTION},
        **{law: f"{law}[cart]" for law in _OF_THE_CART},
        "angle_bias": "position_bias[pole]",
    }
    force_gain = Parameter(0.9, "1/kg", low=0.0, help="1 / total mass")
    pole_share = Parameter(0.1, "1", low=0.0, high=0.95, help="pole mass over total mass")
    half_length = Parameter(0.5, "m", low=0.02, help="half the length of the pole")

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        x_dot, theta, theta_dot = x[:, 1:2], x[:, 2:3], x[:, 3:4]
        share, length = self.pole_share, self.half_length
        sin, cos = torch.sin(theta), torch.cos(theta)
        a = self.force_gain * u + share * length * theta_dot * theta_dot * sin
        if Port.FORCE in forces:
            a = a + forces[Port.FORCE]
        turning = (GRAVITY * sin - cos * a) / length
        if Port.TORQUE in forces:
            turning = turning + 4.0 / 3.0 * forces[Port.TORQUE]
        theta_acc = turning / (4.0 / 3.0 - share * cos * cos)
        x_acc = a - share * length * theta_acc * cos
        if Port.WORLD_FORCE in forces:
            x_acc = x_acc + forces[Port.WORLD_FORCE]
        return torch.cat((x_dot, x_acc, theta_dot, theta_acc), 1)

    def features(self, x: Tensor) -> Tensor:
        """Speeds and the direction of the pole: the physics does not change along the track."""
        return torch.cat((x[:, 1:2], torch.sin(x[:, 2:3]), torch.cos(x[:, 2:3]), x[:, 3:4]), 1)

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Differences, that of the angle the short way round."""
        d = predicted - measured
        angle = torch.remainder(d[..., 2:3] + pi, 2 * pi) - pi
        return torch.cat((d[..., :2], angle, d[..., 3:]), -1)
