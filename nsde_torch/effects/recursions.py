"""Memory of effects along a run, row after row, compiled: loops that no array operation replaces.

Imported where they are run: Numba takes half a second to import, and only identification needs them.
"""

from math import exp, log

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.jit import compiled


@compiled
def play(u: Array, gap: float) -> Array:
    """What acts of inputs (n, nu) through play of a width of twice the gap (n, nu)."""
    out = np.empty_like(u)
    for k in range(u.shape[1]):
        acts = u[0, k]
        for i in range(u.shape[0]):
            acts = min(max(acts, u[i, k] - gap), u[i, k] + gap)
            out[i, k] = acts
    return out


@compiled
def two_lags(u: Array, rising: float, falling: float) -> Array:
    """Memory (n, nu) at the starts of steps that inputs (n, nu) are held over, which begins at the first of them.

    Of the distance to the input, a share stays after each step: `rising` below it, `falling` above it.
    """
    out = np.empty_like(u)
    for k in range(u.shape[1]):
        m = u[0, k]
        for i in range(u.shape[0]):
            out[i, k] = m
            late = u[i, k] - m
            m = u[i, k] - late * (rising if late > 0 else falling)
    return out


@compiled
def rate_limited(u: Array, most: float) -> Array:
    """Memory (n, nu) at the starts of steps that inputs (n, nu) are held over, which follows them by so much a step."""
    out = np.empty_like(u)
    for k in range(u.shape[1]):
        m = u[0, k]
        for i in range(u.shape[0]):
            out[i, k] = m
            m += min(max(u[i, k] - m, -most), most)
    return out


@compiled
def second_order(over: Array, start: Array, v: Array, slope: Array) -> Array:
    """Two states (n + 1, 2 d) of a linear equation, those of all directions beside one another, along a drive (n, d).

    The drive is straight over each step, with a slope (n, d); the states begin at `start` (2, d). `over` (2, 4) is what
    states, drive and slope at the start of a step make of the states at its end.
    """
    ways = v.shape[1]
    out = np.empty((len(v) + 1, 2 * ways))
    for k in range(ways):
        a, b = start[0, k], start[1, k]
        out[0, k], out[0, ways + k] = a, b
        for i in range(len(v)):
            a, b = (
                over[0, 0] * a + over[0, 1] * b + over[0, 2] * v[i, k] + over[0, 3] * slope[i, k],
                over[1, 0] * a + over[1, 1] * b + over[1, 2] * v[i, k] + over[1, 3] * slope[i, k],
            )
            out[i + 1, k], out[i + 1, ways + k] = a, b
    return out


@compiled
def bouc_wen(ways: Array, z: float, weight: float) -> Array:
    """Hysteresis z (n + 1,) along ways (n,), as multiples of its reach, from its value at the start.

    While a way keeps its sign, z is one exponential up to nothing, a line where the weight of |v| z is a half, and
    another one beyond.
    """
    out = np.empty(len(ways) + 1)
    out[0] = z
    bend = 2.0 * weight - 1.0
    for i in range(len(ways)):
        side = 1.0 if ways[i] > 0 else -1.0
        z, left = side * z, abs(ways[i])
        if z < 0.0:
            curved = abs(bend) > 1e-6
            to_nothing = log(1.0 - bend * z) / bend if curved else -z
            way = min(left, to_nothing)
            if way < to_nothing:
                z += (1.0 - bend * z) * (1.0 - exp(-bend * way)) / bend if curved else way
            else:
                z = 0.0
            left -= way
        z = side * (1.0 - (1.0 - z) * exp(-left) if left > 0 else z)
        out[i + 1] = z
    return out
