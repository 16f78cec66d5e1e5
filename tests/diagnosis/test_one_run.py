"""What is left of a spring is reported with its shape, place, moment and run, where nothing may be added."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import nsde_torch
from tests.helpers.own_machines import pushed_spring

Push = Callable[[float, float, float, int], float]
"""Of position, speed, time and number of the run [m/s2]."""


def left_of(push: Push, runs: int = 4, **options: Any) -> tuple[dict[str, Any], str]:
    """What depends most of all, and its sentence."""
    made = [pushed_spring(r, 10.0, lambda t, v, u, q, r=r: push(q, v, t, r)) for r in range(runs)]
    found = nsde_torch.diagnose(made, system="mass_spring_damper", say=False, **options).content()
    sentences = [one["sentence"] for one in found["unexplained"]]
    return found["structure"]["after"][0], sentences[0] if sentences else ""


def case(name: str, push: Push, variable: str, where: str | None, words: str, *, slow: bool = True) -> Any:
    return pytest.param(push, variable, where, words, id=name, marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize(
    ("push", "variable", "where", "words"),
    [
        case("odd", lambda q, v, t, run: -6.0 * q**3, "q", None, "over its whole range, as an odd function"),
        case("even", lambda q, v, t, run: 0.8 * q**2, "q", None, "as an even function"),
        case("bump", lambda q, v, t, run: 0.6 * np.exp(-(((q - 0.2) / 0.05) ** 2)), "q", None,
             "locally, between 0.1"),
        case("teeth", lambda q, v, t, run: 0.5 * np.sin(2.0 * np.pi * q / 0.17), "q", None,
             "periodically, every 0.171 m", slow=False),
        case("drag", lambda q, v, t, run: -0.4 * v * abs(v), "q_dot", None, "as an odd function"),
        case("swing", lambda q, v, t, run: 0.5 * np.sin(8.0 * np.pi * t + 2.0 * run), "time", "4.004 Hz",
             "in a swing of 4.004 Hz whose phase differs from run to run"),
        case("push", lambda q, v, t, run: 0.6 * np.exp(-(((t - 4.0) / 0.1) ** 2)) * (run == 1), "time", "run_1, 3.9 s",
             "at one moment, run_1 at 3.9 s", slow=False),
    ],
)  # fmt: skip
def test_what_is_left_is_called_what_it_is(push: Push, variable: str, where: str | None, words: str) -> None:
    first, sentence = left_of(push, max_effects=0)
    assert (first["variable"], first["where"]) == (variable, where)
    assert first["p"] < 1e-4
    assert words in sentence


@pytest.mark.parametrize("acts", [{1}, {0, 1, 2, 3}], ids=["in one run", "in all"])
def test_a_friction_is_in_the_run_that_it_acts_in(acts: set[int]) -> None:
    # a line for each run, which says nothing of friction, does not hide one
    few = {"candidates": ["cubic_stiffness"]}
    first, _ = left_of(lambda q, v, t, run: -0.3 * np.tanh(v / 0.01) * (run in acts), **few)
    assert (first["variable"], first["where"]) == ("q_dot", "run_1 only" if len(acts) == 1 else None)
    assert first["p"] < 1e-3
