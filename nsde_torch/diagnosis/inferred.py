"""A diagnosis of a log whose rates no sensor measured: they are inferred with the physics that it has come to.

First with the declared physics, fitted; then with what was found, until that stays. What an effect does to rates that
were inferred without it would else pass for less than it is.
"""

from collections.abc import Callable
from dataclasses import replace

from nsde_torch.diagnosis.fitted import fitted_system
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.sysid.inferred_rates import with_rates
from nsde_torch.systems import System

_SEVERAL = "the rates of several coordinates were inferred from positions"
_TURNS = 2  # of fits of the declared physics, and of searches


def at_declared(log: Log) -> Log:
    """The log with inferred rates as the declared physics foretells them; the log itself where none are inferred.

    Args:
        log: The log.
    """
    system = log.system
    for _ in range(_TURNS if log.runs[0].inferred else 0):
        log = _at(log, system)
        system = fitted_system(log.search(log.runs).quick(system))
    return _at(log, system)


def at_found(
    log: Log, search: Search, outcome: Outcome, searched: Callable[[Log, Search], Outcome]
) -> tuple[Log, Search, Outcome]:
    """The log with inferred rates as what was found foretells them, and the search in it.

    Args:
        log: The log.
        search: The search in its runs.
        outcome: What it concluded.
        searched: Searches a log.
    """
    for _ in range(_TURNS if log.runs[0].inferred and outcome.found else 0):
        before = {one.name for one in outcome.found}
        log = _at(log, outcome.system)
        search = log.search(log.runs)
        outcome = searched(log, search)
        if {one.name for one in outcome.found} == before:
            break
    return log, search, outcome


def not_sure(log: Log, outcome: Outcome) -> Outcome:
    """The outcome; nothing that was found is sure where the rates of several coordinates were inferred.

    What is not known of one rate bends the forces on all of them, and dampings that are not there were named.
    """
    if len(log.runs[0].inferred) < 2:
        return outcome
    return outcome.provisional(lambda _: _SEVERAL)


def _at(log: Log, system: System) -> Log:
    return replace(log, runs=tuple(with_rates(system, log.runs, log.recorded.clock)))
