"""A long recording is checked and cut within a small multiple of its size (10 h at 100 Hz: 1.4 GiB)."""

from __future__ import annotations

import tracemalloc

import numpy as np
import torch

from nsde_torch.data import RawRun, Windows
from nsde_torch.recording import assemble
from tests.helpers.data_systems import HEXACOPTER


def test_checking_and_windowing_take_at_most_four_times_the_data() -> None:
    n = 100_000
    t = 0.01 * np.arange(n)
    x = np.zeros((n, 13))
    x[:, 0], x[:, 3], x[:, 6] = np.sin(t), np.cos(t), 1.0
    u = 0.4 + 0.1 * np.sin(np.outer(t, np.arange(1, 7)))
    size = t.nbytes + x.nbytes + u.nbytes
    raw = [RawRun("long", t, x, u)]
    tracemalloc.start()  # the raw arrays above are not counted: they come on top, once
    try:
        data = assemble(raw, HEXACOPTER, kind="test", clock="trust")
        windows = Windows(data.runs, 0.05, 20)
        train, _ = windows.held_out(0.15, 10.0, torch.Generator().manual_seed(0))
        train.batch(train.sample(512, torch.Generator().manual_seed(0)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * size
