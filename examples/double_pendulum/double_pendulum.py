"""Two links in a row with a motor at each joint, q1 from hanging, q2 from the first link [rad]; motors in N m.

M(q) q'' + c(q, q') + g(q) = tau,   M = [[a + 2 b cos q2, d + b cos q2], [d + b cos q2, d]]
"""

import torch

from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.systems import Defaults, ResidualPort, System


class DoublePendulum(System):
    name = "double_pendulum"
    state_names, state_units = ("q1", "q2", "q1_dot", "q2_dot"), ("rad", "rad", "rad/s", "rad/s")
    input_names, input_units = ("tau1", "tau2"), ("N m", "N m")
    position_derivatives = (("q1", "q1_dot", "world"), ("q2", "q2_dot", "world"))
    ports = {Port.TORQUE: 2}
    coordinates = (
        Coordinate("q1", "q1_dot", Port.TORQUE, position="q1", row=0),
        Coordinate("q2", "q2_dot", Port.TORQUE, position="q2", row=1),
    )
    residual_ports = {Port.TORQUE: ResidualPort(2, 0.1, "N m")}
    defaults = Defaults(0.01, 25, (0.002, 0.002, 0.1, 0.1), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {
        **{k: Parameter(v, "kg m2", low=0.0) for k, v in {"a": 0.15, "b": 0.03, "d": 0.03}.items()},
        **{k: Parameter(2.0, "N m", low=0.0) for k in ("g1", "g2")},
    }

    def dynamics(self, t, x, u, forces):
        (q1, q2, w1, w2), (a, b, d) = x.unbind(1), (self.value(name) for name in "abd")
        push = u + forces[Port.TORQUE] if Port.TORQUE in forces else u
        spin, pull = b * torch.sin(q2), self.value("g2") * torch.sin(q1 + q2)
        r1 = push[:, 0] + spin * (2.0 * w1 + w2) * w2 - self.value("g1") * torch.sin(q1) - pull
        r2 = push[:, 1] - spin * w1 * w1 - pull
        m11, m12 = a + 2.0 * b * torch.cos(q2), d + b * torch.cos(q2)
        det = m11 * d - m12 * m12
        return torch.stack((w1, w2, (d * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det), 1)
