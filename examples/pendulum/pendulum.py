"""A pendulum with a motor at its axis: a machine of one's own, outside the package.

    theta'' = -(g / l) sin theta - c theta' + k tau

theta = 0 hangs down [rad], tau is the torque of the motor [N m]. Mass and length cannot be told from motion
alone: the parameters are g/l [1/s2], c = damping over inertia [1/s] and k = 1 / inertia [1/(kg m2)].
"""

from collections.abc import Mapping
from math import pi
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, ErrorGroup, ResidualPort, System


@final
class Pendulum(System):
    """A rigid pendulum that a torque drives."""

    # What the columns of the data are called; the CSV files need `t` and these.
    name = "pendulum"
    state_names = ("theta", "theta_dot")
    state_units = ("rad", "rad/s")
    input_names = ("torque",)
    input_units = ("N m",)

    # Kinematics that hold whatever pushes: they reveal a wrong clock or a gap in the data.
    position_derivatives = (("theta", "theta_dot", "world"),)

    # Where something unknown may push: one small network adds to theta''. `scale` is a typical size of it.
    ports = {Port.TORQUE: 1}
    residual_ports = {Port.TORQUE: ResidualPort(1, 1.0, "rad/s2")}
    sensor_noise = True

    # Step [s], steps of a training window, largest diffusion of each state [unit/s^0.5] (for loss=paper),
    # radius of the ball of the convexity loss, weight of the reward on strong convexity, integrator.
    defaults = Defaults(0.02, 25, (0.002, 0.1), 0.1, 1.0, "euler_maruyama")

    # What is fitted: first value, unit, bounds.
    PARAMETERS = {
        "gravity": Parameter(15.0, "1/s2", low=0.0, help="g / l"),
        "damping": Parameter(0.2, "1/s", low=0.0, help="damping over inertia"),
        "torque_gain": Parameter(5.0, "1/(kg m2)", low=0.0, help="1 / inertia"),
    }

    # How errors are reported.
    error_names = state_names
    error_groups = (
        ErrorGroup("attitude", (0,), "deg", 180.0 / pi),
        ErrorGroup("rate", (1,), "rad/s"),
    )

    # What eta, the distance from the training data, is a function of.
    feature_names = ("sin_theta", "cos_theta", "theta_dot")
    feature_units = ("1", "1", "rad/s")

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        """Rate (N, 2) of the states (N, 2) under the torque (N, 1) [N m]; `forces` are further terms."""
        theta, rate = x[:, :1], x[:, 1:]
        acceleration = (
            -self.value("gravity") * torch.sin(theta)
            - self.value("damping") * rate
            + self.value("torque_gain") * u
        )
        if Port.TORQUE in forces:
            acceleration = acceleration + forces[Port.TORQUE]
        return torch.cat((rate, acceleration), 1)

    def features(self, x: Tensor) -> Tensor:
        """Direction and rate (N, 3): a full turn changes nothing."""
        return torch.cat((torch.sin(x[:, :1]), torch.cos(x[:, :1]), x[:, 1:]), 1)

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Predicted minus measured (..., 2), the angle the short way round."""
        angle, rate = (predicted - measured).split(1, -1)
        return torch.cat((torch.remainder(angle + pi, 2 * pi) - pi, rate), -1)
