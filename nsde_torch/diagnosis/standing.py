"""The search once more without the rows in which a machine with dry friction stands (`nsde_torch.sysid.standing`)."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects import effect_class
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.sysid.standing import SHARE, moving, slowest

MUCH = 0.3
"""Share of the rows in which a coordinate stands or turns round, beyond which friction may hold it."""

_STANDS = "the machine mostly stands, and where it moves this is not found: friction may hold it"


def without_standing(
    log: Log, search: Search, outcome: Outcome, searched: Callable[[Log, Search, Outcome | None], Outcome]
) -> tuple[Log, Search, Outcome]:
    """The log without the rows in which what has dry friction stands, and the search in it.

    It is taken where friction is found there too: what else was found with these rows may be how friction holds. And
    friction may hold the machine so long that it is not found with them, or looks like a deadband: where a coordinate
    stands for much of the time, or nothing explains the structure that is left, whatever may have friction is looked at
    where it moves.

    Args:
        log: The log.
        search: The search in its runs.
        outcome: What it concluded.
        searched: Searches a log, from what was concluded of other rows or from the declared physics.
    """
    speeds = _dry(outcome, log)
    if not speeds:
        std = outcome.final.regression.physics.sensor_std
        candidates = [effect_class(name) for name in candidate_names(log.system, search.candidates)]
        speeds = slowest(log.system, std, log.runs, candidates)
        stands = max((moving(log.runs, {j: v})[1] for j, v in speeds.items()), default=0.0)
        if stands < MUCH and (outcome.found or not outcome.structured):
            return log, search, outcome
        there = _where_it_moves(log, None, speeds, searched)
        if there is None or not _dry(there[2], log):
            return log, search, outcome if stands < MUCH else _held(outcome, there)
        log, search, outcome = there
        speeds = _dry(outcome, log)
        if speeds.keys() == log.slowest.keys():
            return log, search, outcome
    there = _where_it_moves(log, outcome, speeds, searched)
    if there is None or not _dry(there[2], log).keys() >= speeds.keys():
        return log, search, outcome
    return there


def _where_it_moves(
    log: Log,
    before: Outcome | None,
    speeds: Mapping[int, float],
    searched: Callable[[Log, Search, Outcome | None], Outcome],
) -> tuple[Log, Search, Outcome] | None:
    """Log, search and outcome without rows that are slower; None where these are too few, or too many."""
    if moving(log.runs, speeds)[1] < SHARE:
        return None
    moved = replace(log, slowest=speeds)
    try:
        again = moved.search(log.runs)
        return moved, again, searched(moved, again, before)
    except (DataError, NonFiniteError):
        return None


def _dry(outcome: Outcome, log: Log) -> dict[int, float]:
    """Speeds whose direction is not known, of coordinates in which dry friction was found or declared."""
    return slowest(outcome.system, outcome.final.regression.physics.sensor_std, log.runs)


def _held(outcome: Outcome, there: tuple[Log, Search, Outcome] | None) -> Outcome:
    """The outcome of a machine that mostly stands: what is not found where it moves is no last word."""
    names = set() if there is None else {f.name for f in there[2].found}
    return outcome.provisional(lambda f: "" if f.name in names else _STANDS)
