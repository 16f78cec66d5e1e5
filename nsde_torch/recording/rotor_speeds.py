"""Speeds of rotors as inputs: their glitches, and the shares of thrust that they stand for.

A rotor at speed n pulls with k n^2 (momentum theory), so that the share of its thrust at the largest speed is

    u = (n / n_max)^2.

A speed controller reports over a noisy line. A rotor has inertia, and so a value is a glitch where for a few rows it
leaves what lies on both sides of it, by more than a tenth of n_max and by 8 times what the column usually changes in
that time: a row of nothing, or of ten times the range. Glitches are put on the line between their neighbours.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nsde_torch.errors import DataError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SHARE, _CHANGES = 0.1, 8.0
_BEYOND = 1.2
"""Share of the largest speed beyond which a value is no speed, however long it lasts."""
_LONGEST, _AROUND = 4, 5  # rows of a glitch at most (two, held at half the rate), and rows on each side
_MOST = 0.05  # share of rows; more is how the column is


def glitches(speed: Array, most: float) -> Mask:
    """Rows (n,) of a column of speeds that no rotor can have had.

    Args:
        speed: Speeds (n,); nan where there is none.
        most: Largest speed of the rotor.
    """
    n = len(speed)
    bad: Mask = np.isfinite(speed) & ((np.abs(speed) > _BEYOND * most) | (speed < -_SHARE * most))
    changes = np.abs(np.diff(speed[np.isfinite(speed) & ~bad]))
    if not len(changes):
        return bad
    least = max(_SHARE * most, _CHANGES * float(np.quantile(changes, 0.9)))
    for _ in range(2):  # a glitch beside another one shows once that is known
        held = np.flatnonzero(np.diff(speed, prepend=np.nan, append=np.nan) != 0)
        good = np.where(bad, np.nan, speed)
        for a, b in pairwise(held.tolist()):
            if b - a > _LONGEST or bad[a]:
                continue
            before, behind = good[max(0, a - _AROUND) : a], good[b : b + _AROUND]
            before, behind = before[np.isfinite(before)], behind[np.isfinite(behind)]
            if not len(before) or not len(behind):
                continue
            low, high = min(before[-1], behind[0]), max(before[-1], behind[0])
            if speed[a] < low - least or speed[a] > high + least:
                bad[a:b] = True
        if bad.sum() > _MOST * n:
            break
    return bad


def mended(speed: Array, bad: Mask) -> Array:
    """The column with glitches put on the line between their neighbours.

    Args:
        speed: Speeds (n,).
        bad: Rows that are glitches (n,).
    """
    rows = np.arange(len(speed))
    good = np.isfinite(speed) & ~bad
    out = speed.copy()
    out[bad] = np.interp(rows[bad], rows[good], speed[good])
    return out


def shares(speed: Array, most: float, *, name: str, where: str) -> tuple[Array, list[int]]:
    """Shares of the largest thrust (n,) from speeds, and rows that were glitches.

    Args:
        speed: Speeds of one rotor (n,), in the unit of `most`.
        most: Speed that counts as full thrust.
        name: Name of the column, for messages.
        where: Name of the run, for messages.

    Raises:
        DataError: speeds that are not of this range, or more glitches than a column has.
    """
    seen = speed[np.isfinite(speed)]
    if not len(seen):
        return speed, []
    usual = float(np.quantile(np.abs(seen), 0.9))
    if not 0.05 * most < usual < _BEYOND * most:
        raise DataError(
            f"{where}: rotor speed {name!r} is at most {usual:.4g} in nine rows of ten, where {most:.4g} is full "
            "thrust. "
            "Give `data.rotor_speed` in the unit of the column (electrical turns are the rotor's times its pole pairs)."
        )
    bad = glitches(speed, most)
    if bad.mean() > _MOST:
        raise DataError(
            f"{where}: {bad.mean():.0%} of the rows of rotor speed {name!r} are beyond {_BEYOND:g} times {most:.4g}, "
            "or leave their neighbours by more than a rotor can. Expected at most "
            f"{_MOST:.0%}; check the column, and `data.rotor_speed`."
        )
    return np.square(np.maximum(mended(speed, bad), 0.0) / most), np.flatnonzero(bad).tolist()
