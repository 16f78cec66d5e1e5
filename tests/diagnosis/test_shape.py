"""Words for a dependence, on residuals that are made to have it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.diagnosis.regressors import Regressors, regressors
from nsde_torch.diagnosis.residual_tests import Dependence, dependences
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.shape import Shape, bins, rates, shape
from nsde_torch.inference.steps import steps_of
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded

Array = NDArray[np.float64]
Push = Callable[[Array, Array, Array], Array]

RUNS = ("run_0", "run_1", "run_2", "run_3")


def pushed(push: Push, times: str = "") -> tuple[Regression, Regressors]:
    """A spring whose residual rate is that of noise and a push (of q, time, number of the run) [m/s2].

    Args:
        push: The push.
        times: Another variable that it is multiplied by.
    """
    system = make_system("mass_spring_damper")
    data = recorded("mass_spring_damper", durations=(8.0,) * 4)
    steps = steps_of(system, data.runs, clock=1.0, smooth=False, denoise=True, run_in=True)
    r = Search(steps, box=1, alpha=0.01).quick(system)
    variables = regressors(r)
    force = push(variables.values("q"), variables.values("time"), r.owners)
    force *= variables.values(times) if times else 1.0
    r.residual[:, r.rows[0]] += force * r.dt
    r.noises = r.own_noises()
    (noise,) = r.noises
    r.white = noise.whiten(r.residual[:, r.rows], r.series).T
    r.slopes = noise.whiten(r.jacobian[:, r.rows[0]], r.series)[None]
    return r, variables


def described(push: Push, variable: str) -> Shape:
    r, variables = pushed(push)
    test = max((d for d in dependences(r, variables) if d.variable == variable), key=lambda d: d.excess)
    return shape(r, test, variables, rates(r, variables), RUNS)


def test_an_odd_dependence_over_the_whole_range_is_called_so() -> None:
    words = described(lambda q, t, run: -3.0 * q**3, "q")
    assert (words.channel, words.symmetry, words.extent) == ("q_dot", "odd", "global")
    assert words.period is None
    assert words.only_run is None
    assert "odd" in words.sentence


def test_an_even_dependence_is_called_so() -> None:
    assert described(lambda q, t, run: 2.0 * (q**2 - 0.02), "q").symmetry == "even"


def test_a_bump_in_one_place_is_local_and_its_place_is_told() -> None:
    words = described(lambda q, t, run: 0.6 * np.exp(-(((q - 0.2) / 0.03) ** 2)), "q")
    assert words.extent == "local"
    assert words.where is not None
    assert words.where[0] < 0.2 < words.where[1]


def test_teeth_along_the_way_are_periodic() -> None:
    words = described(lambda q, t, run: 0.4 * np.sin(2 * np.pi * q / 0.17), "q")
    assert words.period == pytest.approx(0.17, rel=0.05)
    assert "periodically" in words.sentence


def test_what_happens_in_one_run_only_is_said() -> None:
    words = described(lambda q, t, run: np.where(run == 2, -1.5 * q, 0.0), "q")
    assert words.only_run == 2
    assert "in run_2 only" in words.sentence


def test_a_push_that_is_constant_in_one_run_is_called_so() -> None:
    words = described(lambda q, t, run: np.where(run == 2, 0.5, 0.0), "run")
    assert words.sentence == "The rate of q_dot is off by a constant, in run_2 only."
    some = described(lambda q, t, run: 0.3 * np.array([-1.0, 1.0, -1.0, 1.0])[run], "run")
    assert some.sentence == "The rate of q_dot is off by constants that differ from run to run."


def test_a_push_at_one_time_is_local_in_time_and_has_no_symmetry() -> None:
    words = described(lambda q, t, run: 0.5 * np.exp(-(((t - t.min() - 4.0) / 0.4) ** 2)), "time")
    assert words.extent == "local"
    assert words.symmetry == ""


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


def test_mean_rates_are_those_of_the_push() -> None:
    seen = rates(*pushed(lambda q, t, run: 4.0 * q))
    own = seen.residual[:, seen.names.index("q_dot")]
    slope = np.polyfit(seen.values["q"], own, 1)[0]
    assert slope == pytest.approx(4.0, rel=0.1)
    assert seen.units[seen.names.index("q_dot")] == "m/s2"
    assert len(seen.run) == len(seen.block) == len(own)


def test_a_single_moment_is_described_without_functions_of_anything() -> None:
    r, variables = pushed(lambda q, t, run: 0.0 * q)
    single = Dependence("q_dot", "time", 1e-6, 0.1, 0.0, gain=40.0, functions=1, run=1, moment=3.5)
    words = shape(r, single, variables, rates(r, variables), RUNS)
    assert (words.only_run, words.extent, words.symmetry) == (None, "local", "")
    assert "3.5 s" in words.sentence


def test_a_well_in_one_place_is_local_and_not_periodic() -> None:
    def well(q: Array, t: Array, run: Array) -> Array:
        return -0.5 * (q - 0.15) / 0.05 * np.exp(-0.5 * ((q - 0.15) / 0.05) ** 2)

    words = described(well, "q")
    assert words.period is None
    assert words.extent == "local"
    assert words.where is not None
    assert words.where[0] < 0.15 < words.where[1]
