"""An effect of the catalogue that only comes near to the law that is there.

A force `x^2 x_dot` on a cart is well explained by a dry friction where nothing else is offered, and what it leaves is
small or learned by the noise model: no structure is left that laws would be tried for. A moment `|v_y| v_y` of a
multirotor passes for one of `v_y`. So each effect is held against a library of terms (`laws`), linearised from the
physics without the effect: of all positions and speeds, where it acts on a coordinate; else of what the tests of
structure name without it, on the rows of its port. The few that do no worse are fitted. Where one of them explains
surely more, laws are tried in its place.
"""

from collections.abc import Sequence
from math import log

import numpy as np

from nsde_torch.diagnosis.elimination import Retained
from nsde_torch.diagnosis.fitted import effect_of, fitted_system, moved_channels
from nsde_torch.diagnosis.laws import Library, library, wanted_variables, worth_a_fit
from nsde_torch.diagnosis.left_over import beyond_chance, variables_of
from nsde_torch.diagnosis.outcome import base_without
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.screening import joined, screen
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection
from nsde_torch.diagnosis.specification import dependences
from nsde_torch.diagnosis.trials import fit_candidate, with_own_noise
from nsde_torch.effects import Law, Port
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.errors import NsdeError


def a_law_is_nearer(search: Search, chosen: Selection, kept: Retained, name: str) -> bool:
    """Whether a term that no catalogue has explains surely more than an effect does.

    Args:
        search: Data and settings.
        chosen: What forward selection added.
        kept: What elimination kept.
        name: Of the effect.
    """
    system = fitted_system(kept.final.regression)
    effect = effect_of(system, name)
    if is_law(name) or effect.n_memory or effect.exogenous or effect.port is Port.INPUT:
        return False
    without = base_without(search, kept.final, chosen.declared, name)
    variables, moved = variables_of(search, without), moved_channels(kept.final.regression, name)
    if isinstance(effect, Law):
        wanted, port = _of_coordinates(without, variables), ""
    else:
        wanted, port = _of_tests(search, without, variables, moved), effect.port.value
    if not wanted:
        return False
    found = library(search, without, moved, wanted, variables, port=port)
    if found is None:
        return False
    least = kept.final.score.fitted + log(found.tried) + search.decisions.alike_nats
    try:
        own, _ = screen(search, without, system, name, ())
        power = 0.5 * np.square(found.pull)
        # the noise model without the effect may have learned it: what is no less is fitted
        rivals = [j for j in worth_a_fit(found.laws, power, search) if power[j] >= own]
        return any(_fitted(search, without, found, j) > least for j in rivals)
    except (NsdeError, np.linalg.LinAlgError):  # what cannot be fitted is no nearer
        return False


def _of_coordinates(base: Base, variables: Regressors) -> list[str]:
    """All positions and speeds of a machine."""
    system = base.regression.vector.system
    names = system.state_names
    all_of = [
        names[k] for at in system.bound_coordinates() for k in (at.position, at.velocity) if k is not None
    ]
    return [v for v in dict.fromkeys(all_of) if v in variables.columns]


def _of_tests(search: Search, base: Base, variables: Regressors, channels: Sequence[str]) -> list[str]:
    """What some channels depend on beyond chance."""
    tests = dependences(base.regression, variables)
    left = beyond_chance(tests, {}, alpha=search.levels("effects")["structure"])
    own = [d for d in left if d.channel in channels]
    return wanted_variables(base.regression, own, tests, variables) if own else []


def _fitted(search: Search, without: Base, found: Library, j: int) -> float:
    """Log-likelihood of all rows with a term of the library, less one for each parameter of the noise [nats]."""
    law = found.laws[j]
    start = joined(fitted_system(without.regression), law, {**found.starts[j]})
    trial = fit_candidate(search, without, start, law, among=1)
    return with_own_noise(search, without, trial, 1).score.fitted
