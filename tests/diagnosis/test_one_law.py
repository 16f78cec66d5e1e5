"""One law of friction is told in one name: never beside what it contains, and never at a size of nothing."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.elimination import eliminate
from nsde_torch.diagnosis.fitted import adds_nothing, effect_of, values_of
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.rounds import Round
from nsde_torch.diagnosis.screening import joined, screen, starts
from nsde_torch.diagnosis.search import Base, Search, search_in
from nsde_torch.diagnosis.selection import Selection
from nsde_torch.effects import effect_class
from nsde_torch.inference.sizes import data_sizes
from nsde_torch.systems import System, make_system
from tests.helpers.diagnosed import recorded

SPRING = "mass_spring_damper"
_FRICTIONS = ("asymmetric_friction", "coulomb_friction", "stribeck_friction")


def spring(*effects: str, **values: Mapping[str, float]) -> System:
    """The spring with these effects at these values."""
    system = make_system(SPRING)
    for name in effects:
        system = system.with_effects(system.make_effect(name, dict(values.get(name, {}))))
    return system


@pytest.fixture(scope="module")
def rubbing() -> Search:
    """A search in runs of the spring with dry friction."""
    made = recorded(
        SPRING, {"coulomb_friction": {"size": 0.3, "width": 0.002}}, seed=3, dt=0.02, durations=(6.0,) * 4
    )
    return search_in(make_system(SPRING), made.runs, 1.0, Options(candidates=_FRICTIONS))


@pytest.fixture(scope="module")
def rubbed(rubbing: Search) -> Base:
    """The physics with dry friction, fitted."""
    found = {"coulomb_friction": {"size": 0.3, "width": 0.002}}
    return rubbing.base(spring("coulomb_friction", **found), warm=True)


def test_what_an_effect_contains_is_not_tried_beside_it() -> None:
    assert "coulomb_friction" in candidate_names(spring())
    assert "coulomb_friction" not in candidate_names(spring("asymmetric_friction"))
    assert "coulomb_friction" not in candidate_names(spring("stribeck_friction"))
    assert "asymmetric_friction" in candidate_names(spring("coulomb_friction"))


@pytest.mark.parametrize("name", ["asymmetric_friction", "stribeck_friction"])
def test_what_stands_in_for_an_effect_starts_as_that_effect(rubbing: Search, rubbed: Base, name: str) -> None:
    system = rubbed.system
    scales = data_sizes(system, rubbing.steps)
    begun = starts(system, name, scales, ())
    coulomb = effect_of(system, "coulomb_friction")
    size = values_of(coulomb)["size"]
    sizes = [own for own, theirs in effect_class(name).shared(type(coulomb)).items() if theirs == "size"]
    assert any(all(start[key] == pytest.approx(size) for key in sizes) for start in begun)
    assert len(begun) == len({tuple(map(str, start.items())) for start in begun})
    # from there a linear step cannot explain less
    nats = max(screen(rubbing, rubbed, joined(system, name, start), name, ())[0] for start in begun)
    assert nats > -1.0


def test_a_law_at_a_size_of_nothing_says_nothing_of_its_own(rubbing: Search) -> None:
    sizes = {"size": 0.3, "extra": 1e-7, "speed": 0.05, "width": 0.002}
    nil = rubbing.regression(spring("stribeck_friction", stribeck_friction=sizes))
    assert adds_nothing(nil, "stribeck_friction", share=0.01)  # it is a Coulomb friction
    more = rubbing.regression(spring("stribeck_friction", stribeck_friction={**sizes, "extra": 0.1}))
    assert not adds_nothing(more, "stribeck_friction", share=0.01)
    one_way = {"size_forward": 0.3, "size_backward": 1e-7, "width": 0.002}
    other = rubbing.regression(spring("asymmetric_friction", asymmetric_friction=one_way))
    assert not adds_nothing(
        other, "asymmetric_friction", share=0.01
    )  # friction in one direction is a law of its own
    none = rubbing.regression(spring("coulomb_friction", coulomb_friction={"size": 1e-7, "width": 0.002}))
    assert adds_nothing(none, "coulomb_friction", share=0.01)


@pytest.mark.parametrize(("apart", "nothing"), [(0.001, True), (0.1, False)])
def test_what_is_a_simpler_law_but_for_next_to_nothing_says_nothing_of_its_own(
    rubbing: Search, apart: float, nothing: bool
) -> None:
    """A slope or a difference of a thousandth is there for sure in long data, and is nothing to name."""
    place = {"size": 0.3, "slope": apart, "width": 0.002}
    along = rubbing.regression(spring("position_dependent_friction", position_dependent_friction=place))
    assert adds_nothing(along, "position_dependent_friction", share=0.01) is nothing
    ways = {"size_forward": 0.3 * (1 + apart), "size_backward": 0.3 * (1 - apart), "width": 0.002}
    both = rubbing.regression(spring("asymmetric_friction", asymmetric_friction=ways))
    assert adds_nothing(both, "asymmetric_friction", share=0.01) is nothing


def test_a_wide_law_whose_own_size_is_nothing_gives_way_to_what_it_contains(rubbing: Search) -> None:
    sizes = {"size": 0.3, "extra": 1e-7, "speed": 0.05, "width": 0.002}
    declared = rubbing.base(make_system(SPRING))
    wide = rubbing.base(spring("stribeck_friction", stribeck_friction=sizes), warm=True)
    chosen = Selection(
        declared, wide, ["stribeck_friction"], [Round(base=declared, trials=[], screened={})], ()
    )
    kept = eliminate(rubbing, chosen)
    assert [f.name for f in kept.found] == ["coulomb_friction"]
    assert kept.final.system.effect_names[-1] == "coulomb_friction"
