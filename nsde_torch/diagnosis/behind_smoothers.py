"""States that were smoothed before they were logged, in a loop that is closed.

A smoother spreads the noise of a row over its neighbours. An input that answers the noise of its row therefore answers
a part of what the rows after it will show, and seems to do less, or later, than it does: on a hexacopter that lacked
nothing, behind a Gaussian filter at 12.9 Hz, a delay of one row brought 366 nats, and none from the raw log. So effects
with memory that act on inputs are no candidates there. Where one of them would explain more beside what was found, a
lag that is there may be what was found in its place, and all of it is a lead.
"""

import copy
from dataclasses import replace

from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.joint_selection import JointSelection, looked
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects import Port, effect_class
from nsde_torch.systems import System


def behind_smoothers(search: Search, system: System) -> Search:
    """The search without effects with memory that act on inputs.

    Args:
        search: Data and settings.
        system: The declared physics.
    """
    return _among(search, [n for n in candidate_names(system, search.candidates) if not _timed(system, n)])


def with_suspects(found: JointSelection, search: Search, system: System) -> JointSelection:
    """A selection, with what was no candidate and would explain more beside it.

    Args:
        found: What was selected.
        search: Data and settings, all candidates among them.
        system: The declared physics.
    """
    if not found.selected:
        return found
    some = _among(search, [n for n in candidate_names(system, search.candidates) if _timed(system, n)])
    return replace(found, suspected=tuple(p.name for p in looked(some, found.final).accepted))


def not_sure_behind_smoothers(outcome: Outcome) -> Outcome:
    """The outcome, nothing sure where what is no candidate behind a smoother would explain more."""
    joint = outcome.joint
    if joint is None or not joint.suspected:
        return outcome
    why = (
        f"the states were smoothed and the inputs answer them: {joint.suspected[0]}, or what looks like it behind a "
        "smoother, may be what was found"
    )
    return outcome.provisional(lambda _: why)


def _timed(system: System, name: str) -> bool:
    """Whether an effect acts on inputs with a memory."""
    return effect_class(name).port is Port.INPUT and system.make_effect(name, {}).n_memory > 0


def _among(search: Search, names: list[str]) -> Search:
    out = copy.copy(search)
    out.candidates = names
    return out
