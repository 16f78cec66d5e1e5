"""Stretches of rows: boxes, blocks and lags stay inside them."""

from __future__ import annotations

import numpy as np

from nsde_torch.sysid.noise import Series

TWO = Series(((0, 7), (7, 12)))


def test_boxes_sum_inside_a_stretch_and_drop_what_is_left_over() -> None:
    values = np.arange(12.0)
    np.testing.assert_array_equal(
        TWO.summed(values, 3),
        [
            3,
            12,
            24,
        ],
    )
    assert TWO.boxes(3).edges == ((0, 2), (2, 3))
    np.testing.assert_array_equal(TWO.summed(values, 1), values)


def test_lags_do_not_reach_over_the_start_of_a_stretch() -> None:
    lagged = TWO.lagged(np.arange(1.0, 13.0)[:, None], (1, 2))
    np.testing.assert_array_equal(lagged[:3], [[0, 0], [1, 0], [2, 1]])
    np.testing.assert_array_equal(lagged[7:10], [[0, 0], [8, 0], [9, 8]])


def test_blocks_are_of_one_stretch_and_about_as_long_as_asked() -> None:
    blocks = TWO.blocks(3)
    assert blocks[6] != blocks[7]
    assert set(np.bincount(blocks)) <= {2, 3, 4}
    np.testing.assert_array_equal(np.unique(blocks), np.arange(blocks.max() + 1))
