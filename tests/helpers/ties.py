"""A spring whose friction two laws explain, and what may be true of it."""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.data import Run
from nsde_torch.design import Question
from nsde_torch.design.members import Member
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
