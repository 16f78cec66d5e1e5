"""What the past of kinematic residuals predicts is known before each row, and only that."""

from __future__ import annotations

import numpy as np

from nsde_torch.sysid.noise import Series, faded, past

TWO = Series(((0, 500), (500, 3000)))


def test_columns_are_orthonormal_and_blind_to_the_present_the_future_and_other_stretches() -> None:
    s = np.random.default_rng(0).normal(size=(3000, 2))
    basis = past(s, TWO)
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-9)
    changed = s.copy()
    changed[800:] += 3.0  # whitened row 802 is that of step 800
    span = past(changed, TWO)
    # the rows before the change span the same space in both
    early, other = basis[:803], span[:803]
    left = early - other @ np.linalg.lstsq(other, early, rcond=None)[0]
    assert np.abs(left).max() < 1e-9
    np.testing.assert_allclose(basis[[0, 1, 501, 502]], 0.0, atol=1e-12)


def test_few_rows_give_no_columns_that_they_could_not_bear() -> None:
    s = np.random.default_rng(0).normal(size=(900, 1))
    assert past(s, Series(((0, 900),))).shape == (901, 0)


def test_with_all_channels_short_data_bear_what_they_need_and_it_is_past() -> None:
    s = np.random.default_rng(0).normal(size=(900, 4))
    one = Series(((0, 900),))
    assert past(s, one).shape == (901, 0)
    basis = past(s, one, channels=True)
    assert basis.shape == (901, 12)
    changed = s.copy()
    changed[500:] += 3.0  # whitened row 502 is the first that knows of it
    before, after = (faded(v, one, channels=True) for v in (s, changed))
    np.testing.assert_array_equal(before[:502], after[:502])
    assert np.abs(before[502] - after[502]).max() > 1.0
