"""Machines whose positions follow from their velocities: what carries them along without a velocity saying so."""

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.errors import ConfigError
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.machines import Array, held, simulated

DT, DRAG, TURN = 0.1, (0.3, 0.8), 0.4
CURRENT = (0.12, -0.2)


class Boat(System):
    """A boat that is pushed and turned, its velocities through the water."""

    name = "boat"
    state_names, state_units = ("x", "y", "psi", "u", "r"), ("m", "m", "rad", "m/s", "rad/s")
    input_names, input_units = ("thrust", "rudder"), ("1", "rad")
    position_derivatives = (("psi", "r", "world"),)
    ports = {Port.FORCE: 1, Port.TORQUE: 1}
    coordinates = (
        Coordinate("surge", "u", Port.FORCE, kind="rail"),
        Coordinate("yaw", "r", Port.TORQUE, position="psi", kind="axis"),
    )
    residual_ports = {Port.FORCE: ResidualPort(1, 0.1, "m/s2"), Port.TORQUE: ResidualPort(1, 0.1, "rad/s2")}
    defaults = Defaults(DT, 20, (0.02, 0.02, 0.01, 0.02, 0.02), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {
        "surge_drag": Parameter(DRAG[0], "1/s", low=0.0),
        "yaw_drag": Parameter(DRAG[1], "1/s", low=0.0),
        "turn": Parameter(TURN, "1/s2"),
    }

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        psi, speed, rate = x[:, 2:3], x[:, 3:4], x[:, 4:5]
        along = u[:, :1] - self.value("surge_drag") * speed + forces.get(Port.FORCE, 0.0)
        turning = self.value("turn") * u[:, 1:] - self.value("yaw_drag") * rate + forces.get(Port.TORQUE, 0.0)
        return torch.cat((speed * torch.cos(psi), speed * torch.sin(psi), rate, along, turning), 1)


def voyages(current: tuple[float, float]) -> list[RawRun]:
    """Runs of a boat in water that flows."""
    rng, start = np.random.default_rng(11), [0.0, 0.0, 0.3, 0.5, 0.0]

    def rates(x: Array, u: Array) -> list[float]:
        _, _, psi, speed, rate = x
        moved = [speed * np.cos(psi) + current[0], speed * np.sin(psi) + current[1]]
        return [*moved, rate, u[0] - DRAG[0] * speed, TURN * u[1] - DRAG[1] * rate]

    inputs = (np.hstack([held(rng, a, b, 600, each=30) for a, b in ((0.1, 0.6), (-1, 1))]) for _ in range(3))
    return [simulated(k, rates, start, u, DT, noise=0.02, rng=rng, fine=4) for k, u in enumerate(inputs)]


@pytest.mark.parametrize("current", [(0.0, 0.0), CURRENT])
def test_a_current_is_found_in_its_direction_and_none_in_still_water(current: tuple[float, float]) -> None:
    found = nsde_torch.diagnose(voyages(current), system=Boat, say=False).content()
    flows = any(current)
    assert sorted(found["added"]) == (["drift_velocity[x]", "drift_velocity[y]"] if flows else [])
    for axis, true in zip("xy", current if flows else (), strict=False):
        low, high = found["parameters"][f"drift_velocity[{axis}].velocity"]["interval_90"]
        assert low - 0.002 < true < high + 0.002
        assert high - low < 0.02


def test_places_have_no_friction_and_velocities_none_of_their_own() -> None:
    able = Boat.able_effects()
    assert {n for n in able if n.endswith(("[x]", "[y]"))} == {"drift_velocity[x]", "drift_velocity[y]"}
    with pytest.raises(ConfigError, match=r"choose among drift_velocity\[x\], drift_velocity\[y\]"):
        Boat().make_effect("drift_velocity")
