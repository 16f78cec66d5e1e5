"""NED world and FRD body (as PX4 logs them) to ENU world and FLU body (as everything else here has them).

    v_ENU = (v_E, v_N, -v_D)        w_FLU = (w_F, -w_R, -w_D)
    q_ENU<-FLU = q_ENU<-NED  q_NED<-FRD  q_FRD<-FLU

where `q_ENU<-NED` is half a turn about (1, 1, 0) and `q_FRD<-FLU` half a turn about x. Both vector maps are
their own inverses, so the same functions lead back.
"""

from __future__ import annotations

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.quaternion import multiply

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
    world, body = np.broadcast_to(_WORLD, q.shape), np.broadcast_to(_BODY, q.shape)
    # the product comes out with the opposite sign, which is the same attitude; w > 0 reads better for level
    # flight
    return -multiply(multiply(world, q), body)


def attitude_between(q: Array, *, ned: bool, frd: bool) -> Array:
    """Quaternions `w x y z` (..., 4) to FLU-to-ENU from those of another world or another body.

    Args:
        q: Body to world.
        ned: Whether the world is NED, else ENU.
        frd: Whether the body is FRD, else FLU.
    """
    if ned and frd:
        return attitude_to_enu(q)
    if ned:
        return multiply(np.broadcast_to(_WORLD, q.shape), q)
    return multiply(q, np.broadcast_to(_BODY, q.shape)) if frd else q
