"""The filter finds what a closed-form Kalman filter finds, and parameters where they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nsde_torch.design.filtering import Filter, FilterProblem
from nsde_torch.design.members import prior_information
from nsde_torch.design.noises import Noises, split
from nsde_torch.sysid.noise import Noise, estimate
from nsde_torch.sysid.series import Series
from nsde_torch.systems.options import system_options

DT = 0.02


def _spring() -> tuple[Filter, np.ndarray, np.ndarray, Noises]:
    system = system_options("mass_spring_damper").make()
    noise = Noises(np.array([0.0, 1e-6]), np.array([2.5e-5, 1e-4]))
    rng = np.random.default_rng(0)
    own = Filter(system, dt=DT, noise=noise)
    u = np.sin(2.0 * DT * np.arange(150))[:, None]
    x = torch.zeros(1, 2, dtype=torch.float64)
    states = [x[0].numpy()]
    for k in range(len(u)):
        x = own.rollouts.later(torch.as_tensor(own.vector.start)[None], k, x, torch.as_tensor(u[None, k]))
        x = x + torch.as_tensor(rng.standard_normal((1, 2)) * np.sqrt(noise.pushes))
        states.append(x[0].numpy())
    seen = np.array(states) + rng.standard_normal((len(states), 2)) * np.sqrt(noise.sensors)
    return own, seen, u, noise


def test_on_a_linear_machine_innovations_are_those_of_a_kalman_filter() -> None:
    own, seen, u, noise = _spring()
    white, log_dets = own.innovations(own.vector.start[None], [seen], [u])
    gain, stiff, damp = (
        dict(zip(own.vector.labels, own.vector.start, strict=True))[n] for n in own.vector.labels
    )
    from scipy.linalg import expm

    continuous = np.array([[0.0, 1.0, 0.0], [-stiff, -damp, gain], [0.0, 0.0, 0.0]])
    whole = expm(DT * continuous)
    a, b = whole[:2, :2], whole[:2, 2]
    r, q = np.diag(noise.sensors), np.diag(noise.pushes)
    x, p, expected, dets = seen[0], r, [], 0.0
    for k in range(len(u)):
        x, p = a @ x + b * u[k, 0], a @ p @ a.T + q
        s = p + r
        low = np.linalg.cholesky(s)
        expected.append(np.linalg.solve(low, seen[k + 1] - x))
        dets += np.log(np.diag(low)).sum()
        k_gain = p @ np.linalg.inv(s)
        x, p = x + k_gain @ (seen[k + 1] - x), (np.eye(2) - k_gain) @ p
    assert own.vector.labels == ["force_gain", "linear_spring.stiffness", "viscous_friction.damping"]
    np.testing.assert_allclose(white[0], expected, rtol=0, atol=1e-4)
    assert log_dets[0] == pytest.approx(dets, abs=1e-4)


def test_parameters_are_found_within_their_standard_errors_from_a_wrong_start() -> None:
    own, seen, u, _ = _spring()
    prior = prior_information(own.vector)
    found = own.solve([FilterProblem((seen,), (u,), own.vector.start * 1.5, prior)], rounds=15)[0]
    errors = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert np.abs(found.theta - own.vector.start).max() > 0
    assert (np.abs(found.theta - own.vector.start) < 3.5 * errors).all()
    assert 0.8 < found.excess < 1.25


def test_a_run_that_is_shorter_counts_no_rows_behind_its_end() -> None:
    own, seen, u, _ = _spring()
    both, dets = own.innovations(np.stack([own.vector.start] * 2), [seen, seen[:51]], [u, u[:50]])
    np.testing.assert_allclose(both[1, :50], both[0, :50])
    assert (both[1, 50:] == 0).all()
    alone = own.innovations(own.vector.start[None], [seen[:51]], [u[:50]])[1]
    assert dets[1] == pytest.approx(alone[0])


def test_neighbours_are_filtered_with_the_gains_of_the_first_of_them() -> None:
    own, seen, u, _ = _spring()
    start = own.vector.start
    rows = np.stack([start, 1.02 * start, 0.9 * start, start])
    shared, _ = own.innovations(rows, [seen] * 4, [u] * 4, shared=2)
    alone, _ = own.innovations(rows, [seen] * 4, [u] * 4)
    np.testing.assert_allclose(shared[::2], alone[::2], rtol=0, atol=1e-6)
    away = np.abs(shared[1] - alone[1]).max()
    assert 0.0 < away < 0.05 * np.abs(alone[1] - alone[0]).max()


@pytest.mark.parametrize("orders", [0, 12])
def test_a_law_is_split_into_machine_and_sensor_whatever_its_orders(orders: int) -> None:
    rng = np.random.default_rng(1)
    push, sensor, n = 0.004, 0.01, 20_000
    residual = push * rng.standard_normal(n) + np.diff(sensor * rng.standard_normal(n + 1))
    law = estimate(residual, Series(((0, n),)), limit=0.999 if orders == 0 else 0.0, orders=orders)
    assert (law.carry > 0) == (orders == 0)
    found = split(law)
    assert found[0] == pytest.approx(push**2, rel=0.6 if orders else 0.15)
    assert found[1] == pytest.approx(sensor**2, rel=0.1)


def test_the_split_of_a_moving_average_is_that_of_its_autocovariances() -> None:
    assert split(Noise(0.8, np.zeros(0), 2.0)) == pytest.approx((4.0 * 0.04, 4.0 * 0.8))
