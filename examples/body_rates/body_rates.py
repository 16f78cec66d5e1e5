"""The rates of a quadrotor under its motors: what a log without attitude and position can show.

    J w' = G mix(u) - w x J w - d w          u: motor commands in [0, 1], PX4's order; w [rad/s], FLU

Gains are moments over inertia [rad/s2], of roll, pitch and yaw. The yaw gain may be negative: propellers that all turn
the other way round. Of the inertia, motion shows (Jy - Jz) / Jx and so on.
"""

from collections.abc import Mapping
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, ErrorGroup, ResidualPort, System


@final
class BodyRates(System):
    """A quadrotor that is known by its gyroscope."""

    name = "body_rates"
    state_names = ("w_x", "w_y", "w_z")
    state_units = ("rad/s",) * 3
    input_names = ("u_1", "u_2", "u_3", "u_4")
    input_units = ("1",) * 4
    ports = {Port.TORQUE: 3}
    residual_ports = {Port.TORQUE: ResidualPort(3, 10.0, "rad/s2")}
    sensor_noise = True
    defaults = Defaults(0.01, 25, (0.5, 0.5, 0.5), 0.1, 1.0, "euler_maruyama")
    PARAMETERS = {
        "roll_gain": Parameter(
            100.0, "rad/s2", low=0.0, help="roll moment over Jx per unit of signed command"
        ),
        "pitch_gain": Parameter(100.0, "rad/s2", low=0.0, help="pitch moment over Jy per unit"),
        "yaw_gain": Parameter(
            10.0, "rad/s2", help="yaw moment over Jz per unit; negative: propellers the other way"
        ),
        "coupling": Parameter(
            (0.0, 0.0, 0.0), "1", scale=0.5, help="(Jy - Jz) / Jx, (Jz - Jx) / Jy, (Jx - Jy) / Jz"
        ),
        "damping": Parameter((1.0, 1.0, 1.0), "1/s", low=0.0, help="damping over inertia"),
    }
    error_names = state_names
    error_groups = (ErrorGroup("rate", (0, 1, 2), "rad/s"),)
    feature_names = state_names
    feature_units = state_units

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        """Rate (N, 3) of the states (N, 3) under motor commands (N, 4); `forces` are further terms."""
        signs = u.new_tensor([[-1.0, 1, 1, -1], [-1, 1, -1, 1], [-1, -1, 1, 1]])
        gains = torch.cat((self.value("roll_gain"), self.value("pitch_gain"), self.value("yaw_gain")))
        turn = (u @ signs.T) * gains - self.value("damping") * x
        turn = turn + self.value("coupling") * x[:, [1, 2, 0]] * x[:, [2, 0, 1]]
        return turn + forces[Port.TORQUE] if Port.TORQUE in forces else turn

    def features(self, x: Tensor) -> Tensor:
        """The rates themselves (N, 3)."""
        return x

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Predicted minus measured (..., 3)."""
        return predicted - measured
