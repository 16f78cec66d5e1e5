"""Specification tests: their size where nothing is missing, and their power at alternatives of known size.

The residual of a spring is replaced by noise of a known kind (a white push and a sensor's differences) and a push
that is put in; noise models are found from it as in a diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.diagnosis.evidence import hotelling
from nsde_torch.diagnosis.periodicity import lines
from nsde_torch.diagnosis.regressors import Regressors, own_space, projected, regressors
from nsde_torch.diagnosis.residual_tests import Dependence, beyond_chance, dependences
from nsde_torch.diagnosis.search import Search
from nsde_torch.inference.steps import steps_of
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded

Array = NDArray[np.float64]

SPRING = "mass_spring_damper"
NULLS, SHAPED = 12, 5
PUSH, SENSOR = 0.006, 0.006  # m/s each step, of what pushes and of the sensor


class Drawn:
    """A regression whose residual is drawn anew."""

    def __init__(self) -> None:
        system = make_system(SPRING)
        data = recorded(SPRING, durations=(8.0,) * 4, dt=0.02)
        steps = steps_of(system, data.runs, clock=1.0, smooth=False, denoise=True, run_in=True)
        self.regression: Regression = Search(steps, box=1, alpha=0.01).quick(system)
        self.variables: Regressors = regressors(self.regression)

    def draw(
        self, seed: int, force: Array | float = 0.0, noises: Sequence[Noise] | None = None
    ) -> Regression:
        """Noise, and a force that pushes [m/s2], under noise models of its own or given ones."""
        r, rng = self.regression, np.random.default_rng(seed)
        rows, channel = len(r.series), r.rows[0]
        sensor = np.diff(rng.normal(size=rows + 1))
        r.residual[:, channel] = PUSH * rng.normal(size=rows) + SENSOR * sensor + force * r.dt
        r.noises = r.own_noises() if noises is None else list(noises)
        (noise,) = r.noises
        r.white = noise.whiten(r.residual[:, r.rows], r.series).T
        r.slopes = noise.whiten(r.jacobian[:, channel], r.series)[None]
        return r

    def tests(
        self, seed: int, force: Array | float = 0.0, noises: Sequence[Noise] | None = None
    ) -> list[Dependence]:
        """All tests of such a residual."""
        return dependences(self.draw(seed, force, noises), self.variables)


@pytest.fixture(scope="module")
def spring() -> Drawn:
    return Drawn()


@pytest.fixture(scope="module")
def nulls(spring: Drawn) -> list[list[Dependence]]:
    return [spring.tests(seed) for seed in range(NULLS)]


# ---- size -------------------------------------------------------------------------------------------------


def test_noise_has_no_structure_beyond_chance(nulls: list[list[Dependence]]) -> None:
    # twelve data sets at a chance of one in ten: five or more of them would be one case in two hundred
    assert sum(bool(beyond_chance(tests, {}, alpha=0.1)) for tests in nulls) <= 4
    assert not any(beyond_chance(tests, {}, alpha=1e-3) for tests in nulls)


def test_p_values_of_all_tests_of_noise_are_none_too_small(nulls: list[list[Dependence]]) -> None:
    p = np.array([d.p for tests in nulls for d in tests])
    assert len(p) > 200
    for level in (0.01, 0.05, 0.1, 0.2, 0.5):
        assert (p < level).mean() <= level + 3 * (level * (1 - level) / len(p)) ** 0.5


def test_what_functions_explain_of_noise_is_half_a_nat_each(nulls: list[list[Dependence]]) -> None:
    everywhere = [
        d for tests in nulls for d in tests if d.everywhere and d.variable in ("q", "q_dot", "force")
    ]
    excess = np.array([d.excess / d.functions for d in everywhere])
    assert abs(excess.mean()) < 0.2


def test_the_highest_line_of_noise_is_no_line(spring: Drawn) -> None:
    p = [lines(spring.draw(seed))[0].p for seed in range(20)]
    assert np.mean(np.array(p) < 0.1) <= 0.3
    assert min(p) > 1e-4


# ---- power ------------------------------------------------------------------------------------------------


def test_a_friction_is_found_on_its_variable_as_what_it_is(spring: Drawn) -> None:
    force = -0.2 * np.sign(spring.variables.values("q_dot"))
    for seed in range(SHAPED):
        tests = spring.tests(seed, force)
        first = beyond_chance(tests, {}, alpha=0.01)[0]
        assert (first.channel, first.variable, first.run) == ("q_dot", "q_dot", None)
        assert first.odd > 0.8


def test_what_a_weak_force_brings_is_half_its_squared_size_in_standard_deviations(spring: Drawn) -> None:
    force = -0.09 * np.sign(spring.variables.values("q_dot"))
    r = spring.draw(0)
    noises = r.noises
    z = projected(r, 0, force[:, None], own_space(r, 0))
    expected = 0.5 * float(np.square(z).sum())

    def brought(noises: Sequence[Noise] | None) -> float:
        tests = (d for seed in range(SHAPED) for d in spring.tests(seed, force, noises))
        return float(np.mean([d.excess for d in tests if d.variable == "q_dot" and d.run is None]))

    assert expected > 10.0
    assert brought(noises) == pytest.approx(expected, rel=0.3)
    # a noise model that was fitted to it has learned a part of it: the test is careful, and never bold
    assert 0.0 < brought(None) < expected


def _bump(spring: Drawn) -> Iterator[tuple[int, float, Array]]:
    r, t = spring.regression, spring.variables.t
    for run in (1, 3):
        own = r.owners == run
        middle = float(t[own].mean())
        yield run, middle, np.where(own, 2.5 * np.exp(-np.square((t - middle) / 0.1)), 0.0)


def test_a_single_push_is_found_at_its_moment(spring: Drawn) -> None:
    for run, middle, force in _bump(spring):
        moment = next(d for d in spring.tests(0, force) if d.moment is not None)
        assert moment.p < 1e-3
        assert moment.run == run
        assert moment.moment == pytest.approx(middle, abs=0.4)


def test_a_sinusoid_is_found_at_its_frequency(spring: Drawn) -> None:
    rows = np.arange(len(spring.regression.series)) * spring.regression.dt
    for frequency in (3.7, 9.1):
        (first, *_) = lines(spring.draw(0, 0.4 * np.sin(2 * np.pi * frequency * rows)))
        assert first.p < 1e-4
        assert first.frequency == pytest.approx(frequency, abs=0.1)


def test_of_a_single_block_the_scatter_of_blocks_says_nothing() -> None:
    rng = np.random.default_rng(0)
    z, same = np.linalg.qr(rng.normal(size=(40, 2)))[0], np.zeros(40, dtype=np.int64)
    assert hotelling(z, rng.normal(size=40), same) == 0.0  # the test of the likelihood alone decides
