"""Parameters with which a machine can be flown.

What runs leave open of gains that feedback hides is wide, and with some of it the cascade that flies a plan loses the
machine. The runs there are were flown: such parameters are none of this machine, whatever the quadratic about the
optimum says. A step of the place is flown with each draw, and draws that do not come near are not taken.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.design.members import Member
from nsde_torch.design.rollout import Drive, Rollouts

Array = NDArray[np.float64]

Draw = Callable[[Member, int, np.random.Generator], Array]
"""Draws parameters of a member (count, k), the fitted ones first."""

STEP = np.array([0.3, 0.3, 0.2])
"""Step of the wanted place [m]."""
_TIME = 3.0
_NEAR, _MORE = 0.15, 1.5
"""Distance that must be left after that time [m], or times as much as with the fitted parameters."""
_TRIES = 4


@final
class Flyable:
    """Draws parameters with which a cascade holds the machine.

    Args:
        start: First state (nx,), hovering.
        drive: The cascade, of tables as `Paths` makes them (B, N, 11).
        dt: Step [s].
    """

    def __init__(self, start: Array, drive: Callable[[Array], Drive], dt: float) -> None:
        self._start, self._drive, self._dt = start, drive, dt
        self._table = np.zeros((round(_TIME / dt), 11))
        self._table[:, :3] = start[:3] + STEP

    def __call__(self, member: Member, count: int, rng: np.random.Generator) -> Array:
        """Parameters (count, k), the fitted ones first; these again where too few others can be flown."""
        draws = member.draws(_TRIES * count, rng)
        b = len(draws)
        states, _, _ = Rollouts(member.system, dt=self._dt).run(
            draws,
            np.tile(self._start, (b, 1)),
            self._drive(np.tile(self._table, (b, 1, 1))),
            len(self._table),
        )
        left = np.linalg.norm(states[:, -1, :3] - self._table[-1, :3], axis=1)
        near = np.isfinite(states).all((1, 2)) & (left <= max(_NEAR, _MORE * float(np.nan_to_num(left[0]))))
        near[0] = True
        kept = draws[near][:count]
        return np.concatenate((kept, np.tile(draws[:1], (count - len(kept), 1))))
