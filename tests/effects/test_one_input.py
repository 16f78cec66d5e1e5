"""Effects on one input of several: what they are on all inputs, on its column alone."""

import pytest
import torch

from nsde_torch.diagnosis.candidates import candidate_names, on_coordinates
from nsde_torch.effects import EFFECTS, key_of
from nsde_torch.errors import ConfigError
from nsde_torch.systems import make_system, system_class
from tests.helpers.effect_contract import contract
from tests.helpers.two_joints import HOME

TestLagOfOneInput = contract("actuator_lag[tau2]", HOME, memory=1, signed=True)
TestDelayOfOneInput = contract("input_delay[tau1]", HOME, memory=2, signed=True)
TestPlayOfOneInput = contract("input_play[tau2]", HOME, memory=1, signed=True)

EACH = sorted(name for name, cls in EFFECTS.items() if cls.each_input)


@torch.no_grad()
@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize("step", [0.0, 0.02])
def test_the_input_gets_what_it_gets_of_the_effect_on_all_and_the_other_nothing(
    name: str, step: float
) -> None:
    machine, g = make_system(HOME, declared=[]).double(), torch.Generator().manual_seed(1)
    values = {key: max(0.3, 2.0 * (spec.low or 0.0)) for key, spec in EFFECTS[name].PARAMETERS.items()}
    whole, one = (machine.make_effect(n, values).double() for n in (name, f"{name}[tau2]"))
    whole.step = one.step = step
    x, u = (torch.randn(30, k, generator=g, dtype=torch.float64) for k in (4, 2))
    parts = whole.n_memory // 2
    memory = torch.randn(30, whole.n_memory, generator=g, dtype=torch.float64)
    own = (
        memory[:, 1::2] if parts else memory
    )  # that of the second input: its states follow those of the first
    assert one.n_memory == parts
    term = one(0.7, x, u, own)
    torch.testing.assert_close(term[:, 1], whole(0.7, x, u, memory)[:, 1])
    assert not term[:, 0].any()
    torch.testing.assert_close(one.memory_rate(0.7, x, u, own), whole.memory_rate(0.7, x, u, memory)[:, 1::2])
    torch.testing.assert_close(one.memory_start(x, u), whole.memory_start(x, u)[:, 1::2])
    if (held := whole.held(u, 0.02)) is not None:
        torch.testing.assert_close(one.held(u, 0.02), held[:, 1::2])


def test_it_has_the_unit_of_its_input_and_is_found_again_by_its_name() -> None:
    cls = system_class(HOME).effect_class("actuator_rate_limit[tau1]")
    assert cls.PARAMETERS["rate"].unit == "N m/s"
    assert cls.relative == {"rate": "input[tau1]"}
    assert key_of(cls) == "actuator_rate_limit[tau1]"
    assert "On tau1 alone" in cls.sentence


def test_machines_with_one_input_and_rotors_have_none() -> None:
    several = candidate_names(make_system(HOME))
    assert {f"{name}[{at}]" for name in EACH for at in ("tau1", "tau2")} <= set(several)
    named = ["actuator_lag", "actuator_lag[tau1]", "actuator_lag[tau2]"]
    assert on_coordinates(make_system(HOME), ["actuator_lag"]) == named
    for system in ("cartpole", "hexacopter"):
        names = system_class(system).able_effects()
        assert not [n for n in names if n.partition("[")[0] in EACH and "[" in n]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("actuator_lag[tau3]", "'tau3' is no input"),
        ("asymmetric_lag[tau1]", "no law of one coordinate"),
    ],
)
def test_a_name_that_is_no_input_is_refused(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_system(HOME).make_effect(name)
