"""Two joints, each with a motor of its own, whose columns lie in an order of their own."""

from collections.abc import Mapping

import torch
from torch import Tensor

from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System


class TwoJoints(System):
    """Velocities come first, joints in the order second, first; the port is in N m."""

    name = "two_joints"
    state_names = ("w2", "w1", "q2", "q1")
    state_units = ("rad/s", "rad/s", "rad", "rad")
    input_names = ("tau1", "tau2")
    input_units = ("N m", "N m")
    position_derivatives = (("q1", "w1", "world"), ("q2", "w2", "world"))
    ports = {Port.TORQUE: 2}
    coordinates = (
        Coordinate("q1", "w1", Port.TORQUE, position="q1", row=0, load="load"),
        Coordinate("q2", "w2", Port.TORQUE, position="q2", row=1),
    )
    residual_ports = {Port.TORQUE: ResidualPort(2, 0.1, "N m")}
    defaults = Defaults(0.01, 20, (0.1, 0.1, 0.01, 0.01), 0.1, 1.0, "euler_maruyama")
    quantities = {"load": 1}
    sensor_noise = True
    PARAMETERS = {"inertia": Parameter((0.5, 0.2), "kg m2", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        acceleration = (u + forces.get(Port.TORQUE, 0.0)) / self.value("inertia")
        return torch.cat((acceleration[:, 1:], acceleration[:, :1], x[:, :2]), 1)

    def quantity(self, name: str, x: Tensor, u: Tensor) -> Tensor:
        """The load of the first joint: it grows with what the second pulls."""
        return 2.0 + u[:, 1:2]


HOME = "tests.helpers.two_joints:TwoJoints"
