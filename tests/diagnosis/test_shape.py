"""Words for a dependence, on residuals that are made to have it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.joint_selection import fitted_at
from nsde_torch.diagnosis.residual_tests import PhysicsResiduals, beyond_chance, dependences
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import Rates, rates, shape
from nsde_torch.inference import LogLikelihood
from tests.helpers.residuals import made_residuals
from tests.inference.springs import rubbing, small_runs, spring

Array = NDArray[np.float64]
Push = Callable[[Array, Array, Array], Array]

RUNS = ("run_0", "run_1", "run_2", "run_3")
ONE, SOME = np.array([0.0, 0.0, 0.5, 0.0]), 0.3 * np.array([-1.0, 1.0, -1.0, 1.0])


def pushed(push: Push) -> tuple[PhysicsResiduals, Rates]:
    """A spring that noise pushes, and a push of q, time and number of the run [m/s2]; its rates."""
    left = made_residuals().made(lambda q, q_dot, t, run: push(q, t, run), seed=None)
    return left, rates(left.regression, made_residuals().measured)


@pytest.mark.parametrize(
    ("push", "variable", "words", "where"),
    [
        (lambda q, t, run: -3.0 * q**3, "q", {"symmetry": "odd", "extent": "global"}, None),
        (lambda q, t, run: 2.0 * (q**2 - 0.02), "q", {"symmetry": "even"}, None),
        (lambda q, t, run: 0.6 * np.exp(-(((q - 0.2) / 0.03) ** 2)), "q", {"extent": "local"}, 0.2),
        (lambda q, t, run: -0.5 * (q - 0.15) / 0.05 * np.exp(-0.5 * ((q - 0.15) / 0.05) ** 2), "q",
         {"extent": "local"}, 0.15),
        (lambda q, t, run: 0.5 * np.exp(-(((t - t.min() - 4.0) / 0.4) ** 2)), "time",
         {"extent": "local", "symmetry": ""}, None),
        (lambda q, t, run: ONE[run], "run",
         {"sentence": "The rate of q_dot is off by a constant, in run_2 only."}, None),
        (lambda q, t, run: SOME[run], "run",
         {"sentence": "The rate of q_dot is off by constants that differ from run to run."}, None),
        (lambda q, t, run: 0.4 * np.sin(2 * np.pi * q / 0.17), "q",
         {"period": pytest.approx(0.17, rel=0.05)}, None),
    ],
    ids=["odd", "even", "bump", "well", "one time", "one run", "runs", "teeth"],
)  # fmt: skip
def test_a_dependence_is_called_what_it_is(
    push: Push, variable: str, words: dict[str, Any], where: float | None
) -> None:
    left, seen = pushed(push)
    found = max((d for d in dependences(left) if d.variable == variable), key=lambda d: d.excess)
    said = shape(left, found, seen, RUNS)
    assert {name: getattr(said, name) for name in words} == words
    assert bool(said.period) == ("period" in words)
    assert where is None or said.where[0] < where < said.where[1]


@pytest.mark.parametrize(("effect", "variable"), [("hardening", "q"), ("quadratic", "q_dot")])
def test_a_law_that_noise_levels_have_learned_is_seen_beside_them(effect: str, variable: str) -> None:
    runs = small_runs(replace(rubbing(0.0), effects={effect: {"size": 0.5}}), 4, 10.0, seed=5)
    place = fitted_at(LogLikelihood(spring(), runs, run_in=True), spring(), None)
    search = Search(spring(), runs, 1.0, Options())
    left = PhysicsResiduals(search, place, search.at(place))
    first = beyond_chance(dependences(left), {}, alpha=0.01)[0]
    assert (first.channel, first.variable, first.run) == ("q_dot", variable, None)
    assert first.p < 1e-6
    assert first.excess > 20.0


def test_a_swing_whose_phase_differs_from_run_to_run_is_told_with_its_frequency() -> None:
    left, seen = pushed(lambda q, t, run: 0.6 * np.sin(2 * np.pi * 4.0 * t + 2.0 * run))
    found = next(d for d in dependences(left) if d.sinusoid is not None)
    assert found.p < 1e-9
    assert 0.05 < found.share < 1.0
    assert found.excess > 20.0
    words = shape(left, found, seen, RUNS)
    assert words.period == pytest.approx(1 / 4.0, rel=0.01)
    assert "phase differs" in words.sentence
    left.inputs = False  # what was restored from an average swings by itself
    assert not any(d.sinusoid is not None for d in dependences(left))
