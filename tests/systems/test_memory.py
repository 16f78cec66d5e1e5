"""Memory of effects: what inputs before a start leave, and whole steps of held inputs against fine integration."""

from functools import cache
from typing import final

import pytest
import torch
from torch import Tensor

from nsde_torch.effects import Effect, Parameter, Port
from nsde_torch.sde import STEPS, make_step, rollout
from nsde_torch.systems import System, make_system
from tests.helpers.effect_rows import flying
from tests.helpers.system_contract import Ode


@final
class Slow(Effect):
    """A push that follows the mean command late, by its formula alone: it knows no whole steps."""

    port, formula, source = Port.BODY_FORCE, "m, dm/dt = (u - m) / s", "made up"
    time, states = Parameter(0.03, "s", low=0.001), 1

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return memory.expand(-1, 3)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return (u[:, :6].mean(1, keepdim=True) - memory) / self.time

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        return u[:, :6].mean(1, keepdim=True)


@final
class Equation(Ode):
    """With whole steps of memory, which `Ode` leaves to its formulas."""

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self.inner, self.set_step = system.inner, system.set_step


def hexacopter(*effects: str | Effect, **values: float) -> System:
    named = {k.replace("__", "."): v for k, v in values.items()}
    return make_system("hexacopter", effects=list(effects), values=named).double().requires_grad_(False)


def level(rows: int) -> Tensor:
    return flying([0.0, 0.0, 0.0]).double().repeat(rows, 1)


def commands(rows: int, steps: int) -> Tensor:
    g = torch.Generator().manual_seed(3)
    return 0.3 + 0.2 * torch.rand(rows, steps, 6, generator=g, dtype=torch.float64)


def by_fine_steps(s: System, x: Tensor, u: Tensor, dt: float, fine: int) -> Tensor:
    """Memory after inputs, by Runge and Kutta's steps of dt / fine of the formulas."""
    s.set_step(0.0)
    z, step = s.augment(x, u[:, 0]), make_step("rk4")
    for held in u.repeat_interleave(fine, 1).unbind(1):
        z = step.advance(Equation(s), 0.0, z, held, dt / fine, None)
        z = torch.cat((x, z[:, 13:]), 1)
    return z[:, 13:]


@pytest.mark.parametrize("tau", [0.004, 0.05, 0.3])
def test_a_lag_remembers_as_its_closed_form_also_where_steps_are_longer(tau: float) -> None:
    s = hexacopter("motor_lag", motor_lag__time_constant=tau)
    u = commands(2, 6)
    m = u[:, 0]
    for k in range(6):
        m = u[:, k] + (m - u[:, k]) * torch.exp(torch.tensor(-0.05 / tau, dtype=torch.float64))
    z = s.remembered(level(2), torch.zeros(2, 6).double(), u, dt=0.05)
    torch.testing.assert_close(z[:, 13:], m)
    assert torch.equal(z[:, :13], level(2))


@pytest.mark.parametrize(
    ("effects", "values"),
    [
        (("motor_lag",), {"motor_lag__time_constant": 0.05}),
        (("input_delay",), {"input_delay__delay": 0.13}),
        ((Slow(),), {}),
    ],
)
def test_what_is_remembered_is_what_fine_integration_leaves(
    effects: tuple[str | Effect, ...], values: dict[str, float]
) -> None:
    s = hexacopter(*effects, **values)
    u = commands(3, 7)
    z = s.remembered(level(3), u[:, -1], u, dt=0.05)
    torch.testing.assert_close(z[:, 13:], by_fine_steps(s, level(3), u, 0.05, 50), rtol=0, atol=2e-6)
    assert (z - s.augment(level(3), u[:, -1])).abs().max() > 1e-3


@pytest.mark.parametrize("delay", [0.004, 0.03, 0.05, 0.08, 0.0999])
def test_a_delay_below_two_steps_brings_the_inputs_of_the_steps_before(delay: float) -> None:
    dt, u = 0.05, commands(2, 5)
    s = hexacopter("input_delay", input_delay__delay=delay)
    z = s.remembered(level(2), u[:, 4], u[:, :4], dt=dt)
    s.set_step(dt)
    arrives = u[:, 4] + s.effects[0](0.0, level(2), u[:, 4], z[:, 13:])
    whole, share = divmod(delay / dt, 1.0)
    now, before = u[:, 4 - int(whole)], u[:, 3 - int(whole)]
    torch.testing.assert_close(arrives, (1 - share) * now + share * before)


@pytest.mark.parametrize("effect", ["motor_lag", "input_delay"])
@pytest.mark.parametrize("time", [0.03, 0.08])
def test_memory_means_the_same_on_a_fine_grid_and_on_a_coarse_one(effect: str, time: float) -> None:
    key = {"motor_lag": "time_constant", "input_delay": "delay"}[effect]
    s, x = hexacopter(effect, **{f"{effect}__{key}": time}), level(1)
    ramp = 0.3 + 0.01 * torch.arange(30, dtype=torch.float64)[None, :, None].expand(1, 30, 6)
    memory = s.remembered(x, ramp[:, -1], ramp, dt=0.01)[:, 13:]
    u = ramp[:, -1]
    arrived = {}
    for dt, steps in ((0.01, 60), (0.05, 12)):
        s.set_step(dt)
        m, arrived[dt] = memory, torch.zeros_like(u)
        for _ in range(steps):
            arrived[dt] = arrived[dt] + dt * s.effects[0](0.0, x, u, m)
            m = m + dt * s.effects[0].memory_rate(0.0, x, u, m)
    # what is still to arrive does
    torch.testing.assert_close(arrived[0.05], arrived[0.01], rtol=2e-3, atol=0)
    assert float(arrived[0.01].abs().max()) > 0.01 * time


@cache
def lagging(tau: float) -> tuple[System, Tensor, Tensor, Tensor]:
    """A machine whose motors lag, inputs of 50 ms that roll it, where it begins, and where 1 ms steps end."""
    s = hexacopter("motor_lag", motor_lag__time_constant=tau)
    signs = torch.tensor([[-1.0, 1.0, 0.5, -0.5, -0.5, 0.5]], dtype=torch.float64)
    u = torch.stack([0.35 + 0.03 * a * signs for a in (1.0, 1.0, -1.0, 0.5)], 1)
    z = z0 = s.augment(level(1), u[:, 0] * 0 + 0.35)
    with torch.no_grad():
        for k in range(200):
            z = make_step("rk4").advance(Ode(s), 0.0, z, u[:, k // 50], 0.001, None)
    return s, u, z0, z


@pytest.mark.parametrize(
    ("name", "tau"), [*((name, 0.05) for name in STEPS), ("milstein_heun", 0.01), ("rk4", 0.12)]
)
def test_every_step_gives_the_roll_rate_of_a_lagging_motor_at_steps_of_50_ms(name: str, tau: float) -> None:
    s, u, z0, z = lagging(tau)
    step = make_step(name)
    noise = None if step.deterministic else torch.zeros(1, 1, 4, s.nz, dtype=torch.float64)
    with torch.no_grad():
        path = rollout(Equation(s), z0, u, dt=0.05, step=step, noise=noise)[0, 0]
    # torchdiffeq is as exact as its tolerances; without the whole step Euler's steps err by half
    torch.testing.assert_close(path[-1, 10:], z[0, 10:], rtol=1e-4, atol=2e-6)


def test_without_inputs_before_or_without_memory_a_start_is_stationary() -> None:
    u = commands(2, 4)
    s = hexacopter("motor_lag")
    assert torch.equal(s.remembered(level(2), u[:, 3], None, dt=0.05), s.augment(level(2), u[:, 3]))
    assert torch.equal(hexacopter().remembered(level(2), u[:, 3], u, dt=0.05), level(2))
