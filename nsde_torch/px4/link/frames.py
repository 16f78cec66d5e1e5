"""The border between PX4 (NED world, FRD body) and everything else here (ENU world, FLU body).

    v_ENU = (v_E, v_N, -v_D)        w_FLU = (w_F, -w_R, -w_D)
    q_ENU<-FLU = (w + z, x + y, x - y, w - z) / sqrt(2),        q_NED<-FRD = (w, x, y, z)

The last line is `q_ENU<-NED q_NED<-FRD q_FRD<-FLU` multiplied out (half turns about (1, 1, 0) and about x). Each map
is its own inverse. Quaternions are `w x y z`, body to world, on both sides.
"""

from math import sqrt

from nsde_torch.px4.link.vectors import Quat, Vec

_S = sqrt(0.5)


def world(v: Vec) -> Vec:
    """A vector in the world from NED to ENU, or back."""
    return (v[1], v[0], -v[2])


def body(v: Vec) -> Vec:
    """A vector in the body from FRD to FLU, or back."""
    return (v[0], -v[1], -v[2])


def attitude(q: Quat) -> Quat:
    """An attitude from FRD-to-NED to FLU-to-ENU, or back."""
    w, x, y, z = q
    return (_S * (w + z), _S * (x + y), _S * (x - y), _S * (w - z))
