"""What is wrong is said: sensors that a user smoothed, logs that tell nothing, searches that fail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.inference import fit
from nsde_torch.inference.sensitivity import Grams
from nsde_torch.systems import make_system
from tests.inference.springs import B, G, K, linear_runs, rubbing, small_runs, spring, value


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


def test_a_search_that_fails_has_not_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    step = Grams.step
    monkeypatch.setattr(Grams, "step", lambda *given: -step(*given))
    found = fit(spring(values={G: 1.0, K: 3.0, B: 0.5}), linear_runs(1, 6.0))
    assert value(found, K)[0] == pytest.approx(3.0)
    assert not found.settled


def test_a_cart_with_a_pole_whose_ports_push_alike_is_fitted() -> None:
    values, noise = {"g": 1.2, "s": 0.09, "l": 0.6}, (0.004, 0.01, 0.01, 0.03)
    cart = replace(rubbing(0.0), system="cartpole", values=values, noise=noise)
    found = fit(make_system("cartpole"), small_runs(cart, 2, 8.0, seed=1))
    assert found.objections == []
    np.testing.assert_allclose(found.theta, [1.2, 0.09, 0.6], rtol=0.1)
