"""Numbers that a diagnosis decides by stand in one place, each is used, and budgets change no verdict."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.diagnosis.decisions import Budgets, Decisions, Wording
from nsde_torch.errors import ConfigError
from tests.helpers.diagnosed import diagnosed

_SPRING, _FRICTION = "mass_spring_damper", {"coulomb_friction": {"size": 0.3}}
_SHORT: dict[str, Any] = {"durations": (5.0,) * 4, "dt": 0.02}


def _sources(root: Path) -> dict[str, str]:
    folder = root / "nsde_torch" / "diagnosis"
    return {p.name: p.read_text(encoding="utf-8") for p in folder.glob("*.py") if p.name != "decisions.py"}


@pytest.mark.parametrize("owner", [Decisions, Wording, Budgets])
def test_every_number_is_used(owner: type, root: Path) -> None:
    text = "\n".join(_sources(root).values())
    unused = [f.name for f in fields(owner) if not re.search(rf"\.{f.name}\b", text)]
    assert unused == []


def test_no_module_reads_the_defaults_behind_the_back_of_its_caller(root: Path) -> None:
    behind = {
        f"{name}: {line.strip()}"
        for name, text in _sources(root).items()
        for line in text.splitlines()
        if re.search(r"\b(DECISIONS|BUDGETS)\.", line)
    }
    assert behind == set()


def test_a_number_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError, match="folds"):
        Decisions(folds=1)
    with pytest.raises(ConfigError, match="iterations"):
        Budgets(iterations=0)


@pytest.mark.slow
def test_what_is_decided_reaches_the_search() -> None:
    _, content = diagnosed(_SPRING, _FRICTION, decisions=Decisions(alike_nats=1e6), **_SHORT)
    assert (content["verdict"], content["added"]) == ("unexplained", [])
