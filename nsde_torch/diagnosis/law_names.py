"""A law that is the same function as an effect of the catalogue takes that effect's name.

Terms of the library (`law_terms`) and effects of the catalogue meet: `force = c1 x^3` is a cubic stiffness. The law may
have been the likelier of the two by its spelling alone, as the same evidence is judged run by run there. At the states
and inputs of the data both are worked out; where one is a multiple of the other, the effect is fitted in its place.
"""

import numpy as np
import torch

from nsde_torch.diagnosis.candidates import Start, candidate_names, make_candidate
from nsde_torch.diagnosis.fitted import effect_of, values_of
from nsde_torch.effects import Effect, Parameter, Port, effect_class
from nsde_torch.errors import ConfigError
from nsde_torch.inference.steps import Steps
from nsde_torch.systems import System
from nsde_torch.systems.vocabulary import seen_by

_SAME = 1e-6  # of its length: what a multiple may be away; both are worked out in double precision
_ROWS = 5000  # of the data, evenly chosen


def same_effect(steps: Steps, system: System, law: str) -> tuple[str, Start] | None:
    """An effect of the catalogue that is a multiple of a law at the states of the data: its name, and its shapes.

    Args:
        steps: The data.
        system: The machine with the law.
        law: Its name.
    """
    own = effect_of(system, law)
    if own.port is Port.INPUT:
        return None
    mine = _pushes(steps, system, own)
    found: list[tuple[str, Start]] = []  # a friction of two sizes is one too, where both are alike
    shapes = [value for name, value in values_of(own).items() if name.startswith("k")]
    for name in candidate_names(system):
        cls = effect_class(name)
        if cls.port is not own.port or cls.exogenous:
            continue
        # a sign of the speed with its width is a dry friction (tests/diagnosis/test_law_names.py)
        shaped = dict(zip(cls.shapes, shapes, strict=True)) if len(cls.shapes) == len(shapes) else {}
        try:
            sizes = {k: _size(cls.PARAMETERS[k]) for k in cls.amplitudes}
            other = make_candidate(name, system, {**sizes, **shaped})
        except ConfigError:  # beyond the bounds of its shapes
            continue
        if other.n_memory:
            continue
        theirs = _pushes(steps, system, other)
        if theirs.shape != mine.shape or not (theirs @ theirs > 0 and mine @ mine > 0):
            continue
        off = theirs - mine * float(theirs @ mine) / float(mine @ mine)
        if float(off @ off) <= _SAME**2 * float(theirs @ theirs):
            found.append((name, shaped))
    return min(found, key=lambda one: len(effect_class(one[0]).PARAMETERS), default=None)


def _size(parameter: Parameter) -> float:
    """Some size that is not nothing, within bounds."""
    low, high = parameter.low or 0.0, parameter.high
    return low + (1.0 if high is None else 0.5 * (high - low))


@torch.no_grad()
def _pushes(steps: Steps, system: System, effect: Effect) -> np.ndarray:
    """What an effect without memory adds at some of the data's states, row after row of its port."""
    machine, own = system.double(), effect.double()
    some = torch.linspace(0, len(steps) - 1, min(len(steps), _ROWS)).long()
    t, x, u = steps.t[some], steps.x0[some], steps.u[some]
    z = machine.augment(x, u)
    return np.asarray(own(t, x, seen_by(machine, own, t, z, u), z[:, :0]).numpy()).ravel()
