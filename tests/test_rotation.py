"""Rotations against SciPy's, also for the smallest angles and near half a turn; gradients stay finite."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from nsde_torch.rotation import (
    body_rates,
    gravity_direction,
    quaternion_rate,
    rotate,
    rotate_back,
    rotation_between,
    turned,
)

Array = NDArray[np.float64]


def attitudes(n: int = 64, seed: int = 0) -> Rotation:
    return Rotation.random(n, random_state=np.random.default_rng(seed))


def wxyz(rotation: Rotation) -> Tensor:
    """SciPy stores x y z w."""
    return torch.from_numpy(np.roll(rotation.as_quat(), 1, axis=-1))


def vectors(n: int = 64, seed: int = 1) -> Array:
    return np.random.default_rng(seed).normal(size=(n, 3))


def test_rotating_to_the_world_and_back_is_scipys_apply() -> None:
    made, v = attitudes(), vectors()
    q = wxyz(made)
    np.testing.assert_allclose(rotate(q, torch.from_numpy(v)), made.apply(v), atol=1e-13)
    np.testing.assert_allclose(rotate_back(q, torch.from_numpy(v)), made.inv().apply(v), atol=1e-13)
    np.testing.assert_allclose(gravity_direction(q), made.inv().apply([0.0, 0.0, 1.0]), atol=1e-13)


def test_quaternion_rate_is_the_derivative_of_a_turning_body() -> None:
    made, omega, h = attitudes(), vectors(), 1e-5
    ahead, behind = made * Rotation.from_rotvec(h * omega), made * Rotation.from_rotvec(-h * omega)
    q, a, b = (wxyz(r).numpy() for r in (made, ahead, behind))
    a *= np.sign((a * q).sum(1, keepdims=True))
    b *= np.sign((b * q).sum(1, keepdims=True))
    rate = quaternion_rate(torch.from_numpy(q), torch.from_numpy(omega))
    np.testing.assert_allclose(rate, (a - b) / (2 * h), atol=1e-9)
    np.testing.assert_allclose((rate.numpy() * q).sum(1), 0, atol=1e-14)
    np.testing.assert_allclose(body_rates(torch.from_numpy(q), rate), omega, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-6, 1e-5, 1e-3, 0.5, 3.0, np.pi - 1e-6, np.pi])
def test_turning_by_a_rotation_vector_and_back_is_scipys_at_every_angle(angle: float) -> None:
    axis = vectors(32)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    start = attitudes(32)
    end = start * Rotation.from_rotvec(angle * axis)
    there = turned(wxyz(start), torch.from_numpy(angle * axis)).numpy()
    there *= np.sign((there * wxyz(end).numpy()).sum(1, keepdims=True))
    np.testing.assert_allclose(there, wxyz(end), atol=1e-14)
    found = rotation_between(wxyz(start), wxyz(end)).numpy()
    if angle > np.pi - 1e-9:  # half a turn: both signs of the axis are right
        found = found * np.sign((found * axis).sum(1, keepdims=True))
    # relative in the large, absolute rounding of the products in the small
    np.testing.assert_allclose(found, angle * axis, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-6, 2e-6, 1e-3, 3.1, np.pi])
def test_gradients_are_finite_at_zero_error_and_half_a_turn(dtype: torch.dtype, angle: float) -> None:
    start = attitudes(16)
    end = start * Rotation.from_rotvec(angle * np.eye(3)[np.arange(16) % 3])
    a, b = (wxyz(r).to(dtype).requires_grad_() for r in (start, end))
    rotation_between(a, b).square().sum().backward()
    for q in (a, b):
        assert q.grad is not None
        assert bool(torch.isfinite(q.grad).all())
