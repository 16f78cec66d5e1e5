"""Numbers that a diagnosis decides by stand in one place, each is used, and budgets change no verdict."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from nsde_torch.diagnosis.decision import beside_provisional
from nsde_torch.diagnosis.decisions import Budgets, Decisions, Wording
from nsde_torch.diagnosis.joint_selection import Evidence
from nsde_torch.diagnosis.outcome import Found
from nsde_torch.errors import ConfigError
from tests.helpers.diagnosed import diagnosed


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
