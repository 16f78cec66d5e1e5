"""The steps that values of a column come in: of an encoder, of decimals, of significant digits, of floats."""

from __future__ import annotations

import numpy as np
import pytest

from nsde_torch.recording.noise import grains, quantum

VALUES = np.random.default_rng(0).normal(size=5000)


def test_decimals_and_encoders_have_one_step() -> None:
    assert quantum(np.round(VALUES, 3)) == pytest.approx(1e-3)
    step = 2.0 * np.pi / 4096.0
    assert grains(step * np.round(VALUES / step)) == pytest.approx(np.full(5000, step))


def test_significant_digits_have_a_step_for_each_size() -> None:
    written = np.array([float(f"{v:.4g}") for v in VALUES])
    expected = 10.0 ** (np.floor(np.log10(np.abs(written))) - 3)
    large = np.abs(written) > 0.01  # smaller ones are further apart than their last digit
    assert grains(written)[large] == pytest.approx(expected[large])
    assert quantum(written) == pytest.approx(1e-4)


def test_floats_have_next_to_none_and_a_column_at_rest_has_none() -> None:
    assert quantum(VALUES) < 1e-5
    assert quantum(np.zeros(10)) == 0.0
    assert quantum(np.empty(0)) == 0.0
