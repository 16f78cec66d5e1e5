"""Covariance from blocks: right for white noise, right for noise that lasts, honest where few blocks decide."""

import numpy as np

from nsde_torch.inference.spread import spread

ROWS, BLOCKS = 600, 60


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
