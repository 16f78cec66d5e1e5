"""Loops are compiled where nothing can be written, too."""

import numpy as np
import pytest
from numba.core import caching

from nsde_torch.jit import compiled


def summed(values: np.ndarray) -> float:
    total = 0.0
    for k in range(len(values)):
        total += values[k]
    return total


def _keep_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Machine code of earlier runs is not found, and that of this one is not kept."""
    impl = next(c for c in vars(caching).values() if hasattr(c, "_locator_classes"))
    monkeypatch.setattr(impl, "_locator_classes", [])


def test_without_a_folder_for_machine_code_it_is_compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    _keep_nothing(monkeypatch)
    assert compiled(summed)(np.arange(4.0)) == 6.0


def test_a_division_by_nothing_is_infinite() -> None:
    assert compiled(lambda a, b: a / b)(1.0, 0.0) == np.inf


def test_what_is_compiled_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    _keep_nothing(monkeypatch)
    said: list[str] = []
    monkeypatch.setattr("nsde_torch.jit.WHEN_COMPILING", [lambda: said.append("compiling")])
    for start in (0, 1.0):  # two types, each compiled
        compiled(lambda a: a + 1)(start)
    assert said == ["compiling"]
