"""Words for a dependence, on residuals that are made to have it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.joint_selection import fitted_at
from nsde_torch.diagnosis.residual_tests import PhysicsResiduals, beyond_chance, dependences
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import Rates, Shape, bins, rates, shape, white_parts
from nsde_torch.inference import LogLikelihood
from nsde_torch.sysid.regression import Regression
from tests.helpers.residuals import MadeResiduals
from tests.inference.springs import rubbing, small_runs, spring

Array = NDArray[np.float64]
Push = Callable[[Array, Array, Array], Array]

RUNS = ("run_0", "run_1", "run_2", "run_3")


@cache
def made_spring() -> MadeResiduals:
    return MadeResiduals()


def pushed(push: Push) -> tuple[PhysicsResiduals, Rates]:
    """A spring that noise pushes, and a push of q, time and number of the run [m/s2]; its rates."""
    left = made_spring().made(lambda q, q_dot, t, run: push(q, t, run), seed=None)
    return left, rates(left.regression, made_spring().measured)


def described(push: Push, variable: str) -> Shape:
    left, seen = pushed(push)
    test = max((d for d in dependences(left) if d.variable == variable), key=lambda d: d.excess)
    return shape(left, test, seen, RUNS)


def test_an_odd_dependence_over_the_whole_range_is_called_so() -> None:
    words = described(lambda q, t, run: -3.0 * q**3, "q")
    assert (words.channel, words.symmetry, words.extent) == ("q_dot", "odd", "global")
    assert (words.period, words.only_run) == (None, None)
    assert "odd" in words.sentence


def test_an_even_dependence_is_called_so() -> None:
    assert described(lambda q, t, run: 2.0 * (q**2 - 0.02), "q").symmetry == "even"


@pytest.mark.parametrize(
    ("push", "place"),
    [
        (lambda q, t, run: 0.6 * np.exp(-(((q - 0.2) / 0.03) ** 2)), 0.2),
        (lambda q, t, run: -0.5 * (q - 0.15) / 0.05 * np.exp(-0.5 * ((q - 0.15) / 0.05) ** 2), 0.15),
    ],
    ids=["bump", "well"],
)
def test_what_is_in_one_place_is_local_and_not_periodic_and_its_place_is_told(
    push: Push, place: float
) -> None:
    words = described(push, "q")
    assert (words.extent, words.period) == ("local", None)
    assert words.where[0] < place < words.where[1]


def test_teeth_along_the_way_are_periodic() -> None:
    words = described(lambda q, t, run: 0.4 * np.sin(2 * np.pi * q / 0.17), "q")
    assert words.period == pytest.approx(0.17, rel=0.05)
    assert "periodically" in words.sentence


def test_a_push_that_is_constant_in_one_run_is_called_so() -> None:
    words = described(lambda q, t, run: np.where(run == 2, 0.5, 0.0), "run")
    assert words.sentence == "The rate of q_dot is off by a constant, in run_2 only."
    some = described(lambda q, t, run: 0.3 * np.array([-1.0, 1.0, -1.0, 1.0])[run], "run")
    assert some.sentence == "The rate of q_dot is off by constants that differ from run to run."


def test_a_push_at_one_time_is_local_in_time_and_has_no_symmetry() -> None:
    words = described(lambda q, t, run: 0.5 * np.exp(-(((t - t.min() - 4.0) / 0.4) ** 2)), "time")
    assert (words.extent, words.symmetry) == ("local", "")


def test_bins_give_means_and_errors_that_hold_noise_which_lasts() -> None:
    rng = np.random.default_rng(0)
    off = []
    for _ in range(60):
        block = np.repeat(np.arange(200), 20)
        value = rng.uniform(-1, 1, 4000)
        residual = np.repeat(rng.normal(size=200), 20) + value
        b = bins(value, residual, block)
        off.append((b.mean - b.centre) / b.error)
    inside = np.abs(np.concatenate(off)) < 1.645
    assert inside.mean() == pytest.approx(0.92, abs=0.04)


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


@pytest.mark.parametrize("sensor", [0.0, 0.02, 0.5])
def test_white_gusts_that_the_sensor_hides_are_no_disturbance_that_lasts(sensor: float) -> None:
    """What is fitted of them may be nothing; the largest that they may be is not, and what lasts is beyond it."""
    rng, dt, rows, gust = np.random.default_rng(2), 0.01, 6000, 0.05

    def parts(push: Array) -> tuple[float, float, float]:
        left = push + np.diff(sensor * rng.normal(size=rows + 1))
        steps = SimpleNamespace(segments=((0, rows),), dt=dt)
        physics = SimpleNamespace(steps=steps, residual=lambda theta: left[:, None])
        return white_parts(cast(Regression, SimpleNamespace(physics=physics, theta=None)), 0)

    white = gust * np.sqrt(dt) * rng.normal(size=rows)
    first, of_sensor, most = parts(white)
    assert first < most
    assert most > 0.9 * gust**2 * dt
    assert of_sensor == pytest.approx(sensor**2, rel=0.1, abs=1e-6)
    lasts = np.repeat(rng.normal(size=rows // 100), 100) * 0.05
    if sensor < 0.1:
        assert parts(lasts)[2] < 0.02 * 100 * float(np.square(lasts).mean())
