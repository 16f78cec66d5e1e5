"""What a diagnosis holds at once, in units of the data that it is made of."""

from __future__ import annotations

import platform
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nsde_torch.diagnosis.evidence import folds, score
from nsde_torch.diagnosis.fitted import fitted_system, nonlinear
from nsde_torch.diagnosis.freed_memory import give_back
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.screening import joined
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.trials import Trial, fit_candidate
from tests.diagnosis.test_shape import pushed

Found = tuple[Search, Base, Regressors]


@pytest.fixture(scope="module")
def spring() -> Found:
    """A spring with a force in one place, which the physics knows nothing of."""
    r, variables = pushed(lambda q, t, run: 0.8 * np.exp(-(((q - 0.1) / 0.15) ** 2)))
    fold, block = folds(r), r.whitened_rows(r.blocks)
    base = Base(
        fitted_system(r), r, score(r, fold, block, still=nonlinear(r.vector, smooth=False)), fold, block
    )
    return Search(r.physics.steps, box=1, alpha=0.01), base, variables


def held(make: Callable[[], Any]) -> tuple[Any, int, int]:
    """What is made, what it holds and the most that was held on the way [bytes]."""
    tracemalloc.start()
    try:
        made = make()
        return made, *tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()


def test_a_base_that_was_looked_at_holds_a_few_columns_and_comes_back_as_it_was(spring: Found) -> None:
    search, given, _ = spring
    base = search.base(given.system)
    base.concluded()  # what is made once and kept is no base's
    concluded, after, _ = held(base.concluded)
    assert after < 8 * len(base.regression.series)
    before, again = base.regression, concluded.restored().regression
    for name in ("theta", "residual", "jacobian", "white", "slopes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(before, name), err_msg=name)


def test_a_candidate_that_was_fitted_holds_a_few_columns_of_the_data(spring: Found) -> None:
    search, base, _ = spring
    name = "coulomb_friction"
    system = joined(base.system, name, {})

    def fitted() -> Trial:
        return fit_candidate(search, base, system, name, among=1)

    fitted()  # what is made once and kept is no candidate's
    trial, after, _ = held(fitted)
    assert trial.name == name
    assert after < 4.0 * 8 * len(base.regression.series)


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries keep no such memory, or do not say"
)
def test_freed_memory_between_pieces_in_use_is_given_back() -> None:
    def resident() -> int:
        return 4096 * int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])

    pieces = [np.ones(8000) for _ in range(4000)]  # 256 MB, below the size that is mapped by itself
    kept = pieces[::20]
    del pieces
    before = resident()
    give_back()
    assert len(kept) == 200
    assert before - resident() > 100e6
