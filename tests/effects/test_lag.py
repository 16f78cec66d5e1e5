"""Effects with memory: lags, delays and hysteresis in closed form."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from nsde_torch.effects import effect_class
from nsde_torch.effects.actuators import InputPlay
from nsde_torch.effects.forces import HiddenMass
from nsde_torch.effects.multirotor_forces import SlungLoad
from nsde_torch.systems import make_system
from tests.helpers.effect_rows import flying, machine_with, made

SPRING, RESONANCE, DT = "mass_spring_damper", {"period": 0.5, "damping": 0.3}, 0.01


def test_a_step_up_is_followed_by_one_time_constant_and_one_down_by_the_other() -> None:
    s = machine_with("quadrotor", "asymmetric_lag", {"rising": 0.03, "falling": 0.11}).double()
    for before, after, tau in ((0.3, 0.5, 0.03), (0.5, 0.3, 0.11)):
        z = torch.cat((flying([0.0, 0.0, 1.0])[:1].double(), torch.full((1, 4), before).double()), 1)
        for _ in range(20):
            z = _rk4(s, z, torch.full((1, 4), after, dtype=torch.float64), 0.005)
        expected = after + (before - after) * np.exp(-0.1 / tau)
        np.testing.assert_allclose(z[:, 13:].numpy(), expected, atol=1e-6)


def test_a_held_step_is_followed_in_a_straight_line() -> None:
    effect = made(SPRING, "actuator_rate_limit", {"rate": 4.0}).double()
    effect.step, x = 0.1, torch.zeros(3, 2).double()
    memory, u = (torch.tensor(rows).double()[:, None] for rows in ([1.0, 1.0, -1.0], [1.0, 3.0, -1.1]))
    fine = torch.linspace(0.0, 0.1, 20001).double()
    path = memory + (u - memory).sign() * torch.minimum(4.0 * fine, (u - memory).abs())
    mean = u + effect(0.0, x, u, memory)
    torch.testing.assert_close(mean[:, 0].detach(), path.mean(1), atol=1e-5, rtol=0.0)
    after = memory + 0.1 * effect.memory_rate(0.0, x, u, memory)
    torch.testing.assert_close(after[:, 0].detach(), path[:, -1])


@torch.no_grad()
def test_what_acts_of_held_inputs_is_what_step_after_step_makes() -> None:
    effect, u = made(SPRING, "actuator_rate_limit", {"rate": 4.0}).double(), torch.randn(50, 1).double()
    effect.step, memory, x = 0.1, u[:1], torch.zeros(1, 2).double()
    means = []
    for row in u[:, None]:
        means.append(row + effect(0.0, x, row, memory))
        memory = memory + 0.1 * effect.memory_rate(0.0, x, row, memory)
    torch.testing.assert_close(effect.held(u, 0.1), torch.cat(means))


def test_a_step_of_the_command_is_followed_as_the_equation_says() -> None:
    s = machine_with(SPRING, "actuator_resonance", RESONANCE).double()
    z, u = torch.zeros(1, 4).double(), torch.ones(1, 1).double()
    for _ in range(200):
        z = _rk4(s, z, u, 0.005)
    w, d, t = 4.0 * np.pi, 0.3, 1.0
    fast = w * np.sqrt(1.0 - d * d)
    expected = 1.0 - np.exp(-d * w * t) * (np.cos(fast * t) + d * w / fast * np.sin(fast * t))
    assert float(z[0, 2]) == pytest.approx(expected, abs=1e-5)


@torch.no_grad()
def test_what_follows_held_inputs_is_what_integration_makes() -> None:
    effect, u = made(SPRING, "actuator_resonance", RESONANCE).double(), torch.randn(30, 1).double()
    x, rows = torch.zeros(1, 2).double(), []
    memory = effect.memory_start(x, u[:1])
    for row in u[:, None]:
        rows.append(memory)
        now = solve_ivp(
            lambda t, m, row=row: effect.memory_rate(t, x, row, torch.from_numpy(m)[None])[0].numpy(),
            (0.0, 0.05),
            memory[0].numpy(),
            rtol=1e-9,
            atol=1e-11,
        )
        memory = torch.from_numpy(now.y[:, -1])[None]
    torch.testing.assert_close(effect.held(u, 0.05), torch.cat((*rows, memory)), atol=1e-7, rtol=0.0)


def _rk4(s: torch.nn.Module, z: torch.Tensor, u: torch.Tensor, dt: float) -> torch.Tensor:
    with torch.no_grad():
        a = s.drift(0.0, z, u)  # type: ignore[operator]
        b = s.drift(0.0, z + 0.5 * dt * a, u)  # type: ignore[operator]
        c = s.drift(0.0, z + 0.5 * dt * b, u)  # type: ignore[operator]
        d = s.drift(0.0, z + dt * c, u)  # type: ignore[operator]
        return z + dt / 6 * (a + 2 * b + 2 * c + d)


def test_a_slow_input_comes_out_late_and_whole() -> None:
    delay = 0.05
    effect = made("cartpole", "input_delay", {"delay": delay}).double()
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


def test_a_delay_comes_before_a_lag_whatever_the_order_of_their_names() -> None:
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


def _follows(v: Any, m: Any, time: float) -> Any:
    return (v - m) / time


def _bouc_wen(weight: float) -> Any:
    return lambda v, z, reach: (v - weight * abs(v) * z - (1.0 - weight) * v * abs(z)) / reach


@pytest.mark.parametrize(
    ("name", "values", "rate", "begins", "within"),
    [
        *(("relaxation", {"time": time}, _follows, 0.5, 5e-4) for time in (0.03, 4.0)),
        *(("viscoelasticity", {"time": time}, _follows, 0.0, 5e-4) for time in (0.03, 4.0)),
        *(
            ("hysteresis", {"reach": reach, "weight": weight}, _bouc_wen(weight), 1.0, 0.03)
            for reach in (0.02, 0.3)
            for weight in (0.3, 0.5, 0.75, 1.0)
        ),
    ],
)
def test_memory_along_states_is_that_of_the_differential_equation(
    name: str, values: dict[str, float], rate: Any, begins: float, within: float
) -> None:
    ends = DT * np.arange(1001)

    def v(at: Any) -> Any:
        return np.sin(2.0 * at) + 0.5 * np.cos(5.0 * at)

    found = solve_ivp(
        lambda at, m: rate(v(at), m, next(iter(values.values()))),
        (0.0, ends[-1]),
        [begins],
        t_eval=ends,
        rtol=1e-9,
        max_step=DT,
    )
    effect = effect_class(name)(values).double()
    along = effect.followed(torch.from_numpy(np.column_stack((0.0 * ends[:-1], v(ends[:-1])))), DT)
    np.testing.assert_allclose(along[:-1, 0], found.y[0][:-1], atol=within)
    assert effect.followed(torch.zeros(1, 2).double(), DT).shape == (2, 1)


@pytest.mark.parametrize("frequency", [0.5, 3.0])
def test_a_hidden_mass_follows_and_pulls_as_two_masses_on_a_spring_do(frequency: float) -> None:
    t, w, ratio, mass = DT * np.arange(801), 2.0 * np.pi * frequency, 0.07, 0.2

    def v(at: float) -> float:
        return float(np.sin(2.0 * at) + 0.5 * np.cos(5.0 * at))

    def rates(at: float, y: np.ndarray) -> np.ndarray:  # [way of the machine, place of the mass, its speed]
        return np.array([v(at), y[2], w * w * (y[0] - y[1]) + 2.0 * ratio * w * (v(at) - y[2])])

    found = solve_ivp(rates, (0.0, t[-1]), [0.0, 0.0, v(0.0)], t_eval=t, rtol=1e-9, atol=1e-9).y
    speeds = np.array([v(at) for at in t])
    values = {"mass": mass, "frequency": frequency, "damping": ratio}
    effect = HiddenMass(values).double()
    x = torch.from_numpy(np.column_stack([found[0], speeds]))
    along = effect.followed(x[:-1], DT)
    expected = np.column_stack([found[1] - found[0], found[2]])
    np.testing.assert_allclose(along[:-1], expected[:-1], atol=2e-3)
    memory = torch.from_numpy(expected)
    pull = effect(0.0, x, x[:, :1], memory)[:, 0].detach().numpy()
    slope = np.gradient(found[2], DT, edge_order=2)
    np.testing.assert_allclose(pull[2:-2], -mass * slope[2:-2], atol=0.02)
    rate = effect.memory_rate(0.0, x, x[:, :1], memory).detach().numpy()
    np.testing.assert_allclose(rate[2:-2, 0], np.gradient(expected[:, 0], DT)[2:-2], atol=0.02)
    np.testing.assert_allclose(effect.memory_start(x[:1], x[:1, :1])[0], [0.0, v(0.0)])


def test_a_slung_load_pulls_to_its_side_and_takes_its_share_of_a_tilted_thrust() -> None:
    mass, length, tilt = 0.2, 1.5, 0.1
    load = SlungLoad({"mass": mass, "length": length, "damping": 0.05}).double()
    x, memory = torch.zeros(1, 13).double(), torch.tensor([[0.3, -0.1, 0.0, 0.0]]).double()
    x[0, 6:10] = torch.tensor([np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0])
    # both masses fall with g; machine: (1 + m) T along its axis and the cable, load: the cable alone
    both = 9.81 / np.cos(tilt)
    cable = 9.81 / length * np.array([0.3, -0.1])  # over the mass of the load
    expected = [both * np.sin(tilt) * mass + mass * cable[0], mass * cable[1], 0.0]
    pull = load(0.0, x, torch.tensor([[0.5] * 6 + [both]]).double(), memory)[0].detach()
    assert pull.tolist() == pytest.approx(expected)
    moving = torch.zeros(50, 13).double()
    moving[:, 3], moving[:, 4] = 1.0, 2.0
    along = load.followed(moving, DT)
    np.testing.assert_allclose(along, np.tile([0.0, 0.0, 1.0, 2.0], (51, 1)), atol=1e-12)


def test_play_is_its_own_definition() -> None:
    u = torch.tensor([0.0, 0.5, 1.0, 0.8, 0.3, -0.5, 0.0]).double()[:, None]
    effect = InputPlay({"half_gap": 0.25})
    acts = effect.held(u, DT)[:, 0]
    assert acts.tolist() == pytest.approx([0.0, 0.25, 0.75, 0.75, 0.55, -0.25, -0.25])
    x = u.new_zeros(len(u), 2)
    torch.testing.assert_close(u + effect.double()(0.0, x, u, acts[:, None]), acts[:, None])
