"""Covariance from blocks: right for white noise, right for noise that lasts, honest where few blocks decide."""

from __future__ import annotations

import numpy as np

from nsde_torch.inference.spread import spread

ROWS, BLOCKS = 600, 60


def estimates(seed: int, *, lasting: bool) -> tuple[np.ndarray, np.ndarray]:
    """Error of a least-squares estimate of two parameters and its standard error by blocks."""
    rng = np.random.default_rng(seed)
    x = (
        np.repeat(rng.normal(size=(1, BLOCKS, 2)), ROWS // BLOCKS, axis=1)
        if lasting
        else rng.normal(size=(1, ROWS, 2))
    )
    noise = np.repeat(rng.normal(size=BLOCKS), ROWS // BLOCKS) if lasting else rng.normal(size=ROWS)
    fitted = np.linalg.lstsq(x[0], noise, rcond=None)[0]
    blocks = np.arange(ROWS) // (ROWS // BLOCKS)
    sure = spread(x, (noise - x[0] @ fitted)[None], blocks, 0)
    return fitted, np.sqrt(np.diag(sure.covariance))


def test_standard_errors_are_the_spread_of_estimates_also_when_noise_lasts_for_a_block() -> None:
    for lasting in (False, True):
        errors, claimed = map(
            np.array, zip(*(estimates(s, lasting=lasting) for s in range(300)), strict=True)
        )
        ratio = np.sqrt(np.square(claimed).mean(0)) / errors.std(0)
        assert (np.abs(ratio - 1) < 0.15).all(), (lasting, ratio)


def test_degrees_of_freedom_are_few_where_one_block_decides() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(1, ROWS, 2))
    x[0, ROWS // BLOCKS :, 1] *= 0.01  # the second parameter acts in the first block alone
    blocks = np.arange(ROWS) // (ROWS // BLOCKS)
    degrees = spread(x, rng.normal(size=(1, ROWS)), blocks, 0).degrees(np.eye(2))
    assert degrees[0] > 30
    assert degrees[1] < 1.5


def test_nothing_is_known_of_no_parameters() -> None:
    sure = spread(np.zeros((2, 30, 0)), np.ones((2, 30)), np.arange(30) // 10, 0)
    assert sure.covariance.shape == (0, 0)
    assert sure.parts.shape == (3, 0)
    np.testing.assert_array_equal(sure.degrees(np.zeros((4, 0))), np.zeros(4))
