"""Rotations by unit quaternions (w, x, y, z), body to world, on rows (..., 4) and (..., 3).

q v q* = v + 2 w (r x v) + 2 r x (r x v),  q = (w, r).  Written by components: the loops fuse when compiled.
Within `few_operations` the same polynomials are products of q q^T with a constant, which several rotations share.
"""

from typing import TypeVar

import torch
from torch import Tensor

from nsde_torch.columns import columns, few, split_columns, stack_columns

Scalar = TypeVar("Scalar", float, Tensor)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product (..., 3)."""
    if few():
        return torch.linalg.cross(a, b)
    ax, ay, az = columns(a)
    bx, by, bz = columns(b)
    return stack_columns((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vector from body to world, (..., 3); `q` (..., 4) must be of unit length (not checked)."""
    if few():
        return (matrix(q) * v[..., None, :]).sum(-1)
    w, r = split_columns(q, 1, 3)
    s = 2.0 * cross(r, v)
    return v + w * s + cross(r, s)


def rotate_back(q: Tensor, v: Tensor) -> Tensor:
    """Vector from world to body, (..., 3)."""
    if few():
        return (matrix(q) * v[..., :, None]).sum(-2)
    w, r = split_columns(q, 1, 3)
    s = 2.0 * cross(r, v)
    return v - w * s + cross(r, s)


def gravity_direction(q: Tensor) -> Tensor:
    """World's up axis in the body frame, (..., 3): (0, 0, 1) when level."""
    if few():
        return matrix(q)[..., 2, :]
    w, x, y, z = columns(q)
    return stack_columns((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)))


def axis_up(q: Tensor) -> Tensor:
    """The body's up axis in the world, (..., 3): `rotate` of (0, 0, 1)."""
    if few():
        return matrix(q)[..., :, 2]
    w, x, y, z = columns(q)
    return stack_columns((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)))


def quaternion_rate(q: Tensor, omega: Tensor) -> Tensor:
    """dq/dt = q (0, omega) / 2, (..., 4), for body rates omega (..., 3) [rad/s]."""
    if few():
        return (q[..., :, None] * omega[..., None, :]).flatten(-2) @ _RATE.to(q)
    w, x, y, z = columns(q)
    p, r, s = columns(omega)
    return 0.5 * stack_columns(
        (-x * p - y * r - z * s, w * p + y * s - z * r, w * r - x * s + z * p, w * s + x * r - y * p)
    )


def body_rates(q: Tensor, rate: Tensor) -> Tensor:
    """Body rates (..., 3) [rad/s] of an attitude (..., 4) that changes at a rate (..., 4); of `quaternion_rate`."""
    return 2.0 * _turn(q, rate)


def euler_coupling(jx: Scalar, jy: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Factors of `rate_products` in -J^-1 (omega x J omega), for a diagonal J whose elements are jx, jy and 1."""
    return (jy - 1.0) / jx, (1.0 - jx) / jy, jx - jy


def rate_products(omega: Tensor) -> Tensor:
    """w_y w_z, w_z w_x, w_x w_y of body rates (..., 3)."""
    if few():
        return omega.roll(-1, -1) * omega.roll(-2, -1)
    wx, wy, wz = columns(omega)
    return stack_columns((wy * wz, wz * wx, wx * wy))


def rotation_between(q_from: Tensor, q_to: Tensor) -> Tensor:
    """Rotation vector (..., 3) [rad] of conj(q_from) q_to, the short way round, exact to 2nd order at 0."""
    w, x, y, z = columns(q_from)
    a, b, c, d = columns(q_to)
    s = w * a + x * b + y * c + z * d
    r = _turn(q_from, q_to)
    sign = torch.where(s < 0, -1.0, 1.0).to(r)
    r, s = r * sign[..., None], s.abs()
    n2 = (r * r).sum(-1)
    n = torch.sqrt(n2.clamp_min(1e-16))
    angle = 2.0 * torch.atan2(n, s)
    return r * torch.where(n2 > 1e-12, angle / n, 2.0 / s.clamp_min(0.5))[..., None]


def _turn(q: Tensor, p: Tensor) -> Tensor:
    """Vector part (..., 3) of conj(q) p."""
    w, x, y, z = columns(q)
    a, b, c, d = columns(p)
    return stack_columns(
        (w * b - x * a - y * d + z * c, w * c + x * d - y * a - z * b, w * d - x * c + y * b - z * a)
    )


def turned(q: Tensor, r: Tensor) -> Tensor:
    """Attitude q exp(r / 2) (..., 4) after a turn by the rotation vector r (..., 3) [rad] in body axes."""
    w, x, y, z = columns(q)
    half = 0.5 * torch.sqrt((r * r).sum(-1).clamp_min(1e-16))
    a = torch.cos(half)
    b, c, d = columns(0.5 * torch.sinc(half / torch.pi)[..., None] * r)
    return stack_columns(
        (
            *(w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c),
            *(w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a),
        )
    )


def matrix(q: Tensor) -> Tensor:
    """Rotation matrices, body to world (..., 3, 3), for unit quaternions (..., 4)."""
    square = (q[..., :, None] * q[..., None, :]).flatten(-2)
    return (torch.eye(3).flatten().to(q) + square @ _SQUARES.to(q)).unflatten(-1, (3, 3))


def _squares() -> Tensor:
    """R - I as a function of q q^T (16, 9), by polarisation of the polynomial that `rotate` is."""
    axes, eye = torch.eye(4), torch.eye(3)

    def turn(q: Tensor) -> Tensor:
        return torch.stack([rotate(q, e) - e for e in eye], -1).flatten()

    return torch.stack([0.5 * (turn(a + b) - turn(a) - turn(b)) for a in axes for b in axes])


_SQUARES = _squares()
_RATE = torch.stack([quaternion_rate(a, b) for a in torch.eye(4) for b in torch.eye(3)])
"""dq/dt as a function of q omega^T (12, 4)."""
