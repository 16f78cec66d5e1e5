"""Runs that a model was trained on are found again by what is in them."""

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.evaluation.seen import SeenRuns, record, trained_on


def noisy(name: str, seed: int, rows: int = 2000) -> Run:
    rng = np.random.default_rng(seed)
    return Run(name, 0.01 * np.arange(rows), rng.standard_normal((rows, 3)), rng.standard_normal((rows, 1)))


TRAINED = [noisy("a", 0), noisy("b", 1, rows=50)]
SEEN = SeenRuns.of({"train_runs": ["a", "b"], **record(TRAINED)})


A, B = TRAINED
OTHER = noisy("c", 2)


def joined(first: Run, then: np.ndarray) -> Run:
    x = np.concatenate([first.x, then])
    return Run("long", 0.01 * np.arange(len(x)), x, np.zeros((len(x), 1)))


@pytest.mark.parametrize(
    ("run", "found"),
    [
        (A, "whole"),
        (replace(A, name="another", t=A.t + 7), "whole"),
        *((A.slice(*rows, name="cut"), "part") for rows in ((0, 200), (700, 1000), (1800, 2000))),
        (Run("a", A.t[::5], A.x[::5], A.u[::5]), "part"),
        (replace(A, u=np.column_stack([A.u, A.u])), "part"),
        (joined(noisy("long", 5), B.x), "part"),
        (OTHER, ""),
        (noisy("a", 2), "same name"),
        (replace(OTHER, x=np.concatenate([A.x[:2], OTHER.x[2:]])), ""),
    ],
    ids=[
        *("itself", "another name and clock", "its beginning", "a tenth of it", "its end", "another step"),
        *(
            "other inputs", "a recording that holds it", "another run", "a namesake", "another from its first state",
        ),
    ],
)  # fmt: skip
def test_a_training_run_is_found_in_what_holds_some_of_it_and_in_nothing_else(run: Run, found: str) -> None:
    assert SEEN.match(run) == found


def test_without_hashes_the_names_decide() -> None:
    old = SeenRuns.of({"train_runs": ["a", "b"]})
    assert old.match(noisy("a", 9)) == "by name"
    assert old.match(noisy("c", 0)) == ""
    assert [trained_on(m) for m in ("whole", "part", "by name", "same name", "")] == [True] * 3 + [False] * 2
