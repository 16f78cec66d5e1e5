"""A plant does what physics says in closed form, and adds the noise that it was told to."""

from math import exp, pi
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError, NonFiniteError, ShapeError
from nsde_torch.rotation import rotation_between, turned
from nsde_torch.simulation import Plant, make_plant
from nsde_torch.simulation.plant import Gusts
from nsde_torch.systems.machine import Gust
from tests.helpers.draws import generator


def quiet(name: str = "hexacopter", **options: object) -> Plant:
    return make_plant(name, generator=generator(), process_noise=0.0, sensor_noise=0.0, **options)  # type: ignore[arg-type]


def level(batch: int = 1) -> Tensor:
    x = torch.zeros(batch, 13, dtype=torch.float64)
    x[:, 6] = 1.0
    return x


def hover(batch: int = 1, motors: int = 6) -> Tensor:
    return torch.full((batch, motors), (9.81 + 1.0) / (6 * 4.6), dtype=torch.float64)


def after(plant: Plant, u: Tensor, samples: int) -> Tensor:
    """What is measured after so many samples under one command."""
    for _ in range(samples):
        x = plant.step(u)
    return x


def test_thrust_follows_a_step_of_the_command_with_the_motor_lag() -> None:
    tau, dt = 0.05, 0.01
    plant = quiet()
    plant.reset(level(), hover())
    more = hover() + 0.1
    speed = 0.0
    for k in range(1, 31):
        x = plant.step(more)
        t = k * dt
        # v' = 6 * 4.6 * 0.1 (1 - e^(-t / tau)) - 0.05 v, the drag along body z
        d, a = 0.05, 6 * 4.6 * 0.1
        speed = a * ((1 - exp(-d * t)) / d - (exp(-t / tau) - exp(-d * t)) / (d - 1 / tau))
        assert x[0, 5].item() == pytest.approx(speed, rel=1e-4, abs=1e-6)
    assert speed > 0.5


def test_latency_delays_the_effect_of_a_command_by_exactly_its_time() -> None:
    prompt, late = quiet(declared_only=True, step=0.005), quiet(declared_only=True, step=0.005, latency=0.025)
    for plant in (prompt, late):
        plant.reset(level(), hover())
    more = hover() + 0.1
    for _ in range(20):
        a, b = prompt.step(more), late.step(more)
    push = 6 * 4.6 * 0.1
    assert a[0, 5].item() == pytest.approx(push * 0.2, rel=1e-6)
    assert b[0, 5].item() == pytest.approx(push * (0.2 - 0.025), rel=1e-6)


@pytest.mark.slow
def test_the_coarse_step_of_the_flights_is_fine_enough() -> None:
    draw = generator(1)
    u = hover(8) + 0.1 * torch.randn(100, 8, 6, generator=draw, dtype=torch.float64)
    ends = []
    for step in (0.01, 0.00125):
        plant = quiet(step=step)
        plant.reset(level(8), hover(8))
        for v in u:
            x = plant.step(v)
        ends.append(x)
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=2e-5)


def test_gusts_have_the_variance_and_the_correlation_time_of_their_process() -> None:
    spec = {Port.FORCE: Gust(std=(0.7,), time_constant=0.2)}
    gusts = Gusts(spec, {Port.FORCE: 1}, dt=0.02, scale=1.0, generator=generator())
    gusts.reset(20000)
    first = gusts.draw()[Port.FORCE]
    for _ in range(9):
        gusts.draw()
    later = gusts.draw()[Port.FORCE]  # 10 samples, one correlation time, after the first
    assert first.std().item() == pytest.approx(0.7, rel=0.03)
    assert later.std().item() == pytest.approx(0.7, rel=0.03)
    assert (first * later).mean().item() / 0.49 == pytest.approx(exp(-1.0), abs=0.03)


def test_sensor_noise_has_its_standard_deviation_on_every_channel_and_keeps_the_quaternion_unit() -> None:
    plant = make_plant("hexacopter", generator=generator(2), process_noise=0.0)
    tilted = turned(level(20000)[:, 6:10], torch.tensor([[0.3, -0.2, 1.0]], dtype=torch.float64))
    start = torch.cat((level(20000)[:, :6], tilted, level(20000)[:, 10:]), 1)
    x = plant.reset(start, hover(20000))
    assert (x[:, 6:10].norm(dim=1) - 1.0).abs().max().item() < 1e-12
    assert x[:, :3].std(0).tolist() == pytest.approx([1e-3] * 3, rel=0.03)
    assert x[:, 3:6].std(0).tolist() == pytest.approx([1e-2] * 3, rel=0.03)
    assert x[:, 10:].std(0).tolist() == pytest.approx([2e-2] * 3, rel=0.03)
    angle = rotation_between(start[:, 6:10], x[:, 6:10])
    assert (angle.std(0) * 180 / pi).tolist() == pytest.approx([0.2] * 3, rel=0.03)


def test_rows_that_do_not_fit_are_named() -> None:
    plant = quiet()
    with pytest.raises(ShapeError, match=r"`x0` must be \(batch, 13\)"):
        plant.reset(torch.zeros(1, 12), hover())
    with pytest.raises(ShapeError, match="equal numbers of rows"):
        plant.reset(level(2), hover(3))
    plant.reset(level(2), hover(2))
    with pytest.raises(ShapeError, match="row for each of the 2 machines"):
        plant.step(hover(3))
    with pytest.raises(ShapeError, match="rows"):
        plant.restart(torch.tensor([0, 1]), level())


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"dt": 0.01, "step": 0.004}, "multiple of the fine `step`"),
        ({"latency": -1.0}, "`latency`"),
        ({"effects": ["quadratic_drga"]}, "Did you mean 'quadratic_drag'"),
        ({"effects": ["quadratic_drag", "quadratic_drag"]}, "twice"),
        ({"name": "mass_spring_damper", "process_noise": 2.0}, "process noise"),
        ({"sensor_std": (1.0,)}, "sensor_std"),
    ],
)
def test_faults_of_the_caller_are_named(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_plant(**{"name": "hexacopter", "generator": generator(), **settings})


def test_a_state_that_leaves_the_finite_numbers_is_reported_with_its_rows() -> None:
    plant = quiet()
    start = level(3)
    start[1, 3] = float("nan")
    plant.reset(start, hover(3))
    with pytest.raises(NonFiniteError, match=r"step 1 .*rows \[1\]"):
        plant.step(hover(3))
    patient = quiet(check=False)
    patient.reset(start, hover(3))
    x = patient.step(hover(3))
    assert torch.isfinite(x).all(1).tolist() == [True, False, True]


def test_restarted_machine_forgets_its_memory_and_the_others_go_on() -> None:
    plant = quiet()
    plant.reset(level(3), hover(3))
    plant.step(0.0 * hover(3))
    before = plant._z.clone()
    measured = plant.restart(torch.tensor([1]), level())
    assert torch.equal(plant._z[[0, 2]], before[[0, 2]])
    assert torch.equal(measured, level())
    fresh = quiet()
    fresh.reset(level())
    for _ in range(5):
        plant.step(hover(3))
        fresh.step(hover())
    torch.testing.assert_close(plant.state[1], fresh.state[0], rtol=0, atol=1e-12)
