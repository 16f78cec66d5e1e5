"""Hysteresis and play against SciPy's integration and the operator's own definition."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from nsde_torch.effects import make_effect
from nsde_torch.effects.friction import Hysteresis, InputPlay
from tests.helpers.effect_contract import contract

DT = 0.01


TestHysteresis = contract("hysteresis", "mass_spring_damper", memory=1)
TestInputPlay = contract("input_play", "mass_spring_damper", memory=1)


def _bouc_wen(t: np.ndarray, reach: float) -> np.ndarray:
    def rate(at: float, z: np.ndarray) -> np.ndarray:
        v = np.cos(at) + 0.7 * np.cos(2.9 * at)
        return np.asarray((v - 0.5 * (abs(v) * z + v * abs(z))) / reach)

    found = solve_ivp(rate, (0.0, t[-1]), [1.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=0.01)
    return np.asarray(found.y[0])


@pytest.mark.parametrize("reach", [0.02, 0.3])
def test_memory_along_states_is_that_of_the_differential_equation(reach: float) -> None:
    t = DT * np.arange(1000)
    effect = Hysteresis({"reach": reach})
    v = np.cos(t) + 0.7 * np.cos(2.9 * t)
    z = effect.followed(torch.from_numpy(np.column_stack([np.zeros_like(t), v])), DT)[:, 0].numpy()
    middle = _bouc_wen(np.append(t, t[-1] + DT), reach)
    np.testing.assert_allclose(z, 0.5 * (middle[1:] + middle[:-1]), atol=0.02)
    assert np.abs(z).max() <= 1.0


def test_the_rate_of_the_memory_is_that_of_bouc_and_wen() -> None:
    effect = Hysteresis({"reach": 0.1})
    x, z = torch.tensor([[0.0, 0.5], [0.0, -0.5]]).double(), torch.tensor([[0.4], [0.4]]).double()
    rate = effect.double().memory_rate(0.0, x, x[:, :1], z)[:, 0]
    assert rate.tolist() == pytest.approx([(0.5 - 0.5 * 0.4) / 0.1, -0.5 / 0.1])


def test_play_is_its_own_definition() -> None:
    u = torch.tensor([0.0, 0.5, 1.0, 0.8, 0.3, -0.5, 0.0]).double()[:, None]
    effect = InputPlay({"gap": 0.25})
    acts = effect.held(u, DT)[:, 0]
    assert acts.tolist() == pytest.approx([0.0, 0.25, 0.75, 0.75, 0.55, -0.25, -0.25])
    x = u.new_zeros(len(u), 2)
    torch.testing.assert_close(u + effect.double()(0.0, x, u, acts[:, None]), acts[:, None])


def test_both_are_made_by_name_with_units_and_say_that_they_remember() -> None:
    play = make_effect("input_play", system="cartpole", ports={"force", "input"}, n_inputs=1)
    assert play.n_memory == 1
    assert all("remembers" in effect.sentence for effect in (Hysteresis, InputPlay))
    assert [Hysteresis.PARAMETERS[name].unit for name in ("reach", "size")] == ["m", "m/s2"]
