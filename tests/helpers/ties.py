"""A spring whose friction two laws explain, and what may be true of it."""

from dataclasses import dataclass

import numpy as np

from nsde_torch.data import Run
from nsde_torch.design import Question
from nsde_torch.design.limits import limits_of
from nsde_torch.design.members import Member, open_loop
from nsde_torch.design.rehearsal import Rehearsed, rehearse
from nsde_torch.systems import System

BIASED, SIDED = ("coulomb_friction", "constant_force"), ("asymmetric_friction",)
TRUE = ({"coulomb_friction": {"size": 0.2, "width": 0.02}}, {"constant_force": {"acceleration": 0.06}})
DT = 0.05


@dataclass(frozen=True)
class Tie:
    """Runs of a spring with dry friction and a steady push, and the two members that explain them."""

    system: System
    runs: tuple[Run, ...]
    question: Question
    members: tuple[Member, ...]

    def rehearsed(self, truth: int, table: np.ndarray, *, count: int, seed: int) -> Rehearsed:
        """A plan (N, 1) from rest, rehearsed with a member true."""
        limits, rng = limits_of(self.system, self.runs, {}), np.random.default_rng(seed)
        how = {"start": np.zeros(2), "limits": limits, "drive": open_loop, "rng": rng}
        (told,) = rehearse(self.members, table[None], truth=truth, count=count, **how)  # type: ignore[arg-type]
        return told
