"""One law of friction is told in one name: never beside what it contains."""

import pytest

from nsde_torch.diagnosis.candidates import candidate_names, effect_of, starts, values_of
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.effects import effect_class
from nsde_torch.inference.steps import data_sizes
from nsde_torch.systems import System, make_system
from tests.helpers.diagnosed import recorded

SPRING = "mass_spring_damper"
FRICTION = {"coulomb_friction": {"size": 0.3, "width": 0.002}}
_FRICTIONS = ("asymmetric_friction", "coulomb_friction", "stribeck_friction")


def spring(*effects: str) -> System:
    return make_system(SPRING, effects=effects)


@pytest.fixture(scope="module")
def rubbing() -> Search:
    made = recorded(SPRING, FRICTION, seed=3, dt=0.02, durations=(6.0,) * 4)
    return Search(spring(), made.runs, 1.0, Options(candidates=_FRICTIONS))


def test_a_spring_is_sought_where_none_is_declared() -> None:
    assert "linear_spring[cart]" in candidate_names(make_system("cartpole"))
    assert not [n for n in candidate_names(spring()) if n.startswith("linear_spring")]


def test_what_an_effect_contains_is_not_tried_beside_it() -> None:
    assert "coulomb_friction" in candidate_names(spring())
    assert "coulomb_friction" not in candidate_names(spring("asymmetric_friction"))
    assert "coulomb_friction" not in candidate_names(spring("stribeck_friction"))
    assert "asymmetric_friction" in candidate_names(spring("coulomb_friction"))


@pytest.mark.parametrize("name", ["asymmetric_friction", "stribeck_friction"])
def test_what_stands_in_for_an_effect_starts_as_that_effect(rubbing: Search, name: str) -> None:
    friction = spring().make_effect("coulomb_friction", FRICTION["coulomb_friction"])
    system = fitted_system(rubbing.quick(spring().with_effects(friction)))
    scales = data_sizes(system, rubbing.steps)
    begun = starts(system, name, scales, ())
    coulomb = effect_of(system, "coulomb_friction")
    size = values_of(coulomb)["size"]
    sizes = [own for own, theirs in effect_class(name).shared(type(coulomb)).items() if theirs == "size"]
    assert any(all(start[key] == pytest.approx(size) for key in sizes) for start in begun)
    assert len(begun) == len({tuple(map(str, start.items())) for start in begun})
