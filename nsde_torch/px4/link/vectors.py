"""Small vectors and quaternions as tuples of floats.

Loops at hundreds of hertz on one row: a NumPy call costs more than all the arithmetic of a rotation.
"""

from math import acos, atan2, cos, degrees, isfinite, sin, sqrt

Vec = tuple[float, float, float]
Quat = tuple[float, float, float, float]


def rotate(q: Quat, v: Vec) -> Vec:
    """Vector from body to world; `q` (w, x, y, z) of unit length."""
    w, x, y, z = q
    a, b, c = v
    # t = 2 r x v, then v + w t + r x t
    ta, tb, tc = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (a + w * ta + y * tc - z * tb, b + w * tb + z * ta - x * tc, c + w * tc + x * tb - y * ta)


def conjugate(q: Quat) -> Quat:
    """The rotation back."""
    return (q[0], -q[1], -q[2], -q[3])


def rotate_back(q: Quat, v: Vec) -> Vec:
    """Vector from world to body."""
    return rotate(conjugate(q), v)


def multiply(a: Quat, b: Quat) -> Quat:
    w, x, y, z = a
    d, e, f, g = b
    return (
        w * d - x * e - y * f - z * g,
        w * e + x * d + y * g - z * f,
        w * f - x * g + y * d + z * e,
        w * g + x * f - y * e + z * d,
    )


def normalised(q: Quat) -> Quat:
    n = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] * n, q[1] * n, q[2] * n, q[3] * n)


def rotation_vector(q: Quat) -> Vec:
    """Rotation vector [rad] of a unit quaternion, the short way round."""
    w, x, y, z = q if q[0] >= 0 else (-q[0], -q[1], -q[2], -q[3])
    n = sqrt(x * x + y * y + z * z)
    k = 2.0 * atan2(n, w) / n if n > 1e-9 else 2.0
    return (k * x, k * y, k * z)


def from_rotation_vector(r: Vec) -> Quat:
    """Unit quaternion of a rotation vector [rad]."""
    n = length(r)
    k = sin(0.5 * n) / n if n > 1e-9 else 0.5
    return (cos(0.5 * n), k * r[0], k * r[1], k * r[2])


def turned_by_rates(q: Quat, w: Vec, dt: float) -> Quat:
    """Attitude after body rates [rad/s] for a time [s]."""
    return normalised(multiply(q, from_rotation_vector(scaled(w, dt))))


def yaw_of(q: Quat) -> float:
    """Heading [rad] of the body's x axis, counted from world x towards world y."""
    w, x, y, z = q
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def cos_tilt(q: Quat) -> float:
    """Cosine of the angle between the body's z axis and up."""
    return 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])


def tilt_of(q: Quat) -> float:
    """Angle between the body's z axis and up [deg]."""
    return degrees(acos(min(max(cos_tilt(q), -1.0), 1.0)))


def parts(row: tuple[float, ...]) -> tuple[Vec, Vec, Quat, Vec]:
    """Position, velocity, attitude and rates of a state of 13 numbers."""
    px, py, pz, vx, vy, vz, qw, qx, qy, qz, wx, wy, wz = row
    return (px, py, pz), (vx, vy, vz), (qw, qx, qy, qz), (wx, wy, wz)


def plus(a: Vec, b: Vec, k: float = 1.0) -> Vec:
    """The sum a + k b."""
    return (a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2])


def scaled(v: Vec, k: float) -> Vec:
    """The product k v."""
    return (k * v[0], k * v[1], k * v[2])


def bounded(v: Vec, most: float) -> Vec:
    """Each component within plus and minus a bound."""
    x, y, z = (min(max(c, -most), most) for c in v)
    return (x, y, z)


def length(v: Vec) -> float:
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


def distance(a: Vec, b: Vec) -> float:
    return length(plus(a, b, -1.0))


def between(a: Vec, b: Vec, share: float) -> Vec:
    """The vector at a share of the way from one to another."""
    return (a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1]), a[2] + share * (b[2] - a[2]))


def finite(*values: float) -> bool:
    return all(map(isfinite, values))
