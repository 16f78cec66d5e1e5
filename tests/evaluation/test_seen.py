"""Runs that a model was trained on are found again by what is in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.evaluation.seen import SeenRuns, record, row_sketch, trained_on


def noisy(name: str, seed: int, rows: int = 2000) -> Run:
    rng = np.random.default_rng(seed)
    return Run(name, 0.01 * np.arange(rows), rng.standard_normal((rows, 3)), rng.standard_normal((rows, 1)))


TRAINED = [noisy("a", 0), noisy("b", 1, rows=50)]
SEEN = SeenRuns.of({"train_runs": ["a", "b"], **record(TRAINED)})


def test_a_training_run_is_found_under_any_name_and_clock() -> None:
    assert SEEN.match(TRAINED[0]) == "whole"
    assert SEEN.match(replace(TRAINED[0], name="another", t=TRAINED[0].t + 7)) == "whole"


@pytest.mark.parametrize("rows", [slice(0, 200), slice(700, 1000), slice(1800, 2000)])
def test_a_tenth_of_a_training_run_is_found(rows: slice) -> None:
    assert SEEN.match(TRAINED[0].slice(rows.start, rows.stop, name="cut")) == "part"


def test_a_training_run_at_another_step_or_with_other_inputs_is_found() -> None:
    a = TRAINED[0]
    assert SEEN.match(Run("a", a.t[::5], a.x[::5], a.u[::5])) == "part"
    assert SEEN.match(replace(a, u=np.column_stack([a.u, a.u]))) == "part"


def test_a_recording_that_holds_a_short_training_run_is_found() -> None:
    long, b = noisy("long", 5), TRAINED[1]
    x = np.concatenate([long.x, b.x])
    assert SEEN.match(Run("long", 0.01 * np.arange(len(x)), x, np.zeros((len(x), 1)))) == "part"


def test_other_runs_are_held_out_and_a_namesake_is_named_as_such() -> None:
    assert SEEN.match(noisy("c", 2)) == ""
    assert SEEN.match(noisy("a", 2)) == "same name"


def test_runs_that_start_at_the_same_state_are_not_taken_for_one_another() -> None:
    other = noisy("c", 2)
    x = other.x.copy()
    x[:2] = TRAINED[0].x[:2]
    assert SEEN.match(Run("c", other.t, x, other.u)) == ""


def test_without_hashes_the_names_decide() -> None:
    old = SeenRuns.of({"train_runs": ["a", "b"]})
    assert old.match(noisy("a", 9)) == "by name"
    assert old.match(noisy("c", 0)) == ""
    assert [trained_on(m) for m in ("whole", "part", "by name", "same name", "")] == [True] * 3 + [False] * 2


def test_the_sketch_grows_with_the_run_within_bounds() -> None:
    assert [len(row_sketch(noisy("x", 0, n)).split()) for n in (30, 2000, 6400, 100_000)] == [
        30,
        64,
        100,
        512,
    ]
