"""Copies of systems are whole, share no number, and agree with what the standard way of copying makes."""

import copy
from typing import Any

import pytest
import torch
from torch import nn

from nsde_torch.effects.base import Parametrised
from nsde_torch.systems import make_system

EFFECTS = {
    "mass_spring_damper": ["coulomb_friction", "actuator_lag"],
    "hexacopter": ["motor_lag", "linear_drag"],
}


def anew(system: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The copy that Python makes where a class says nothing of it."""
    with monkeypatch.context() as without:
        without.delattr(Parametrised, "__deepcopy__")
        return copy.deepcopy(system)


@pytest.mark.parametrize("name", EFFECTS)
def test_a_copy_is_what_python_would_make_and_has_numbers_of_its_own(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = make_system(name, effects=EFFECTS[name])
    mine, plain = copy.deepcopy(system), anew(system, monkeypatch)
    for a, b in zip(mine.modules(), plain.modules(), strict=True):
        assert type(a) is type(b)
        assert list(vars(a)) == list(vars(b))
        assert [type(v) for v in vars(a).values()] == [type(v) for v in vars(b).values()]
    before = {k: v.clone() for k, v in system.state_dict().items()}
    for value in mine.parameters():
        nn.init.constant_(value, 7.0)
    assert all(torch.equal(v, before[k]) for k, v in system.state_dict().items())
    theirs, own = list(system.modules()), list(mine.modules())
    assert not {id(m) for m in theirs} & {id(m) for m in own}
    assert mine.with_effects().effect_names == system.effect_names
    mine.set_step(0.5)
    assert system.step != 0.5
