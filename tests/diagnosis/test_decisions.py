"""Numbers that a diagnosis decides by stand in one place, each is used, and budgets change no verdict."""

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.diagnosis.decision import beside_provisional, dependent_on_provisional
from nsde_torch.diagnosis.decisions import Budgets, Decisions, Wording
from nsde_torch.diagnosis.joint_selection import Evidence, JointSelection, fitted_at
from nsde_torch.diagnosis.outcome import Found, Outcome
from nsde_torch.errors import ConfigError
from nsde_torch.inference import LogLikelihood
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import diagnosed, recorded


@pytest.mark.parametrize("owner", [Decisions, Wording, Budgets])
def test_every_number_is_used(owner: type, root: Path) -> None:
    sources = (root / "nsde_torch" / "diagnosis").glob("*.py")
    text = "\n".join(p.read_text(encoding="utf-8") for p in sources if p.name != "decisions.py")
    unused = [f.name for f in fields(owner) if not re.search(rf"\.{f.name}\b", text)]
    assert unused == []


def test_a_number_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError, match="folds"):
        Decisions(folds=1)
    with pytest.raises(ConfigError, match="iterations"):
        Budgets(iterations=0)


@pytest.mark.slow
def test_what_is_decided_reaches_the_search() -> None:
    friction = {"coulomb_friction": {"size": 0.3}}
    only = {"decisions": Decisions(alike_nats=1e6), "durations": (5.0,) * 4, "dt": 0.02}
    _, content = diagnosed("mass_spring_damper", friction, **only)
    assert (content["verdict"], content["added"]) == ("unexplained", [])


def test_a_law_is_not_sure_beside_what_is_provisional_on_its_channel() -> None:
    def found(name: str, channel: str, provisional: str = "") -> Found:
        return Found(name, Evidence(50.0, 1.0, 0.0), (), (channel,), provisional)

    law, lag = (
        found("heat[0] = c1 T_out flow", "T_wall"),
        found("actuator_lag", "T_wall", "something else is there"),
    )
    elsewhere, friction = found("heat[1] = c1 T_wall", "T_out"), found("coulomb_friction", "T_wall")
    after = beside_provisional([law, lag, elsewhere, friction])
    assert [bool(f.provisional) for f in after] == [True, True, False, False]


def test_a_size_that_hangs_on_what_is_provisional_is_provisional() -> None:
    """Two terms of the place nearly cancel; a friction beside them is what it is without them."""
    cubic, quintic, friction = "cubic_stiffness", "force = c1 q^5", "coulomb_friction"
    truth: dict[str, dict[str, float]] = {
        cubic: {"stiffness": -1.5},
        quintic: {"c1": -2.0},
        friction: {"size": 0.03},
    }
    data = recorded("mass_spring_damper", truth)
    system = make_system("mass_spring_damper")
    both = system.with_effects(*(system.make_effect(name, values) for name, values in truth.items()))
    final = fitted_at(LogLikelihood(both, data.runs), both, None)
    declared = fitted_at(LogLikelihood(system, data.runs), system, None)
    found = [Found(name, Evidence(50.0, 1.0, 0.0), (), ("q_dot",)) for name in truth]

    def provisional(doubtful: str) -> set[str]:
        some = [replace(f, provisional="a reason" if f.name == doubtful else "") for f in found]
        joint = JointSelection(declared, final, {}, (), {})
        nothing: Any = None
        after = dependent_on_provisional(Outcome("effect_found", nothing, nothing, some, joint))
        return {f.name for f in after.found if f.provisional}

    assert provisional(quintic) == {quintic, cubic}
    assert provisional(friction) == {friction}
    assert provisional("") == set()
