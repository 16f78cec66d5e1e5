"""A law that is the same function as an effect of the catalogue takes that effect's name.

Terms of the library (`law_terms`) and effects of the catalogue meet: `force = c1 x^3` is a cubic stiffness. The law may
have been the likelier of the two by its spelling alone, as the same evidence is judged run by run there. At the states
and inputs of the data both are worked out; where one is a multiple of the other, the effect is fitted in its place.
"""

from dataclasses import replace

import numpy as np
import torch

from nsde_torch.diagnosis.candidates import candidate_names, make_candidate
from nsde_torch.diagnosis.elimination import Retained
from nsde_torch.diagnosis.fitted import effect_of, fitted_system
from nsde_torch.diagnosis.outcome import base_without
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.selection import Selection
from nsde_torch.diagnosis.trials import fit_candidate
from nsde_torch.effects import Effect, Parameter, Port, effect_class
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.errors import NsdeError
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by

_SAME = 1e-6  # of its length: what a multiple may be away; both are worked out in double precision
_ROWS = 5000  # of the data, evenly chosen


def named_by_the_catalogue(search: Search, chosen: Selection, kept: Retained) -> Retained:
    """What elimination kept, laws that the catalogue has under its names.

    Args:
        search: Data and settings.
        chosen: What forward selection added.
        kept: What elimination kept.
    """
    for f in list(kept.found):
        name = _same(search, kept.final.system, f.name) if is_law(f.name) else None
        if name is None:
            continue
        without = base_without(search, kept.final, chosen.declared, f.name)
        system = fitted_system(without.regression)
        system = system.with_effects(make_candidate(name, system, {}))
        try:
            trial = fit_candidate(search, without, system, name, among=1)
        except (NsdeError, np.linalg.LinAlgError):  # the law stays, by its own name
            continue
        trial = replace(trial, p=f.trial.p, p_corrected=f.trial.p_corrected)  # it was looked for as the law
        found = [replace(g, name=name, trial=trial) if g is f else g for g in kept.found]
        kept = replace(kept, found=found, final=search.grown(trial.regression))
    return kept


def _same(search: Search, system: System, law: str) -> str | None:
    """Name of an effect of the catalogue that is a multiple of a law at the states of the data."""
    own = effect_of(system, law)
    if own.port is Port.INPUT:
        return None
    mine = _pushes(search, system, own)
    for name in candidate_names(system):
        cls = effect_class(name)
        if cls.port is not own.port or cls.exogenous:
            continue
        other = make_candidate(name, system, {k: _size(cls.PARAMETERS[k]) for k in cls.amplitudes})
        if other.n_memory:
            continue
        theirs = _pushes(search, system, other)
        if theirs.shape != mine.shape or not (theirs @ theirs > 0 and mine @ mine > 0):
            continue
        off = theirs - mine * float(theirs @ mine) / float(mine @ mine)
        if float(off @ off) <= _SAME**2 * float(theirs @ theirs):
            return name
    return None


def _size(parameter: Parameter) -> float:
    """Some size that is not nothing, within bounds."""
    low, high = parameter.low or 0.0, parameter.high
    return low + (1.0 if high is None else 0.5 * (high - low))


@torch.no_grad()
def _pushes(search: Search, system: System, effect: Effect) -> np.ndarray:
    """What an effect without memory adds at some of the data's states, row after row of its port."""
    s, machine, own = search.steps, system.double(), effect.double()
    some = torch.linspace(0, len(s) - 1, min(len(s), _ROWS)).long()
    t, x, u = s.t[some], s.x0[some], s.u[some]
    z = machine.augment(x, u)
    return np.asarray(own(t, x, seen_by(machine, own, t, z, u), z[:, :0]).numpy()).ravel()
