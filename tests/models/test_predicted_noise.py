"""Disturbances that a neural SDE carries, and the noise of the sensors that it predicts."""

import math

import pytest
import torch

from nsde_torch.models import NeuralSDE
from tests.helpers.toy_systems import DT, Decay, Gusty, fix_sigma, make_model


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_disturbance_is_not_returned_and_starts_in_its_stationary_law() -> None:
    sigma, scale = 0.6, 1.3
    model = fix_sigma(make_model(Gusty, disturbance=True, dtype=torch.float64), torch.tensor([1e-9, sigma]))
    with torch.no_grad():
        model.log_tau.fill_(math.log(0.2))
        model.clock_scale.fill_(scale)
        tau = float(model.tau) / scale  # on the logged clock
        n = 40_000
        normal, none = (
            torch.randn(n, 1, generator=generator(), dtype=torch.float64),
            torch.zeros(n, 1).double(),
        )
        z = model.augment(none, none, normal)
        assert z.shape == (n, 2)
        stationary = sigma * math.sqrt(tau / 2)
        assert float(z[:, 1].std()) == pytest.approx(stationary, rel=0.02)
        dt = 0.005
        for _ in range(60):  # it stays there
            dw = math.sqrt(dt) * torch.randn(n, 2, generator=generator(_), dtype=torch.float64)
            u = torch.zeros(n, 1, dtype=torch.float64)
            z = z + dt * model.drift(0.0, z, u) + model.diffusion(0.0, z, u) * dw
        assert float(z[:, 1].std()) == pytest.approx(stationary, rel=0.03)
    out = model.sample(torch.zeros(2, 1), torch.zeros(2, 5, 1), dt=DT, particles=3, generator=generator())
    assert out.shape == (3, 2, 6, 1)


def test_a_disturbance_acts_on_its_port_like_a_force() -> None:
    model = make_model(Gusty, disturbance=True, dtype=torch.float64).requires_grad_(False)
    x, u = torch.randn(5, 1, dtype=torch.float64), torch.zeros(5, 1, dtype=torch.float64)
    d = torch.randn(5, 1, dtype=torch.float64)
    rate = model.drift(0.0, torch.cat((x, d), 1), u) - model.drift(0.0, torch.cat((x, 0 * d), 1), u)
    torch.testing.assert_close(rate[:, :1], d)
    torch.testing.assert_close(rate[:, 1:], -d / model.tau)


def sensing(std: float) -> NeuralSDE:
    model = fix_sigma(make_model(Decay, measurement=True), 1e-9)
    with torch.no_grad():
        model.log_measurement_std.fill_(math.log(std))
    return model.requires_grad_(False)


def test_predicted_measurements_carry_sensor_noise_at_the_start_and_at_every_later_state() -> None:
    model, n = sensing(0.2), 20_000
    out = model.sample(torch.ones(1, 1), torch.zeros(1, 20, 1), dt=DT, particles=n, generator=generator())
    assert float(out[:, 0, 0].std()) == 0.0  # x0 was measured: it is what it is
    for k in (1, 10, 20):  # the noise of the start decays with the state, that of the sensor does not
        expected = 0.2 * math.sqrt(1 + (1 - DT) ** (2 * k))
        assert float(out[:, 0, k].std()) == pytest.approx(expected, rel=0.03)
    late = out[:, 0, 19:, 0] - out[:, 0, 19:, 0].mean(0)
    shared = 0.2**2 * (1 - DT) ** 39  # only the start's noise is shared by neighbours
    assert float((late[:, 0] * late[:, 1]).mean()) == pytest.approx(shared, abs=0.002)


def test_without_measurement_paths_start_exactly_at_x0_and_have_no_sensor_noise() -> None:
    model = sensing(0.2)
    x0, u = torch.ones(1, 1), torch.zeros(1, 20, 1)
    out = model.sample(x0, u, dt=DT, particles=50, generator=generator(), measurement=False)
    assert bool((out[:, :, 0] == 1.0).all())
    assert float(out.std(0).max()) < 1e-6


def test_other_sensors_noise_replaces_that_of_the_training_data() -> None:
    model = sensing(0.2)
    given = {"dt": DT, "particles": 20_000, "generator": generator(), "measurement_std": torch.tensor([0.05])}
    out = model.sample(torch.ones(1, 1), torch.zeros(1, 20, 1), **given)
    assert float(out[:, 0, 20].std()) == pytest.approx(0.05 * math.sqrt(1 + (1 - DT) ** 40), rel=0.03)
