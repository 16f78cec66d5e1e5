"""What differs between runs: each row gets the number of its run, and a run that is not known gets none."""

from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.effects import Effect, Parameter, effect_class, effects_of, key_of
from nsde_torch.effects.by_run import BY_RUN, MASS, RUN, ByRun, difference_name
from nsde_torch.systems import System, make_system
from nsde_torch.systems.in_run import difference_on
from nsde_torch.systems.parameters import ParameterVector
from tests.helpers.effect_rows import random_rows
from tests.helpers.own_machines import Car

RUNS = torch.tensor([[0.0], [1.0], [2.0], [-1.0], [7.0]], dtype=torch.float64)
ALL = ("mass_spring_damper", "cartpole", "hexacopter", "quadrotor")


def rows(system: System) -> tuple[Tensor, Tensor, Tensor]:
    """States, inputs, and inputs with the number of the run: three that are known and two that are not."""
    x, u = random_rows(system, len(RUNS), seed=3)
    return x, u, torch.cat((u, RUNS), 1)


def machine(name: str, **values: Any) -> System:
    return make_system(name, values=values).double()


def differing(system: System, target: str, *change: float) -> System:
    effect = difference_on(system, target)({"change": list(change)}).double()
    return system.reading(RUN).with_effects(effect)


@pytest.mark.parametrize("name", ALL)
def test_a_mass_that_differs_is_another_machine_in_that_run_and_none_in_others(name: str) -> None:
    system = machine(name)
    x, u, wide = rows(system)
    found = differing(system, MASS, 0.25, -0.2).drift(0.0, x, wide)
    for row, factor in enumerate((1.0, 1.25, 0.8, 1.0, 1.0)):
        light = make_system(name).double()
        for own in light.over_mass:
            light.set_value(own, (system.value(own) / factor).tolist())
        for effect in light.effects:
            assert isinstance(effect, Effect)
            for own in effect.size_names():
                effect.set_value(own, (effect.value(own) / factor).tolist())
        there = light.drift(0.0, x, u)
        assert torch.allclose(found[row], there[row], rtol=1e-6, atol=1e-9)


def test_a_parameter_that_differs_has_its_value_in_each_run() -> None:
    system = machine("mass_spring_damper")
    x, u, wide = rows(system)
    found = differing(system, "linear_spring/stiffness", 0.5, -0.25).drift(0.0, x, wide)[:, 1]
    still = system.drift(0.0, x, u)[:, 1]
    expected = -torch.tensor([0.0, 0.5, -0.25, 0.0, 0.0], dtype=torch.float64) * x[:, 0]
    assert torch.allclose(found - still, expected)
    assert torch.allclose(system.drift(0.0, x, u)[:, 1], still)  # the machine itself stays as it is


def test_a_parameter_of_its_own_that_is_called_mass_differs_as_any_other() -> None:
    """It was taken for what machines say of their mass (`over_mass`): this one does not, and a diagnosis ended."""

    class Loaded(Car):
        PARAMETERS = {**Car.PARAMETERS, "mass": Parameter(2.0, "kg", low=0.1)}

        def dynamics(self, t: Any, x: Tensor, u: Tensor, forces: Any) -> Tensor:
            return super().dynamics(t, x, u, forces) / self.value("mass")

    system = Loaded().double()
    x, u, wide = rows(system)
    plain = system.drift(0.0, x, u)
    found = differing(system, MASS, 2.0, 0.0).drift(0.0, x, wide)
    torch.testing.assert_close(found[1], plain[1] / 2.0)
    torch.testing.assert_close(found[2], plain[2])


def test_forces_and_zeros_of_each_run() -> None:
    cart = machine("cartpole")
    x, u, wide = rows(cart)
    pushed = cart.reading(RUN).with_effects(
        cart.make_effect("run_force[cart]", {"acceleration": [0.1, -0.2, 0.3]})
    )
    one = cart.with_effects(cart.make_effect("constant_force[cart]", {"acceleration": -0.2}))
    assert torch.allclose(pushed.drift(0.0, x, wide)[1], one.drift(0.0, x, u)[1])
    assert torch.allclose(pushed.drift(0.0, x, wide)[3:], cart.drift(0.0, x, u)[3:])
    zero = cart.reading(RUN).with_effects(cart.make_effect("run_zero[pole]", {"bias": [0.1, -0.2, 0.3]}))
    moved = x - torch.tensor([0.0, 0.0, 0.3, 0.0], dtype=torch.float64)
    assert torch.allclose(zero.drift(0.0, x, wide)[2], cart.drift(0.0, moved, u)[2], atol=1e-7)
    waves = {"waves": [0.1, -0.2, 0.3, 1.1, 1.2, 1.3], "frequency": 2.0}
    swung = cart.reading(RUN).with_effects(cart.make_effect("run_periodic_force[cart]", waves))
    one = cart.with_effects(
        cart.make_effect("periodic_force[cart]", {"sine": -0.2, "cosine": 1.2, "frequency": 2.0})
    )
    assert torch.allclose(swung.drift(0.1, x, wide)[1], one.drift(0.1, x, u)[1])
    assert torch.allclose(swung.drift(0.1, x, wide)[3:], cart.drift(0.1, x, u)[3:])
    rotor = machine("hexacopter")
    x, u, wide = rows(rotor)
    each = {"acceleration": [0.1, 0.2, 0.3, 1.1, 1.2, 1.3, 2.1, 2.2, 2.3]}  # east of all runs, north, up
    blown = rotor.reading(RUN).with_effects(rotor.make_effect("run_world_force", each))
    change = blown.drift(0.0, x, wide) - rotor.drift(0.0, x, u)
    assert torch.allclose(change[1, 3:6], torch.tensor([0.2, 1.2, 2.2], dtype=torch.float64), atol=1e-6)


@pytest.mark.parametrize("name", ALL)
def test_the_vector_of_parameters_works_out_the_same(name: str) -> None:
    system = differing(machine(name), MASS, 0.25, -0.2)
    x, _, wide = rows(system)
    vector = ParameterVector(system)
    at = system.drift(0.0, x, wide)
    assert torch.allclose(vector.system.drift(0.0, x, wide), at, atol=1e-12)
    moved = vector.start.copy()
    moved[vector.labels.index(f"{difference_name(MASS)}.change[1]")] = 0.5
    other = differing(machine(name), MASS, 0.25, 0.5)
    vector.use(torch.from_numpy(moved))
    assert torch.allclose(vector.system.drift(0.0, x, wide), other.drift(0.0, x, wide), atol=1e-12)


def test_an_effect_that_is_gone_takes_what_differs_in_it_along() -> None:
    system = differing(machine("mass_spring_damper"), "viscous_friction/damping", 0.1, 0.2)
    left = system.without_effects("viscous_friction")
    assert left.effect_names == ("linear_spring",)


def test_names_lead_to_classes_and_back_and_none_is_a_candidate() -> None:
    system = machine("cartpole")
    for name in ("run_force[cart]", "run_zero[pole]", "run_difference[half_length]", "run_difference[mass]"):
        assert issubclass(effect_class(name), ByRun)
        assert key_of(type(system.make_effect(name, None))) == name
    able = effects_of(system.name, system.ports, system.bound_coordinates())
    assert not any(name.partition("[")[0] in BY_RUN or name.startswith("run_difference") for name in able)
