"""Which starts of a candidate are screened."""

from __future__ import annotations

import pytest

from nsde_torch.diagnosis.screening import joined, likeliest, screen, starts
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.effects import Effect
from nsde_torch.inference.sizes import data_sizes
from nsde_torch.inference.steps import steps_of
from nsde_torch.systems import System, make_system
from tests.helpers.diagnosed import recorded


@pytest.fixture(scope="module")
def late() -> tuple[Search, Base]:
    """A spring whose input acts 60 ms late."""
    system = make_system("mass_spring_damper")
    late = {"input_delay": {"delay": 0.06}}
    runs = recorded("mass_spring_damper", late, durations=(6.0,) * 4, dt=0.01).runs
    search = Search(steps_of(system, runs, clock=1.0, smooth=False, run_in=True), box=1, alpha=0.01)
    return search, search.base(system)


def _begun(search: Search, base: Base, name: str) -> list[System]:
    scales = data_sizes(base.system, search.steps)
    return [joined(base.system, name, start) for start in starts(base.system, name, scales, [])]


def _delay(system: System) -> float:
    (effect,) = (e for e in system.effects if isinstance(e, Effect) and e.name == "input_delay")
    return float(effect.declared_parameters()["delay"][0])


def test_of_starts_that_move_the_residual_those_are_kept_that_explain_most(late: tuple[Search, Base]) -> None:
    search, base = late
    begun = _begun(search, base, "input_delay")
    kept = likeliest(search, base, begun, 3)
    assert len(kept) == 3 < len(begun)
    assert sorted(_delay(system) for system in kept) == pytest.approx([0.045, 0.06, 0.08])
    promise = [screen(search, base, system, "input_delay", ())[0] for system in begun]
    assert max(promise[begun.index(system)] for system in kept) > max(promise) - 1.0


def test_starts_that_move_nothing_are_all_kept(late: tuple[Search, Base]) -> None:
    search, base = late
    begun = _begun(search, base, "stribeck_friction")
    assert len(begun) > 1
    assert likeliest(search, base, begun, 1) == begun
