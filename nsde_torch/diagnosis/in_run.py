"""The effect of the catalogue that would explain one run by itself: a lead, where that run alone has something.

The physics with everything that was found is fitted to that run, and the catalogue is looked at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.estimates import Estimate, estimates
from nsde_torch.diagnosis.rounds import look
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.selection import choice
from nsde_torch.diagnosis.shape import Shape
from nsde_torch.errors import DataError
from nsde_torch.systems import System


@dataclass(frozen=True)
class InRun:
    """An effect that one run seems to have.

    Args:
        run: Number of the run.
        effect: Name of the effect.
        estimates: Its parameters, fitted to that run.
        held: Names of those that were held at nothing.
        p: Chance of it in that run, corrected for the number of candidates.
    """

    run: int
    effect: str
    estimates: tuple[Estimate, ...]
    held: tuple[str, ...]
    p: float


def odd_run(left: Sequence[Dependence], shapes: Sequence[Shape]) -> int | None:
    """Number of the run that what explains most of what is left is confined to, beside single moments.

    Args:
        left: What is left over, what explains most first.
        shapes: The first of them in words.
    """
    pairs = zip(left, shapes, strict=False)
    return next((s.only_run for d, s in pairs if d.moment is None), None)


def in_run(search: Search, system: System, run: int) -> InRun | None:
    """The effect that would explain a run, or None where none does.

    Args:
        search: In that run alone.
        system: Physics with everything that was found.
        run: Number of the run.
    """
    try:
        trials = look(search, search.base(system)).trials
    except DataError:  # it moves too little to be fitted by itself
        return None
    found = choice(search, trials, ())
    if found is None:
        return None
    values = tuple(estimates(found.regression, found.spread, found.name))
    return InRun(run, found.name, values, tuple(found.held), found.p_corrected)
