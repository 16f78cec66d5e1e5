"""Delay: the contract, and its phase and amplitude against those of a pure delay."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from nsde_torch.systems import make_system
from tests.helpers.effect_contract import EffectContract
from tests.helpers.effect_rows import flying


class TestInputDelay(EffectContract):
    name, system, memory = "input_delay", "cartpole", 2

    def test_a_slow_input_comes_out_late_and_whole(self) -> None:
        delay = 0.05
        effect = self.make({"delay": delay}).double()
        x, one = torch.zeros(1, 4).double(), torch.ones(1, 1).double()
        columns = [  # the linear system behind the effect, column by column
            effect.memory_rate(0.0, x, 0 * one, m[None])[0].detach().numpy() for m in torch.eye(2).double()
        ]
        a = np.stack(columns, 1)
        b = effect.memory_rate(0.0, x, one, torch.zeros(1, 2).double())[0].detach().numpy()
        c = np.array([1.0, -1.0 / 3.0])
        for omega in (0.1, 2.0, 10.0, 20.0):
            response = c @ np.linalg.solve(1j * omega * np.eye(2) - a, b)
            wanted = np.exp(-1j * omega * delay)
            assert abs(response - wanted) < 0.02 * max(omega * delay, 0.01)
        assert np.abs(expm(10.0 * a)).max() < 1e-6  # what was before is forgotten

    def test_a_delay_comes_before_a_lag_whatever_the_order_of_their_names(self) -> None:
        x, u = flying([0.0, 0.0, 0.0]), torch.full((1, 6), 0.4)
        for names in (["input_delay", "motor_lag"], ["motor_lag", "input_delay"]):
            s = make_system("hexacopter", effects=names, values={"thrust_gain": 5.0})
            z = s.augment(x, u)
            rate = s.drift(0.0, z, torch.full((1, 6), 0.9))[0]
            # the lag still holds the old command, and the new one has not come through
            torch.testing.assert_close(rate[5] + 9.81, torch.tensor(5.0 * 6 * 0.4))
            start = 13 + (12 if names[0] == "input_delay" else 0)
            torch.testing.assert_close(rate[start : start + 6], torch.zeros(6))


@pytest.mark.parametrize("name", ["input_delay", "motor_lag"])
@pytest.mark.parametrize("delay", [0.004, 0.03, 0.07, 0.2])
def test_coarse_steps_stay_stable_and_keep_the_mean_delay(name: str, delay: float) -> None:
    dt = 0.05
    key = {"input_delay": "delay", "motor_lag": "time_constant"}[name]
    s = make_system("hexacopter", effects=[name], values={f"{name}.{key}": delay}).double()
    s.set_step(dt)
    effect = s.effects[0]
    x = flying([0.0, 0.0, 0.0]).double()
    u = torch.zeros(1, 6).double()
    m = effect.memory_start(x, u)
    for k in range(200):  # a command that rises by 1 a second, by Euler's method
        u = torch.full((1, 6), k * dt).double()
        late = -effect(0.0, x, u, m).detach()
        m = m + dt * effect.memory_rate(0.0, x, u, m).detach()
    torch.testing.assert_close(late, torch.full_like(late, delay), rtol=1e-3, atol=1e-6)
