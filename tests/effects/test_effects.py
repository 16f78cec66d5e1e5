"""The catalogue as a whole: every effect has its contract, and effects of the user's own are found by name."""

import sys
from pathlib import Path

import pytest
import torch

from nsde_torch.effects import EFFECTS, Effect, Parameter, effects_of
from nsde_torch.errors import ConfigError
from nsde_torch.systems import SYSTEMS, make_system

COGGING = """
import math
import torch
from nsde_torch.effects import Effect, Parameter, Port

class Cogging(Effect):
    port = Port.FORCE
    formula = "-c sin(2 pi q / p)"
    source = "teeth of a linear motor"
    PARAMETERS = {"size": Parameter(0.0, "m/s2", scale=0.1), "pitch": Parameter(0.05, "m", low=0.0)}

    def forward(self, t, x, u, memory):
        return -self.value("size") * torch.sin(2 * math.pi * x[:, :1] / self.value("pitch"))
"""


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "own_effects_of_a_test.py").write_text(COGGING)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_effects_of_a_test", raising=False)
    return "own_effects_of_a_test"


def test_an_effect_of_ones_own_is_named_by_module_and_class(own_module: str) -> None:
    values = {"cogging.size": 2.0, "cogging.pitch": 0.4}
    own = [f"{own_module}:Cogging"]
    s = make_system("mass_spring_damper", declared=[], effects=own, values=values)
    assert s.effect_names == ("cogging",)
    rate = s.drift(0.0, torch.tensor([[0.1, 0.0]]), torch.zeros(1, 1)).detach()
    torch.testing.assert_close(rate, torch.tensor([[0.0, -2.0]]))


@pytest.mark.parametrize(
    ("system", "effect", "words"),
    [
        ("hexacopter", "own_effects_of_a_test:Cogging", "port 'force'"),
        ("cartpole", "own_effects_of_a_test:Coging", "no class 'Coging'"),
        ("cartpole", "no_such_module_at_all:X", "PYTHONPATH"),
    ],
)
@pytest.mark.usefixtures("own_module")
def test_an_effect_of_ones_own_that_does_not_fit_is_refused(system: str, effect: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_system(system, effects=[effect])


def test_effects_of_a_system_are_those_that_it_can_be_made_with() -> None:
    for name, cls in SYSTEMS.items():
        for effect in effects_of(name, cls.ports, cls.bound_coordinates()):
            assert effect in make_system(name, declared=[], effects=[effect]).effect_names


def test_each_system_tries_no_term_twice() -> None:
    assert EFFECTS["actuator_gain_drift"].no_candidate("hexacopter")
    assert not EFFECTS["thrust_sag"].no_candidate("hexacopter")


def test_one_parameter_object_is_one_parameter() -> None:
    with pytest.raises((TypeError, RuntimeError)):  # before Python 3.12 the one in the other

        class Twice(Effect):
            rising = falling = Parameter(0.1, "s")
