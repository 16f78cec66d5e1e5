"""Effects of multirotors: FLU body frame, forces over mass [m/s2], moments over inertia [rad/s2]."""

from collections.abc import Mapping
from typing import final

import torch
from torch import Tensor

from nsde_torch.columns import split_columns
from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.rotation import rotate_back


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

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        v = body_velocity(x)
        return -self.value("drag") * v * torch.sqrt((v * v).sum(1, keepdim=True) + 1e-12)


@final
class AngularDamping(Effect):
    """A moment against the body rates."""

    name = "angular_damping"
    port = Port.BODY_MOMENT
    formula = "-d * omega"
    source = "blade flapping and inflow, first order in the rates"
    PARAMETERS = {"damping": Parameter((0.1, 0.1, 0.1), "1/s", low=0.0, help="damping over inertia, x y z")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("damping") * x[:, 10:13]


@final
class MotorLag(Effect):
    """Motors follow their command with a first-order lag; each carries one state."""

    name = "motor_lag"
    port = Port.INPUT
    formula = "u_eff = m, dm/dt = (u - m) / tau"
    source = "first-order motor and ESC dynamics"
    systems = ("hexacopter", "quadrotor")
    PARAMETERS = {"time_constant": Parameter(0.05, "s", low=0.002, help="time to reach 63 %")}

    def __init__(self, values: Mapping[str, float | list[float]] | None = None, *, n_inputs: int = 6) -> None:
        super().__init__(values)
        self._n_memory = n_inputs

    @property
    def n_memory(self) -> int:
        """One state per motor."""
        return self._n_memory

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return memory - u[:, : self._n_memory]

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.memory_rate`."""
        return (u[:, : self._n_memory] - memory) / self.value("time_constant")

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`."""
        return u[:, : self._n_memory]
