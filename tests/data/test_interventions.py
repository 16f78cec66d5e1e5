"""Interventions: where predictions start, and what a column that is none is told."""

import numpy as np
import pytest
import torch

from nsde_torch.data import DataSet, RawRun, Run, Windows
from nsde_torch.data.interventions import COLUMN, longest_stretch, stretches
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import MSD


def run(on: list[tuple[int, int]], n: int = 120, segments: tuple[tuple[int, int], ...] = ()) -> Run:
    """Row k holds x = (k, -k), u = k; `intervention` is 1 in the ranges."""
    k = np.arange(n, dtype=float)
    column = np.zeros(n)
    for a, b in on:
        column[a:b] = 1.0
    return Run("a", 0.01 * k, np.stack([k, -k], 1), k[:, None], segments=segments, extra={COLUMN: column})


def test_an_intervention_lasts_until_its_column_falls_or_its_segment_ends() -> None:
    some = run([(10, 21), (60, 120)], segments=((0, 50), (55, 100), (105, 120)))
    # the state at row 21 is still the work of inputs from outside; 105 has nothing before it
    assert stretches(some) == [(10, 22), (60, 100)]
    assert longest_stretch([some]) == pytest.approx(0.39)
    assert stretches(Run("b", some.t, some.x, some.u)) is None


def test_windows_are_evaluated_from_interventions_and_nowhere_else() -> None:
    some = run([(10, 21), (30, 35), (70, 120)], segments=((0, 50), (55, 120)))
    windows = Windows([some, run([(40, 60)])], 0.02, 5)
    x, u, _ = windows.batch(windows.starts(0.05))
    assert x[:, 0, 0].tolist() == [10, 70, 40]  # 30 has only 5 of 10 rows
    assert u[0, :, 0].tolist() == [10.5, 12.5, 14.5, 16.5, 18.5]
    shorter = windows.shortened(2)
    assert shorter.batch(shorter.starts(0.05))[0][:, 0, 0].tolist() == [10, 30, 70, 40]
    train, held = windows.held_out(0.4, 0.2, torch.Generator().manual_seed(0))
    for part in (train, held):
        rows = part.batch(part.starts(0.05))[0][:, 0, 0].tolist() if len(part.starts(0.05)) else []
        assert set(rows) <= {10, 70, 40}


def raw(column: np.ndarray | None, name: str = "a") -> RawRun:
    n = 300
    t = 0.01 * np.arange(n)
    x = np.stack([np.sin(t), np.cos(t)], 1)
    return RawRun(name, t, x, np.sin(3 * t)[:, None], extra={} if column is None else {COLUMN: column})


def read(*runs: RawRun) -> DataSet:
    return assemble(list(runs), MSD, kind="csv")


def test_a_column_that_is_no_intervention_is_refused() -> None:
    on = np.repeat([0.0, 1.0], 150)
    assert "1 interventions" in str(read(raw(on)).summary)
    with pytest.raises(DataError, match="row 150: the column 'intervention' holds 2; it takes 0, and 1"):
        read(raw(2 * on))
    with pytest.raises(DataError, match="in run 'a' and not in 'b'"):
        read(raw(on), raw(None, "b"))
    with pytest.raises(DataError, match="never changes from 0 to 1"):
        read(raw(np.ones(300)))


def test_a_start_stays_at_its_time_when_the_run_is_resampled() -> None:
    on = np.repeat([0.0, 1.0], 150)
    data = assemble([raw(on)], MSD, kind="csv", dt=0.02)
    assert stretches(data.runs[0]) == [(75, 150)]
