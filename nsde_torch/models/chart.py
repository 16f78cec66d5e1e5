"""A state as a network should see it, and the difference of two states as a network should predict it.

An angle is one number too few, because 0 and a full turn are one place: a network sees its sine and cosine. A unit
quaternion is one number too many, and q and -q are one attitude: a network sees the rotation matrix, and a change of
attitude is the rotation vector in body axes,

    change = 2 log(conj(q) q'),    q' = q exp(change / 2).

All other columns are seen and differ as they are.
"""

import torch
from torch import Tensor

from nsde_torch.columns import columns, stack_columns
from nsde_torch.rotation import rotation_between, turned
from nsde_torch.systems import System

_TURN = 2.0 * torch.pi


class Chart:
    """Inputs and differences of the states of one system.

    Args:
        system: The machine. A column whose error does not see a full turn is taken to be an angle.

    Attributes:
        angles: Columns that are angles.
        width: Columns of `inputs`.
        n_change: Columns of `change`.
    """

    def __init__(self, system: System) -> None:
        self.nx, self.quaternion = system.nx, system.quaternion
        self.angles = _angles(system)
        attitude = () if self.quaternion is None else range(self.quaternion.start, self.quaternion.stop)
        self._plain = [i for i in range(self.nx) if i not in self.angles and i not in attitude]
        self.width = len(self._plain) + 2 * len(self.angles) + (0 if self.quaternion is None else 9)
        self.n_change = self.nx - (0 if self.quaternion is None else 1)

    def inputs(self, x: Tensor) -> Tensor:
        """What a network sees of states (N, nx): (N, width)."""
        angle = x[:, self.angles]
        parts = [x[:, self._plain], torch.sin(angle), torch.cos(angle)]
        if self.quaternion is not None:
            parts.append(_matrix(x[:, self.quaternion]))
        return torch.cat(parts, 1)

    def change(self, x: Tensor, after: Tensor) -> Tensor:
        """From states (N, nx) to states (N, nx), angles the short way round: (N, n_change)."""
        difference = after - x
        if self.angles:
            turn = difference[:, self.angles]
            difference[:, self.angles] = turn - _TURN * torch.round(turn / _TURN)
        if self.quaternion is None:
            return difference
        a, b = self.quaternion.start, self.quaternion.stop
        turn = rotation_between(x[:, self.quaternion], after[:, self.quaternion])
        return torch.cat((difference[:, :a], turn, difference[:, b:]), 1)

    def moved(self, x: Tensor, change: Tensor) -> Tensor:
        """States (N, nx) after changes (N, n_change)."""
        if self.quaternion is None:
            return x + change
        a, b = self.quaternion.start, self.quaternion.stop
        attitude = turned(x[:, self.quaternion], change[:, a : a + 3])
        return torch.cat((x[:, :a] + change[:, :a], attitude, x[:, b:] + change[:, a + 3 :]), 1)


def _angles(system: System) -> list[int]:
    at = torch.zeros(1, system.nx)
    if system.quaternion is not None:
        at[:, system.quaternion.start] = 1.0
    found = []
    for i in range(system.nx):
        if system.quaternion is not None and system.quaternion.start <= i < system.quaternion.stop:
            continue
        round_once = at.clone()
        round_once[:, i] += _TURN
        if bool((system.error(round_once, at).abs() < 1e-4).all()):
            found.append(i)
    return found


def _matrix(q: Tensor) -> Tensor:
    """Rotation matrices, body to world, row by row (N, 9)."""
    w, x, y, z = columns(q)
    return stack_columns(
        (
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )
