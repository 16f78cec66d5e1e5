"""Numbers that a diagnosis decides by stand in one place, each is used, and budgets change no verdict."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from nsde_torch.diagnosis.decisions import Budgets, Decisions, Wording
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
