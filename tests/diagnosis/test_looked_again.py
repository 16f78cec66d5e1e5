"""An effect is looked at again where the noise model that was found with it may have been what helped."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from nsde_torch.diagnosis import elimination
from nsde_torch.diagnosis.decisions import DECISIONS
from nsde_torch.diagnosis.selection import Selection

NAME = "coulomb_friction"


def base(fitted: float) -> Any:
    system = SimpleNamespace(effect_names=())
    made = SimpleNamespace(system=system, regression=None, score=SimpleNamespace(fitted=fitted))
    made.restored = lambda: made
    return made


@pytest.mark.parametrize(("fitted", "again"), [(10.0, False), (12.0, False), (60.0, True)])
def test_it_is_dropped_where_the_noise_model_did_it_alone(
    monkeypatch: pytest.MonkeyPatch, fitted: float, again: bool
) -> None:
    trial, looks = SimpleNamespace(name=NAME), []

    def look(search: Any, without: Any, *, only: set[str], called: str) -> Any:
        looks.append(only)
        return SimpleNamespace(base=without, trials=[])  # with that noise model it does nothing

    before = SimpleNamespace(base=base(10.0), trials=[trial], chosen=trial, added=(), screened={})
    search = SimpleNamespace(
        base=lambda *a, **k: base(fitted), decisions=DECISIONS, laws={}, narrower=lambda found: found
    )
    for name, stands in {
        "look": look,
        "fitted_system": lambda regression: None,
        "without_effect": lambda *a: base(0.0).system,
        "accept": lambda search, t: True,
        "_ties": lambda *a: (),
    }.items():
        monkeypatch.setattr(elimination, name, stands)
    chosen = Selection(base(10.0), base(50.0), [NAME], cast(Any, [before]), ())
    kept = elimination.eliminate(cast(Any, search), chosen)
    assert bool(looks) is again
    assert [f.name for f in kept.found] == ([] if again else [NAME])
