"""Chunks: every row after the first of each stretch counts once, beside its own input and time."""

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.inference.chunks import Chunks
from nsde_torch.inference.steps import steps_of
from tests.inference.springs import spring

Stretches = tuple[tuple[int, int], ...]


def numbered(lengths: tuple[int, ...], gaps: dict[int, Stretches], dt: float) -> list[Run]:
    out, at = [], 0
    for k, n in enumerate(lengths):
        number = np.arange(at, at + n, dtype=np.float64)
        x = np.column_stack([number, number])
        out.append(Run(f"run_{k}", dt * number, x, number[:, None], segments=gaps.get(k, ())))
        at += n
    return out


CASES: dict[str, tuple[tuple[int, ...], dict[int, Stretches]]] = {
    "one shorter than a chunk": ((50,), {}),
    "of two rows": ((2, 2), {}),
    "exactly a chunk": ((140,), {}),
    "a row more than a chunk": ((141,), {}),
    "long": ((2357,), {}),
    "several, long and short": ((700, 33, 141, 90), {}),
    "with gaps": ((800, 300), {0: ((0, 40), (45, 450), (500, 800)), 1: ((10, 12), (20, 299))}),
}


@pytest.mark.parametrize("dt", [0.1, 0.02, 0.001])
@pytest.mark.parametrize("late", [0, 30])
@pytest.mark.parametrize("case", CASES)
def test_each_row_after_the_first_ones_of_a_stretch_counts_once(case: str, late: int, dt: float) -> None:
    runs = numbered(*CASES[case], dt)
    chunks = Chunks(steps_of(spring(), runs, clock=1.0, smooth=False), late=late)
    expected = np.concatenate([run.x[a + 1 + late : b, 0] for run in runs for a, b in run.segments])
    counted = chunks.y[chunks.counted][:, 0].numpy()
    np.testing.assert_array_equal(np.sort(counted), expected)


@pytest.mark.parametrize("case", CASES)
def test_the_blocks_of_time_hold_each_counted_row_once(case: str) -> None:
    runs = numbered(*CASES[case], 0.02)
    chunks = Chunks(steps_of(spring(), runs, clock=1.0, smooth=False))
    edges = [a for a, _ in chunks.parts] + [chunks.parts[-1][1]]
    assert (edges[0], edges[-1]) == (0, chunks.size)
    assert edges == sorted(set(edges))
    assert [b for _, b in chunks.parts] == edges[1:]
