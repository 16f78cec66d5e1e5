"""The search once more without the rows in which a machine with dry friction stands (`nsde_torch.sysid.standing`)."""

from collections.abc import Callable
from dataclasses import replace

from nsde_torch.diagnosis.fitted import fitted_system
from nsde_torch.diagnosis.outcome import Found, Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.selection import Selection, forward_selection
from nsde_torch.effects import effect_class
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import AND, Law
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.sysid.standing import SHARE, moving, slowest


def without_standing(
    log: Log, search: Search, outcome: Outcome, searched: Callable[[Log, Search, Outcome], Outcome]
) -> tuple[Log, Search, Outcome]:
    """The log without the rows in which what has dry friction stands, and the search in it.

    It is taken where friction is found there too: what else was found with these rows may be how friction holds.

    Args:
        log: The log.
        search: The search in its runs.
        outcome: What it concluded.
        searched: Searches a log.
    """
    kept = log, search, outcome
    std = outcome.final.regression.physics.sensor_std
    speeds = slowest(outcome.system, std, log.runs)
    if not speeds or moving(log.runs, speeds)[1] < SHARE:
        return kept
    moved = replace(log, slowest=speeds)
    try:
        again = moved.search(log.runs)
        again.held = set(search.held)
        other = searched(moved, again, outcome)
    except (DataError, NonFiniteError):  # too little is left
        return kept
    if not set(slowest(other.system, std, log.runs)) >= set(speeds):
        return kept
    other = replace(
        other, rounds=[*outcome.rounds, *other.rounds], found=[_as_before(f, outcome) for f in other.found]
    )
    return moved, again, other


def selected_again(search: Search, before: Outcome) -> Selection:
    """What was found in other rows, and what is selected beside it; laws beyond the catalogue are looked for anew.

    Args:
        search: Data and settings.
        before: What was concluded from the other rows.
    """
    declared = search.base(fitted_system(before.declared.regression), warm=True)
    laws = [f.name for f in before.found if is_law(f.name)]
    final = search.base(fitted_system(before.final.regression).without_effects(*laws), warm=True)
    names = [f.name for f in before.found if f.name not in laws]
    start = Selection(declared, final, names, [], before.aside)
    return forward_selection(search, declared, after=start)


def tied(before: Outcome) -> set[str]:
    """Names of what explained the other rows as well as an effect that was found."""
    return {name for f in before.found for tie in f.ties for name in tie.split(AND)}


def _as_before(found: Found, before: Outcome) -> Found:
    """An effect with what all rows said of it.

    What explained them as well stays tied: a part of it is not looked for again. And what tells a dry friction best is
    how it changes at a turn, which was left out: between turns it is a constant, which noise may be too.
    """
    for f in before.found:
        if f.name == found.name:
            ties = tuple(dict.fromkeys([*found.ties, *f.ties]))
            law = effect_class(f.name)
            dry = issubclass(law, Law) and law.dry
            return replace(found, ties=ties, trial=f.trial if dry else found.trial)
    return found
