"""What columns explain of folds left out, from Gram matrices."""

from __future__ import annotations

import numpy as np

from nsde_torch.diagnosis.gram_table import GramTable
from nsde_torch.inference.sensitivity import Grams


def test_a_number_that_one_fold_alone_shows_stays_where_it_is_in_that_fold() -> None:
    # of rounding in the other folds it would go anywhere, and take what is left of the fold along
    rng = np.random.default_rng(0)
    blocks = []
    for block in range(8):
        shared = rng.normal(size=40)
        own = rng.normal(size=40) * (1.0 if block < 2 else 1e-12)
        candidate = rng.normal(size=40)
        error = rng.normal(size=40) + 2.0 * candidate
        table = np.column_stack((error, shared, own, candidate))
        blocks.append(table.T @ table)
    table = GramTable(Grams(np.array(blocks), 320, 3), np.array([1, 2]), np.array([0, 0, 1, 1, 2, 2, 3, 3]))
    nats, fitted, step = table.gain((0, 3))
    assert np.isfinite(nats).all()
    assert abs(step[0] - 2.0) < 0.2
    assert 0.8 * fitted < nats.sum() < 1.05 * fitted
