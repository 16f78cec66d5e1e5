"""Roll, pitch, yaw of quaternions for people's eyes: q = q_z(yaw) q_y(pitch) q_x(roll), in degrees.

Yaw and roll are continuous in time (no jump at 180 degrees). At a pitch of 90 degrees roll and yaw are not
defined apart from each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsde_torch.arrays import Array

ANGLES = ("roll", "pitch", "yaw")


def roll_pitch_yaw(q: Array) -> Array:
    """Angles (..., n, 3) [deg] of unit quaternions w x y z (..., n, 4), unwrapped along n.

    Args:
        q: Unit quaternions, body to world; the last axis but one is time.
    """
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles = np.stack([np.unwrap(roll, axis=-1), pitch, np.unwrap(yaw, axis=-1)], axis=-1)
    degrees: Array = np.degrees(angles)
    return degrees


def turns_nearest(angles: Array, reference: Array) -> Array:
    """Angles (..., n, 3) [deg] moved by whole turns, so that they start nearest to the reference (n, 3)."""
    turns = np.round((angles[..., :1, :] - reference[..., :1, :]) / 360.0)
    moved: Array = angles - 360.0 * turns
    return moved


def with_angles(
    measured: Array, samples: Array, names: Sequence[str], units: Sequence[str], quaternion: slice
) -> tuple[Array, Array, list[str], list[str]]:
    """The columns of the quaternion replaced by roll, pitch, yaw in degrees.

    Args:
        measured: States (n, nx).
        samples: States (P, n, nx).
        names: Names of the columns.
        units: Units of the columns.
        quaternion: Columns of the quaternion.

    Returns:
        measured (n, nx - 1), samples (P, n, nx - 1), names, units.
    """
    true = roll_pitch_yaw(measured[:, quaternion])
    drawn = turns_nearest(roll_pitch_yaw(samples[..., quaternion]), true)
    a, b = quaternion.start, quaternion.stop

    def joined(x: Array, angles: Array) -> Array:
        return np.concatenate([x[..., :a], angles, x[..., b:]], axis=-1)

    return (
        joined(measured, true),
        joined(samples, drawn),
        [*names[:a], *ANGLES, *names[b:]],
        [*units[:a], *("deg",) * 3, *units[b:]],
    )
