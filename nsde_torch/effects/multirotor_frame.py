"""The body axes of the log are not those of the machine: a flight controller that is mounted askew.

With R the turn from the machine's axes to the log's, the log has omega = R^T omega_m, and the attitude of its own axes.
Velocity and position are the world's. What the machine does, seen in the axes of the log:

    force_log = R^T T e_z          angular_log = R^T a_m,      a_m = gains * moments + c * (w_y w_z, w_z w_x, w_x w_y)

with the products of omega_m = R omega_log and c of the inertia (`systems.multirotor`).
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.columns import columns, stack_columns
from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.rotation import euler_coupling, matrix, rate_products, turned


@final
class FrameMisalignment(Effect):
    """The axes of the log are turned against those of the machine."""

    name = "frame_misalignment"
    port = Port.BODY_WRENCH
    quantities = {"thrust": 1, "angular_acceleration": 3, "inertia": 2}
    formula = "R^T (T e_z, a) - (T e_z, a), R = exp(turn)"
    source = "change of axes in Newton's and Euler's equations; mounting of the flight controller"
    PARAMETERS = {
        "turn": Parameter(
            (0.0, 0.0, 0.0), "rad", scale=0.02, help="rotation vector from the machine's axes to the log's"
        )
    }
    null = {"turn": 0.0}
    sentence = "The axes of the log are turned against those of the machine, by {turn} about x, y and z."
    separate = (
        "roll, pitch and yaw sharply, one axis at a time: turned axes show in the moments as in the thrust"
    )

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        thrust, omega = self.channel("thrust", u), x[:, 10:13]
        turn = self.value("turn").to(x)[None]
        level = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).to(x)
        r = matrix(turned(level, turn))[0]  # a row times r is turned back
        coupling = stack_columns(euler_coupling(*columns(self.channel("inertia", u))))
        seen = self.channel("angular_acceleration", u)
        own = seen + coupling * (rate_products(omega @ r.T) - rate_products(omega))
        up = torch.tensor([[0.0, 0.0, 1.0]]).to(x)
        return torch.cat((thrust * (up @ r - up), own @ r - seen), 1)
