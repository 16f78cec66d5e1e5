"""Machines that move nothing: what is stored beside a temperature, and comes back late."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.diagnosis.candidates import starts, without_motion
from nsde_torch.diagnosis.decision import inputs_know
from nsde_torch.diagnosis.residual_tests import Dependence
from nsde_torch.effects import Parameter, Port
from nsde_torch.errors import ConfigError
from nsde_torch.sysid.feedback_test import Answer, FeedbackTest
from nsde_torch.systems import Defaults, ResidualPort, System
from tests.helpers.machines import Array, held, simulated

DT, LOSS, GAIN = 1.0, 0.02, 0.5


class Room(System):
    """T' = gain heater - loss T: the temperature of a room above the one outside."""

    name = "room"
    state_names, state_units = ("T",), ("K",)
    input_names, input_units = ("heater",), ("kW",)
    ports = {Port("heat"): 1}
    residual_ports = {Port("heat"): ResidualPort(1, 0.1, "K/s")}
    defaults = Defaults(DT, 20, (0.05,), 0.1, 1.0, "euler_maruyama")
    sensor_noise = True
    PARAMETERS = {"loss": Parameter(LOSS, "1/s", low=0.0), "gain": Parameter(GAIN, "K/(s kW)", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        heat = self.value("gain") * u - self.value("loss") * x
        return heat + forces.get(Port("heat"), 0.0)


def warmed(
    *, exchange: float = 0.0, time: float = 120.0, wall: float = 5.0, leak: float = 0.0
) -> list[RawRun]:
    """Runs of a room whose wall takes heat up and gives it back, and that loses heat with the root of it."""

    def rates(x: Array, u: Array) -> list[float]:
        heat = GAIN * u[0] - LOSS * x[0] - leak * max(x[0], 0.0) ** 0.5
        return [heat + exchange * (x[1] - x[0]), (x[0] - x[1]) / time]

    rng, out = np.random.default_rng(4), []
    for number in range(3):
        heater = held(rng, 0.0, 1.0, 900, each=30)
        run = simulated(number, rates, [5.0, wall], heater, DT, noise=(0.02, 0.0), rng=rng, fine=2)
        out.append(replace(run, x=run.x[:, :1]))
    return out


@pytest.mark.parametrize(("exchange", "wall"), [(0.0, 5.0), (0.015, 5.0), (0.015, -8.0)])
def test_a_wall_that_stores_heat_is_found_and_none_where_there_is_none(exchange: float, wall: float) -> None:
    """Also one that is colder than the room as each run begins, which was `unexplained`."""
    found = nsde_torch.diagnose(warmed(exchange=exchange, wall=wall), system=Room, say=False).content()
    assert found["verdict"] == ("effect_found" if exchange else "no_effect")
    assert not any(f["lead"] for f in found["findings"])
    assert found["added"] == (["relaxation"] if exchange else [])
    if exchange:
        for name, true in (("exchange", exchange), ("time", 120.0)):
            low, high = found["parameters"][f"relaxation.{name}"]["interval_90"]
            assert 0.97 * low < true < 1.03 * high < 1.5 * true


def test_what_flows_through_a_hole_is_a_root_of_the_level() -> None:
    """Beside a loss that is declared, which an exchange with surroundings would be half of."""
    found = nsde_torch.diagnose(warmed(leak=0.05), system=Room, say=False).content()
    assert found["added"] == ["heat = c1 root(T)"]
    low, high = found["parameters"]["heat = c1 root(T).c1"]["interval_90"]
    assert 1.03 * low < -0.05 < 0.97 * high


def test_an_input_that_never_comes_near_zero_has_no_dead_band_and_one_of_one_sign_no_gain_by_it() -> None:
    near, far = (
        {"input": 1.0, "least input": least, "rarer sign": 0.3, "step": 0.1} for least in (0.01, 0.9)
    )
    assert starts(Room(), "actuator_deadband", near, ())
    assert not starts(Room(), "actuator_deadband", far, ())
    assert starts(Room(), "asymmetric_gain", near, ())
    assert not starts(Room(), "asymmetric_gain", {**near, "rarer sign": 0.0}, ())
    assert starts(Room(), "input_delay", far, ())


def test_in_a_closed_loop_inputs_a_moment_before_are_what_the_controller_knew() -> None:
    before, of_state = (
        Dependence("T", variable, 1e-9, 0.2, 0.5, gain, 2)
        for variable, gain in (("heater before", 300.0), ("T", 30.0))
    )
    loop = FeedbackTest((Answer("heater", "T", 0.2, 1e-9),), (Answer("heater", "T", 0.2, 1e-9),), rows=900)
    assert inputs_know([before, of_state], loop) == {"T"}
    assert not inputs_know([before, of_state], FeedbackTest())
    assert not inputs_know([replace(before, gain=3.0), of_state], loop), "a law of the state is more"


def test_stores_of_a_machine_without_coordinates_have_no_friction() -> None:
    assert {"relaxation", "exchange"} <= set(Room.able_effects())
    assert without_motion(Room()) == ("", "")
    assert "coulomb_friction" not in Room.able_effects()
    with pytest.raises(ConfigError, match="declares none"):
        Room().make_effect("coulomb_friction")
    with torch.no_grad():
        still = Room().with_effects(Room().make_effect("relaxation", {"exchange": 0.1, "time": 5.0}))
        rate = still.drift(0.0, torch.tensor([[2.0, 1.0]]), torch.tensor([[0.0]]))
    assert rate[0].tolist() == pytest.approx([-LOSS * 2.0 - 0.1, 0.2], rel=1e-5)
