"""Effects selected from gains that have not gone to nothing.

In a closed loop inputs cancel what the physics lacks. Where they cancel nearly all of it (a moment of the blades that
grows with the speed, a trim that follows the battery), what they do is seen in the fast band alone; and where a lag is
lacking too, not even there. Then the likelihood has two optima. In the one gains are nothing and the noise explains
what is left, and no effect alone leads out of it: without gains a lag does nothing, and a moment explains nothing.
In the other one gains are there, and two effects besides. So, where a declared parameter is a small part of its first
value (`GONE` of the guard), effects are selected once more with such parameters held at their first values, and the
parameters are free again beside what was found. That is taken where one of them stays, and the held-out
log-likelihood is surely above that of the declared physics, and the selection goes on from there; else effects are
selected as ever.
"""

import copy
from collections.abc import Mapping

from nsde_torch.diagnosis.evidence import sum_error
from nsde_torch.diagnosis.fitted import effect_of, fitted_system
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection, forward_selection
from nsde_torch.sysid.guard import GONE
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector


def select(search: Search, system: System) -> Selection:
    """Effects that the declared physics lacks, selected from parameters that are there.

    Args:
        search: Data and settings.
        system: Declared physics with its first values.
    """
    declared = search.base(system)
    vector = ParameterVector(system)
    first = {k: v for k, v in zip(vector.labels, vector.start.tolist(), strict=True) if "." not in k}
    gone = _gone(declared.regression, first)
    out = _from_first_values(search, declared, system, first, gone) if gone else None
    return forward_selection(search, declared) if out is None else out


def _gone(regression: Regression, first: Mapping[str, float]) -> set[str]:
    """Declared parameters that are a small part of their first values; those of effects may well be nothing."""
    now = dict(zip(regression.vector.labels, regression.theta.tolist(), strict=True))
    return {label for label, value in first.items() if GONE * abs(now[label]) < abs(value)}


def _from_first_values(
    search: Search, declared: Base, system: System, first: Mapping[str, float], gone: set[str]
) -> Selection | None:
    """What is selected with parameters that had gone held at their first values; None where that is no better."""
    held = copy.copy(search)
    held.held = search.held | gone
    chosen = forward_selection(held, held.base(system))
    if not chosen.names:
        return None
    free = copy.copy(held)
    free.held = held.held - gone
    final = free.base(fitted_system(chosen.final.regression), warm=True, like=chosen.final.regression)
    difference = final.score.blocks - declared.score.blocks
    sure = search.decisions.alike_errors * sum_error(difference)
    if gone <= _gone(final.regression, first) or float(difference.sum()) <= sure:
        return None
    search.held = free.held
    if chosen.aside:
        short = [effect_of(final.system, name) for name in chosen.aside]
        declared = search.base(declared.system.with_effects(*short), warm=True, like=declared.regression)
    freed = Selection(declared, final, chosen.names, chosen.rounds, chosen.aside)
    return forward_selection(search, declared, after=freed)
