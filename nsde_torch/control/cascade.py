"""A cascade of proportional loops that flies a multirotor, as an autopilot in position mode does.

    a_sp = a_ref + kv (v_ref + kp (p_ref - p) - v) + integral     position and velocity -> acceleration
    q_sp : body z along a_sp + g, heading as wanted                acceleration -> attitude and thrust
    w_sp = ka * rotation vector from q to q_sp                                     attitude -> rates
    u    = pinv(mixing) (thrust, kw (w_sp - w) / gains), clipped                    rates -> motors

(Structure of PX4's multicopter controllers, docs.px4.io, "Controller diagrams".) It knows the declared
physics of the machine and nothing of lag, drag or gusts.
"""

from dataclasses import KW_ONLY, dataclass
from math import radians, tan
from typing import final

import torch
from torch import Tensor

from nsde_torch.control.reference import attitude_along
from nsde_torch.rotation import rotation_between
from nsde_torch.systems import Multirotor
from nsde_torch.systems.multirotor import GRAVITY

# gains along x, y, z, or of roll, pitch and yaw [1/s]
# velocity per position error, acceleration per velocity error
POSITION, VELOCITY = (0.8, 0.8, 1.5), (1.6, 1.6, 3.5)
INTEGRAL = (0.25, 0.25, 0.8)  # growth per velocity error [1/s2]
# rate per attitude error, angular acceleration per rate error
ATTITUDE, RATE = (6.0, 6.0, 2.5), (11.0, 11.0, 5.0)
TILT, INTEGRAL_LIMIT = radians(40.0), 2.0  # largest tilt [rad] and integral [m/s2]


@final
@dataclass(eq=False)
class Cascade:
    """Flies a batch of multirotors along what a pilot or a reference wants, in double precision."""

    system: Multirotor  # declared physics that the mixing and the hover thrust come from
    _: KW_ONLY
    dt: float  # sample [s]
    device: torch.device | str = "cpu"  # where the states are

    def __post_init__(self) -> None:
        def row(values: tuple[float, ...]) -> Tensor:
            return torch.tensor(values, dtype=torch.float64, device=self.device)

        self._kp, self._kv, self._ki = row(POSITION), row(VELOCITY), row(INTEGRAL)
        self._ka, self._kw = row(ATTITUDE), row(RATE)
        values = {k: float(v) for k, (v, _) in self.system.declared_parameters().items() if v.numel() == 1}
        self._offset = values["thrust_offset"]
        per_unit = row(tuple(values[f"{k}_gain"] for k in ("thrust", "roll", "pitch", "yaw")))
        mix = torch.tensor(self.system.mixing, dtype=torch.float64, device=self.device)
        self._allocation = torch.linalg.pinv(mix).T / per_unit[:, None]  # (4, nu): demands @ this = commands
        self._gravity = row((0.0, 0.0, GRAVITY))
        self._sum = row((0.0, 0.0, 0.0))

    def reset(self) -> None:
        self._sum = torch.zeros_like(self._gravity)

    def hover(self, batch: int) -> Tensor:
        """Commands that hold the machine level in still air, (B, nu)."""
        demand = self._kp.new_zeros(batch, 4)
        demand[:, 0] = GRAVITY - self._offset
        return demand @ self._allocation

    @torch.no_grad()
    def __call__(self, x: Tensor, p: Tensor, v: Tensor, a: Tensor, yaw: Tensor, yaw_rate: Tensor) -> Tensor:
        """Commands (B, nu) in [0, 1] of one sample.

        Args:
            x: Measured states (B, 13).
            p, v, a: Wanted positions [m], velocities [m/s] and accelerations [m/s2] (B, 3).
            yaw, yaw_rate: Wanted headings [rad] and their rates [rad/s] (B,).
        """
        error = v + self._kp * (p - x[:, :3]) - x[:, 3:6]
        self._sum = (self._sum + self._ki * self.dt * error).clamp(-INTEGRAL_LIMIT, INTEGRAL_LIMIT)
        force = a + self._kv * error + self._sum + self._gravity
        up = force[:, 2:].clamp_min(0.3 * GRAVITY)
        side = force[:, :2]
        size = torch.linalg.vector_norm(side, dim=1, keepdim=True)
        side = side * (up * tan(TILT) / size.clamp_min(1e-9)).clamp_max(1.0)
        force = torch.cat((side, up), 1)
        thrust = torch.linalg.vector_norm(force, dim=1, keepdim=True)
        rates = self._ka * rotation_between(x[:, 6:10], attitude_along(force / thrust, yaw))
        rates[:, 2] += yaw_rate
        moment = self._kw * (rates - x[:, 10:13])
        return (torch.cat((thrust - self._offset, moment), 1) @ self._allocation).clamp(0.0, 1.0)
