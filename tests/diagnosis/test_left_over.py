"""An effect is kept where its channels depend on what was measured without it, whatever the noise model has learned."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from nsde_torch.diagnosis import elimination
from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.decisions import DECISIONS
from nsde_torch.diagnosis.left_over import structure_returns
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.search import search_in
from nsde_torch.diagnosis.selection import Selection
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded

SPRING = "mass_spring_damper"


@pytest.mark.parametrize("there", [True, False])
def test_structure_returns_without_an_effect_that_is_there_alone(there: bool) -> None:
    data = recorded(SPRING, *([{"quadratic_damping": {"damping": 1.0}}] if there else []))
    search = search_in(make_system(SPRING), data.runs, 1.0, Options())
    without = search.base(make_system(SPRING))
    with_it = search.base(make_system(SPRING, effects=["quadratic_damping"]))
    assert structure_returns(search, with_it, without, "quadratic_damping") is there


@pytest.mark.parametrize("returns", [True, False])
def test_an_effect_that_the_noise_model_learned_stays_where_structure_returns(
    monkeypatch: pytest.MonkeyPatch, returns: bool
) -> None:
    def base() -> Any:
        system = SimpleNamespace(effect_names=())
        made = SimpleNamespace(system=system, regression=None, score=SimpleNamespace(fitted=0.0))
        made.restored = lambda: made
        return made

    trial = SimpleNamespace(name="viscous_friction", p_corrected=1e-4, nats=-14.0)
    looked = SimpleNamespace(base=base(), trials=[trial], chosen=trial, added=(), screened={})
    for name, stands in {
        "fitted_system": lambda regression: None,
        "without_effect": lambda *a: base().system,
        "accept": lambda search, t: False,
        "structure_returns": lambda *a: returns,
        "_ties": lambda *a: (),
    }.items():
        monkeypatch.setattr(elimination, name, stands)
    search = SimpleNamespace(
        base=lambda *a, **k: base(),
        decisions=DECISIONS,
        laws={},
        level=lambda stage: 0.01,
        narrower=lambda found: found,
    )
    chosen = Selection(base(), base(), ["viscous_friction"], cast(Any, [looked]), ())
    kept = elimination.eliminate(cast(Any, search), chosen)
    assert [f.name for f in kept.found] == (["viscous_friction"] if returns else [])


def test_a_spring_is_sought_where_none_is_declared() -> None:
    assert "linear_spring[cart]" in candidate_names(make_system("cartpole"))
    assert not [n for n in candidate_names(make_system(SPRING)) if n.startswith("linear_spring")]
