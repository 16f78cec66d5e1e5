"""Quaternions, and the frames that logs are written in."""

import numpy as np

from nsde_torch.arrays import Array


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product, (..., 4) with (..., 4)."""
    w1, x1, y1, z1 = np.moveaxis(a, -1, 0)
    w2, x2, y2, z2 = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion, (..., 4)."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: Array, v: Array) -> Array:
    """Vector `v` (..., 3) in the frame that `q` (..., 4) maps to."""
    t = 2.0 * np.cross(q[..., 1:], v)
    rotated: Array = v + q[..., :1] * t + np.cross(q[..., 1:], t)
    return rotated


def rotation_vector(q: Array) -> Array:
    """Rotation vector [rad] of a unit quaternion, the shorter way round, (..., 3)."""
    q = np.where(q[..., :1] < 0, -q, q)
    n = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    factor = np.where(n > 1e-12, 2.0 * np.arctan2(n, q[..., :1]) / np.maximum(n, 1e-300), 2.0)
    return q[..., 1:] * factor


def increments(q: Array) -> Array:
    """Body-frame rotation from each row to the next as rotation vectors [rad], (n, 4) -> (n - 1, 3)."""
    return rotation_vector(multiply(conjugate(q[:-1]), q[1:]))


def continuous_signs(q: Array) -> tuple[Array, int]:
    """Signs chosen so that neighbouring rows lie on one side of the sphere; and the number of flips."""
    flip = np.einsum("ij,ij->i", q[1:], q[:-1]) < 0
    count = int(flip.sum())
    if count == 0:
        return q, 0
    sign = np.concatenate([[1.0], np.cumprod(np.where(flip, -1.0, 1.0))])
    return q * sign[:, None], count


def slerp(a: Array, b: Array, share: Array) -> Array:
    """Great-circle interpolation from `a` to `b` (n, 4), `share` (n,) in [0, 1], the shorter way round."""
    dot = np.einsum("ij,ij->i", a, b)[:, None]
    b = np.where(dot < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), 0.0, 1.0))
    s = share[:, None]
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    wa = np.where(near, 1.0 - s, np.sin((1.0 - s) * angle) / safe)
    wb = np.where(near, s, np.sin(s * angle) / safe)
    q = wa * a + wb * b
    unit: Array = q / np.linalg.norm(q, axis=1, keepdims=True)
    return unit


def euler_zyx(q: Array) -> Array:
    """Roll, pitch, yaw [rad] (yaw about world z, then pitch, then roll), (..., 4) -> (..., 3)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)


def from_euler_zyx(angles: Array) -> Array:
    """Quaternions of roll, pitch and yaw [rad] (yaw about world z, then pitch, then roll), (n, 3) -> (n, 4)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * angles.T), np.sin(0.5 * angles.T)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=1,
    )


# NED world and FRD body (as PX4 logs them) to ENU world and FLU body (as everything else here has them).
#
#     v_ENU = (v_E, v_N, -v_D)        w_FLU = (w_F, -w_R, -w_D)
#     q_ENU<-FLU = q_ENU<-NED  q_NED<-FRD  q_FRD<-FLU
#
# where `q_ENU<-NED` is half a turn about (1, 1, 0) and `q_FRD<-FLU` half a turn about x. Both vector maps are
# their own inverses, so the same functions lead back.

_WORLD = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
_BODY = np.array([0.0, 1.0, 0.0, 0.0])


def swap_world(v: Array) -> Array:
    """Vectors (..., 3) from NED to ENU, or back."""
    return np.stack([v[..., 1], v[..., 0], -v[..., 2]], axis=-1)


def swap_body(v: Array) -> Array:
    """Vectors (..., 3) from FRD to FLU, or back."""
    return v * np.array([1.0, -1.0, -1.0])


def attitude_to_enu(q: Array) -> Array:
    """Quaternions `w x y z` (..., 4) from FRD-to-NED to FLU-to-ENU."""
    return attitude_between(q, ned=True, frd=True)


def attitude_between(q: Array, *, ned: bool, frd: bool) -> Array:
    """Quaternions `w x y z` (..., 4), body to world, to FLU-to-ENU from those of another world (NED) or body (FRD)."""
    q = multiply(np.broadcast_to(_WORLD, q.shape), q) if ned else q
    q = multiply(q, np.broadcast_to(_BODY, q.shape)) if frd else q
    # of both the product has the opposite sign, which is the same attitude; w > 0 reads better for level flight
    return -q if ned and frd else q
