"""Multirotors: rigid body with a learned thrust map and mixing constrained by geometry (supplement eq. 4).

World ENU, body FLU, q body to world. With the thrust shape s(u) = sum_k c_k u^k (c_1 = 1), motor by motor:

    p' = v
    v' = R(q) (thrust + force) + g,          thrust = thrust_gain * sum_i s(u_i) + thrust_offset   (body z)
    q' = q (0, omega) / 2
    omega' = gains * (mixing^T s(u)) + moment - J^-1 (omega x J omega)

Mass, inertia and mixer gains enter motion only as ratios, so ratios are the parameters: thrust over mass,
moment over inertia per unit of signed command, Jx / Jz and Jy / Jz. The signs of the mixing are the
geometry's, those of yaw the propellers'. The supplement leaves J^-1 off the last term; here it is in place
(Euler's equation).
"""

from collections.abc import Mapping, Sequence
from math import pi
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch import rotation
from nsde_torch.columns import few, join_columns, split_columns
from nsde_torch.effects import Effect, Parameter, Port
from nsde_torch.effects.multirotor_forces import GRAVITY as GRAVITY
from nsde_torch.errors import ConfigError
from nsde_torch.systems.base import System
from nsde_torch.systems.values import Defaults, ErrorGroup, ResidualPort, Values

_DEGREES = 180.0 / pi
_PARTS = (3, 3, 4, 3)  # position, velocity, quaternion, rates
_STILL = 1e-6
"""Share of the full thrust below which a rotor stands still: the slope of a root has no end there."""


class Multirotor(System):
    """Common part of all multirotors; a geometry says how many motors there are and where.

    Args:
        effects, declared, values: See `System`.
        thrust_degree: Degree of the thrust map in the command, 1 to 3.
        yaw_direction: 1: propellers turn as those of PX4's frame; -1: each the other way.
    """

    mixing: ClassVar[tuple[tuple[float, ...], ...]]
    """Signs and relative arms, rows thrust (all ones), roll, pitch, yaw; one column per motor."""
    state_names = (
        *("p_x", "p_y", "p_z", "v_x", "v_y", "v_z"),
        *("q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z"),
    )
    state_units = (*("m",) * 3, *("m/s",) * 3, *("1",) * 4, *("rad/s",) * 3)
    ports = {Port.BODY_FORCE: 3, Port.WORLD_FORCE: 3, Port.BODY_MOMENT: 3, Port.BODY_WRENCH: 6}
    # thrust over mass [m/s2]; commands summed by sense of rotation (the yaw signs) [1]; angular acceleration without
    # effects [rad/s2]; Jx / Jz and Jy / Jz
    quantities = {"thrust": 1, "spin": 1, "angular_acceleration": 3, "inertia": 2}
    residual_ports = {
        Port.BODY_FORCE: ResidualPort(3, 1.0, "m/s2"),
        Port.BODY_MOMENT: ResidualPort(3, 10.0, "rad/s2"),
    }
    # supplement D: step, horizon, sigma_max; r and the weight of mu as stated there
    defaults = Defaults(
        0.05, 20, (*(1e-3,) * 3, *(1e-2,) * 3, *(1e-3,) * 4, *(5e-2,) * 3), 0.1, 1.0, "milstein"
    )
    error_names = (
        *("p_x", "p_y", "p_z", "v_x", "v_y", "v_z"),
        *("r_x", "r_y", "r_z", "w_x", "w_y", "w_z"),
    )
    error_groups = (
        ErrorGroup("position", (0, 1, 2), "m"),
        ErrorGroup("velocity", (3, 4, 5), "m/s"),
        ErrorGroup("attitude", (6, 7, 8), "deg", _DEGREES),
        ErrorGroup("rate", (9, 10, 11), "rad/s"),
    )
    feature_names = ("v_body_x", "v_body_y", "v_body_z", "w_x", "w_y", "w_z")
    feature_units = (*("m/s",) * 3, *("rad/s",) * 3)
    residual_names = (*feature_names, "up_x", "up_y")
    places = (2,)  # the height
    quaternion = slice(6, 10)
    over_mass = ("thrust_gain", "thrust_offset")
    disturbed_ports = (Port.BODY_FORCE, Port.BODY_MOMENT)
    position_derivatives = (("p_x", "v_x", "world"), ("p_y", "v_y", "world"), ("p_z", "v_z", "world"))
    thrust_gain = Parameter(4.5, "m/s2", low=0.0, help="thrust over mass per unit of summed command")
    thrust_offset = Parameter(0.0, "m/s2", scale=1.0, help="thrust over mass at zero command")
    roll_gain = Parameter(50.0, "rad/s2", low=0.0, help="roll moment over Jx per unit of signed command")
    pitch_gain = Parameter(50.0, "rad/s2", low=0.0, help="pitch moment over Jy per unit")
    yaw_gain = Parameter(8.0, "rad/s2", low=0.0, help="yaw moment over Jz per unit")
    inertia_x = Parameter(0.7, "1", low=0.3, high=1.5, help="Jx / Jz")
    inertia_y = Parameter(0.7, "1", low=0.3, high=1.5, help="Jy / Jz")

    def __init__(
        self,
        effects: Sequence[str | Effect] = (),
        *,
        declared: Sequence[str] | None = None,
        values: Values | None = None,
        thrust_degree: int = 1,
        yaw_direction: int = 1,
    ) -> None:
        if yaw_direction not in (1, -1):
            raise ConfigError(f"`yaw_direction` must be 1 or -1; got {yaw_direction!r}.")
        if yaw_direction < 0:
            *others, yaw = self.mixing
            self.mixing = (*others, tuple(-sign for sign in yaw))  # type: ignore[misc]
        if thrust_degree not in (1, 2, 3):
            raise ConfigError(f"`thrust_degree` must be 1, 2 or 3; got {thrust_degree!r}.")
        if thrust_degree > 1:
            curve = Parameter((0.0,) * (thrust_degree - 1), "1", scale=0.5, help="c_2, c_3 of the thrust map")
            self.PARAMETERS = {**self.PARAMETERS, "thrust_curve": curve}  # type: ignore[misc]
        super().__init__(effects, declared=declared, values=values)
        self.thrust_degree, self.yaw_direction = thrust_degree, yaw_direction
        self.mix: Tensor
        self.gravity: Tensor
        self.register_buffer("mix", torch.tensor(self.mixing).T.contiguous(), persistent=False)
        self.register_buffer("gravity", torch.tensor([0.0, 0.0, -GRAVITY]), persistent=False)

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        _, v, q, omega = split_columns(x, *_PARTS)
        thrust, moments = self._thrust_and_moments(u)
        angular = self._angular(omega, moments)
        acceleration = thrust * rotation.axis_up(q) + self.gravity
        if Port.BODY_FORCE in forces:
            acceleration = acceleration + rotation.rotate(q, forces[Port.BODY_FORCE])
        if Port.BODY_MOMENT in forces:
            angular = angular + forces[Port.BODY_MOMENT]
        if Port.BODY_WRENCH in forces:
            push, twist = split_columns(forces[Port.BODY_WRENCH], 3, 3)
            acceleration, angular = acceleration + rotation.rotate(q, push), angular + twist
        if Port.WORLD_FORCE in forces:
            acceleration = acceleration + forces[Port.WORLD_FORCE]
        return join_columns((v, acceleration, rotation.quaternion_rate(q, omega), angular))

    def quantity(self, name: str, x: Tensor, u: Tensor) -> Tensor:
        if name == "spin":  # speeds of rotors go with the roots of their thrusts
            return (torch.sqrt(self._thrusts(u).clamp_min(_STILL)) * self.mix[:, 3]).sum(1, keepdim=True)
        if name == "inertia":
            return torch.cat((self.inertia_x, self.inertia_y)).expand(len(x), 2)
        thrust, moments = self._thrust_and_moments(u)
        return thrust if name == "thrust" else self._angular(x[:, 10:13], moments)

    def _thrusts(self, u: Tensor) -> Tensor:
        """What each motor makes of its command (N, nu), as a share of its thrust at full command."""
        if self.thrust_degree > 1:
            curve = self.value("thrust_curve")
            u = u + sum(curve[k] * u ** (k + 2) for k in range(self.thrust_degree - 1))
        return u

    def _thrust_and_moments(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Thrust over mass (N, 1) and mixed commands of roll, pitch and yaw (N, 3)."""
        u = self._thrusts(u)
        collective, moments = split_columns(u @ self.mix if few() else (self.mix.T @ u.T).T, 1, 3)
        return self.thrust_gain * collective + self.thrust_offset, moments

    def _angular(self, omega: Tensor, moments: Tensor) -> Tensor:
        """Angular acceleration (N, 3) under mixed commands, without effects."""
        gains = _of_axes(self.roll_gain, self.pitch_gain, self.yaw_gain)
        coupling = _of_axes(*rotation.euler_coupling(self.inertia_x, self.inertia_y))
        return gains * moments + coupling * rotation.rate_products(omega)

    def features(self, x: Tensor) -> Tensor:
        """Body velocity and body rates, the supplement's x_feat seen from the body."""
        _, v, q, omega = split_columns(x, *_PARTS)
        return join_columns((rotation.rotate_back(q, v), omega))

    def residual_features(self, x: Tensor) -> Tensor:
        """Body velocity, body rates and the direction of gravity (x and y of world's up in the body)."""
        _, v, q, omega = split_columns(x, *_PARTS)
        up_x, up_y, _ = split_columns(rotation.gravity_direction(q), 1, 1, 1)
        return join_columns((rotation.rotate_back(q, v), omega, up_x, up_y))

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Position, velocity, rotation vector from measured to predicted attitude [rad], rates."""
        (p, v, q, omega), (at, speed, attitude, rates) = (
            split_columns(x, *_PARTS) for x in torch.broadcast_tensors(predicted, measured)
        )
        return join_columns((p - at, v - speed, rotation.rotation_between(attitude, q), omega - rates))

    def project(self, z: Tensor) -> Tensor:
        """Quaternion back on the unit sphere."""
        before, q, after = split_columns(z, 6, 4, z.shape[1] - 10)
        return join_columns((before, q * torch.rsqrt((q * q).sum(1, keepdim=True)), after))

    def start_values(
        self, x: NDArray[np.float64], u: NDArray[np.float64], dt: float
    ) -> dict[str, list[float]]:
        """Gains by least squares on finite differences; a gain that the data cannot show keeps its default."""
        if len(x) < 20:
            return {}
        u = u[:, : self.nu]
        mixed = u @ np.asarray(self.mixing).T
        q = torch.tensor(x[:, 6:10])  # a copy: the arrays of a run are read-only
        acc = np.gradient(x[:, 3:6], dt, axis=0) + np.array([0.0, 0.0, GRAVITY])
        force = rotation.rotate_back(q, torch.as_tensor(acc)).numpy()
        out: dict[str, list[float]] = {}
        columns = np.stack((mixed[:, 0], np.ones(len(x))), 1)
        if mixed[:, 0].std() > 1e-3:
            gain, offset = np.linalg.lstsq(columns, force[:, 2], rcond=None)[0]
            if gain > 0.1 * force[:, 2].mean() / max(mixed[:, 0].mean(), 1e-6):
                out |= {"thrust_gain": [float(gain)], "thrust_offset": [float(offset)]}
            else:  # hardly excited: hover gives the ratio
                out["thrust_gain"] = [float(max(force[:, 2].mean() / max(mixed[:, 0].mean(), 1e-6), 0.1))]
        angular = np.gradient(x[:, 10:13], dt, axis=0)
        for axis, name in enumerate(("roll_gain", "pitch_gain", "yaw_gain")):
            m = mixed[:, 1 + axis]
            if m.std() < 1e-4:
                continue
            columns = np.stack((m, x[:, 10 + axis], np.ones(len(x))), 1)
            gain = float(np.linalg.lstsq(columns, angular[:, axis], rcond=None)[0][0])
            if gain > 0.05:
                out[name] = [gain]
        return out


class Hexacopter(Multirotor):
    """Hexacopter, PX4's hexa-x: 1 right, 2 left, 3 front-left, 4 rear-right, 5 front-right, 6 rear-left."""

    name = "hexacopter"
    input_names = tuple(f"u_{i}" for i in range(1, 7))
    input_units = ("1",) * 6
    mixing = (
        (1.0,) * 6,
        (-1.0, 1.0, 0.5, -0.5, -0.5, 0.5),
        (0.0, 0.0, -0.866, 0.866, -0.866, 0.866),
        (1.0, -1.0, 1.0, -1.0, -1.0, 1.0),
    )


class Quadrotor(Multirotor):
    """Quadrotor, PX4's quad-x: 1 front-right, 2 rear-left, 3 front-left, 4 rear-right."""

    name = "quadrotor"
    input_names = tuple(f"u_{i}" for i in range(1, 5))
    input_units = ("1",) * 4
    mixing = (
        (1.0,) * 4,
        (-1.0, 1.0, 1.0, -1.0),
        (-1.0, 1.0, -1.0, 1.0),
        (-1.0, -1.0, 1.0, 1.0),
    )


def _of_axes(*values: Tensor) -> Tensor:
    """Values of axes (1,) side by side (n,); of those that differ between rows (N, 1), rows of them (N, n)."""
    rows = next((len(v) for v in values if v.dim() == 2), None)
    return torch.cat(values) if rows is None else torch.cat([v.expand(rows, 1) for v in values], 1)
