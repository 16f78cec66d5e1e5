"""What is wrong is said: smoothed sensors, logs that tell nothing, failed searches; bounds, and what is not shown."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.errors import DataError, NonFiniteError
from nsde_torch.inference import fit
from nsde_torch.inference.sensitivity import Grams
from nsde_torch.systems import make_system
from tests.inference.springs import TRUTH, B, G, K, linear_runs, rubbing, small_runs, spring, value


def smoothed(runs: list[Run], cutoff: float) -> list[Run]:
    """Runs whose rate went through a low-pass without lag [Hz], as a user would smooth it."""
    b, a = butter(2, cutoff, fs=1.0 / runs[0].dt)
    return [replace(run, x=np.column_stack([run.x[:, 0], filtfilt(b, a, run.x[:, 1])])) for run in runs]


@pytest.mark.parametrize("cutoff", [3.0, 10.0])
def test_a_rate_that_was_smoothed_is_objected_to(cutoff: float) -> None:
    runs = small_runs(rubbing(0.0), 2, 12.0, seed=2)
    assert fit(spring(values={}), runs).objections == []
    found = fit(spring(values={}), smoothed(runs, cutoff))
    assert any("q_dot could be predicted" in said for said in found.objections)


def test_a_stretch_of_which_no_row_counts_is_refused() -> None:
    (run,) = linear_runs(1, 3.0)
    with pytest.raises(DataError):
        fit(spring(), [replace(run.slice(0, 32), inferred={"q_dot": 0.4})])


def test_a_cart_with_a_pole_whose_ports_push_alike_is_fitted() -> None:
    values, noise = {"g": 1.2, "s": 0.09, "l": 0.6}, (0.004, 0.01, 0.01, 0.03)
    cart = replace(rubbing(0.0), system="cartpole", values=values, noise=noise)
    found = fit(make_system("cartpole"), small_runs(cart, 2, 8.0, seed=1))
    assert found.objections == []
    np.testing.assert_allclose(found.theta, [1.2, 0.09, 0.6], rtol=0.1)


SIZE, WIDTH = "coulomb_friction.size", "coulomb_friction.width"


def test_a_parameter_at_its_bound_has_no_standard_error_and_the_others_keep_theirs() -> None:
    runs = small_runs(rubbing(0.0), 2, 15.0)
    found, plain = fit(spring("coulomb_friction", values={}), runs), fit(spring(values={}), runs)
    size, error = value(found, SIZE)
    assert size < 1e-5
    assert np.isnan(error)
    assert np.isnan(value(found, WIDTH)[1])  # nothing rubs, so that no width shows
    assert {found.vector.labels[j] for j in found.free} == set(TRUTH)
    for label in TRUTH:
        (got, error), (alone, without) = value(found, label), value(plain, label)
        assert got == pytest.approx(alone, abs=0.3 * without)
        assert error == pytest.approx(without, rel=0.2)


def test_damping_pressed_against_nothing_leaves_the_others_near_the_truth() -> None:
    driven = {**TRUTH, B: -0.1}
    found = fit(spring(values={}), linear_runs(2, 12.0, values=driven))
    assert np.isnan(value(found, B)[1])
    got, error = value(found, G)
    assert np.isfinite(error)
    assert abs(got - TRUTH[G]) < 0.1


def test_what_the_log_does_not_show_is_not_free() -> None:
    runs = [replace(run, u=0.0 * run.u) for run in linear_runs(2, 8.0, values={**TRUTH, G: 0.0})]
    found = fit(spring(values={G: 1.1, K: 1.0, B: 0.5}), runs)
    assert value(found, G)[0] == pytest.approx(1.1)
    assert np.isnan(value(found, G)[1])
    assert abs(value(found, K)[0] - TRUTH[K]) < 3.0 * value(found, K)[1]


def test_steps_within_which_the_physics_diverges_are_named() -> None:
    slow = []
    for run in nsde_torch.simulate("cartpole", durations=[1.0, 1.0], seed=1).runs:
        x = run.x[:50] * (1.0, 0.02, 1.0, 0.02)
        slow.append(Run(run.name, 4.0 * np.arange(50), x, run.u[:50]))
    with pytest.raises(NonFiniteError, match=r"steps of 4 s, within which its physics may diverge"):
        fit(make_system("cartpole"), slow)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_a_step_that_bounds_stop_is_the_best_inside(seed: int, damping: float) -> None:
    """Inside, no slope is left; at a bound it points out (Karush, Kuhn and Tucker)."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(40, 7)) @ rng.normal(size=(7, 7))
    gram = rows.T @ rows
    low, high = -0.05 * rng.random(6), 0.05 * rng.random(6)
    step = Grams(gram[None], 40, 6).step(np.arange(6), damping, low, high)
    inner = gram[1:, 1:] + damping * np.diag(np.diag(gram)[1:])
    slope = (gram[1:, 0] - inner @ step) / np.sqrt(np.diag(inner))
    at_low, at_high = step <= low + 1e-12, step >= high - 1e-12
    assert (at_low | at_high).any()
    np.testing.assert_allclose(slope[~at_low & ~at_high], 0.0, atol=1e-6)
    assert (slope[at_low] <= 1e-6).all()
    assert (slope[at_high] >= -1e-6).all()
