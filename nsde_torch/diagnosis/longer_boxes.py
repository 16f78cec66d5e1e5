"""The search once more over longer boxes, where the guard believes the final physics over these alone.

As `nsde_torch.sysid.longer_boxes`: a noise model that has learned the physics of a friction or of a smoother misleads
the whole search. It is repeated over longer boxes where the guard asks for it, where structure is left that nothing of
the catalogue explains, and where nothing was found and more than noise may be left. It is taken where fits of what it
finds are believed over longer boxes and not over shorter ones. Feedback makes no such difference: it pulls fits over
longer boxes towards nothing, and of these the guard says nothing.

Where the guard speaks against nothing over the usual boxes, what was named there is believed. A search over longer ones
that lost some of it (a lag beside a delay, which differ within a few hundredths of a second) is not taken: its physics
is refused over shorter boxes because it lacks what they show.
"""

from collections.abc import Callable
from dataclasses import replace

from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects import effect_class
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.sysid.guard import Guarded, guarded
from nsde_torch.sysid.in_loop import identify_in_loop
from nsde_torch.sysid.longer_boxes import LENGTHS_S, LONGER, asks_for_longer_boxes

LEFT = 0.1
"""Share of a rate that must be left in means over 0.15 s for another search where nothing was found."""


def over_longer_boxes(
    log: Log, search: Search, outcome: Outcome, searched: Callable[[Log, Search], Outcome]
) -> tuple[Log, Search, Outcome, Guarded]:
    """The log, the search in it and its outcome, over longer boxes where only these are believed; and the guard.

    Args:
        log: The log.
        search: That in all runs of the log.
        outcome: What was concluded.
        searched: What is concluded from a log by a search in it.
    """
    guard = guard_of(log, outcome)
    kept = log, search, outcome, guard
    if LENGTHS_S[0] < LONGER * outcome.final.regression.dt:  # the log's own step is as long
        return kept
    asked = asks_for_longer_boxes(guard)
    if not asked and (guard.objections or not _much_is_left(outcome, guard)):
        return kept
    refused = _refused_over_shorter(log, outcome) if asked else None
    if asked and refused is None:
        return kept
    longer = replace(log, box_s=LENGTHS_S[0])
    try:
        again = longer.search(longer.runs)
        other = searched(longer, again)
        there = guard_of(longer, other)
    except (DataError, NonFiniteError):  # runs that are too short for them
        return kept
    if there.objections or not (other.found and other.final.regression.converged):
        return kept
    if not asked and _lost(outcome, other):
        return kept
    refused = refused or _refused_over_shorter(log, other)
    return kept if refused is None else (replace(longer, refused=refused), again, other, there)


def _lost(outcome: Outcome, other: Outcome) -> bool:
    """Whether something that was found is not among what another search found, nor contained in it or part of it."""

    def same(one: str, two: str) -> bool:
        return one == two or one in effect_class(two).includes or two in effect_class(one).includes

    there = [found.name for found in other.found]
    return any(not any(same(found.name, name) for name in there) for found in outcome.found)


def _much_is_left(outcome: Outcome, guard: Guarded) -> bool:
    """Whether something is left that may be an effect which the noise model has learned."""
    alone = not outcome.found and any(c.fit > LEFT * c.measured for c in guard.channels)
    return bool(outcome.structured) or alone


def _refused_over_shorter(log: Log, outcome: Outcome) -> Guarded | None:
    """What speaks against what was found over the usual boxes, where nothing does over longer ones; else None."""
    fitted = identify_in_loop(outcome.system, log.runs, clock=log.recorded.clock, likelihood=False)
    return None if fitted.finer is None else fitted.finer.guard


def guard_of(log: Log, outcome: Outcome) -> Guarded:
    """The final physics held against simple fits; the declared physics, where the columns are read in another way."""
    regression = outcome.final.regression
    basis = regression.shown.basis
    covariance = basis @ outcome.spread.covariance @ basis.T
    found = guarded(regression, log.runs, clock=log.recorded.clock, covariance=covariance)
    if found.objections or not any(is_law(f.name) for f in outcome.found):
        return found
    # laws make up for an angle that is counted from the other side (tests/diagnosis/test_declared.py)
    without = guarded(outcome.declared.regression, log.runs, clock=log.recorded.clock)
    return without if any(o.kind == "reading" for o in without.objections) else found
