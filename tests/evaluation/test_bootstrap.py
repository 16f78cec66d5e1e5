"""The paired bootstrap: intervals hold what they say on errors correlated in time; no difference where none is."""

import math

import numpy as np
import pytest
import torch

from nsde_torch.errors import ShapeError
from nsde_torch.evaluation.bootstrap import Blocks, make_blocks, mean_bootstrap, paired_bootstrap

DT = 0.25


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def one_run(starts: int) -> Blocks:
    """Blocks of 4 s of a single run."""
    return make_blocks(np.zeros(starts, dtype=np.int64), DT * np.arange(starts), length=4.0)


def correlated(shape: tuple[int, int], tau: float, rng: np.random.Generator) -> np.ndarray:
    """Stationary unit Gaussian sequences (columns) with the correlation exp(-t / tau)."""
    keep = math.exp(-DT / tau)
    out = np.empty(shape)
    out[0] = rng.standard_normal(shape[1])
    for k in range(1, shape[0]):
        out[k] = keep * out[k - 1] + math.sqrt(1 - keep**2) * rng.standard_normal(shape[1])
    return out


def held(tau: float, *, runs: int, seconds: float, single: bool = False) -> float:
    """Share of 400 repetitions in which the 95 % interval holds the true difference of two correlated errors."""
    rng, n, many = np.random.default_rng(0), round(seconds / DT), 400
    parts = []
    for _ in range(runs):
        shared, own, other = (correlated((n, many), tau, rng) for _ in range(3))
        parts.append((shared + 0.5 * own, 0.9 * shared + 0.7 * other))
    first, second = (torch.from_numpy(np.concatenate([p[k] for p in parts])) ** 2 for k in range(2))
    run, t = np.repeat(np.arange(runs), n), np.tile(DT * np.arange(n), runs)
    blocks = Blocks(np.arange(len(run)), len(run), "starts") if single else make_blocks(run, t, length=4.0)
    made = paired_bootstrap(first, second, blocks, generator=generator(), replicates=600)
    truth = math.sqrt(0.81 + 0.49) - math.sqrt(1.25)
    return float(((made.low <= truth) & (made.high >= truth)).double().mean())


@pytest.mark.parametrize(
    ("tau", "runs", "seconds"), [(0.1, 1, 60.0), (0.5, 3, 40.0), (1.0, 3, 60.0), (0.5, 12, 20.0)]
)
def test_intervals_hold_the_true_difference_of_errors_correlated_in_time(
    tau: float, runs: int, seconds: float
) -> None:
    assert 0.89 <= held(tau, runs=runs, seconds=seconds) <= 0.98


def test_resampling_single_starts_would_not() -> None:
    assert held(1.0, runs=3, seconds=60.0, single=True) < 0.8


def test_equal_errors_show_no_difference() -> None:
    errors = torch.rand(200, 7, generator=generator())
    made = paired_bootstrap(errors, errors.clone(), one_run(200), generator=generator())
    assert not torch.stack((made.value, made.low, made.high)).any()
    assert made.words() == ["no difference"] * 7


def test_the_difference_is_that_of_the_root_mean_squares_in_its_sign() -> None:
    first = torch.rand(400, 2, generator=generator(), dtype=torch.float64) + 1
    other = first * torch.tensor([4.0, 0.25])
    blocks = one_run(400)
    made = paired_bootstrap(first, other, blocks, generator=generator())
    root = first.mean(0).sqrt()
    torch.testing.assert_close(made.value, root * torch.tensor([1.0, -0.5]))
    assert made.words() == ["worse", "better"]
    assert bool(((made.low < made.value) & (made.value < made.high)).all())


def test_it_repeats_with_the_generator() -> None:
    first, other = torch.rand(2, 100, 3, generator=generator())
    blocks = one_run(100)
    a, b, c = (paired_bootstrap(first, other, blocks, generator=generator(s)).low for s in (0, 0, 1))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


def test_blocks_are_stretches_of_one_run_and_of_about_the_length() -> None:
    run = np.repeat([0, 1], [100, 30])
    t = np.concatenate([DT * np.arange(100), 50 + DT * np.arange(30)])
    blocks = make_blocks(run, t, length=4.0)
    assert blocks.unit == "blocks of 4 s"
    assert blocks.count == 8  # 25 s and 7.5 s
    assert len(np.unique(blocks.of_start)) == 8
    for k in range(8):
        rows = np.flatnonzero(blocks.of_start == k)
        assert len(np.unique(run[rows])) == 1
        assert np.ptp(rows) == len(rows) - 1
        assert 3.0 <= DT * len(rows) <= 5.0


def test_with_ten_runs_whole_runs_are_resampled() -> None:
    run = np.repeat(np.arange(10), 40)
    blocks = make_blocks(run, np.tile(DT * np.arange(40), 10), length=4.0)
    assert (blocks.unit, blocks.count) == ("runs", 10)
    assert np.array_equal(blocks.of_start, run)


def test_a_gap_leaves_no_empty_block() -> None:
    t = DT * np.concatenate([np.arange(20), 400 + np.arange(20)])
    blocks = make_blocks(np.zeros(40, dtype=np.int64), t, length=4.0)
    assert set(blocks.of_start) == set(range(blocks.count))


def test_too_few_blocks_are_said_to_be_so() -> None:
    first, other = torch.rand(2, 48, 1, generator=generator())
    made = paired_bootstrap(first, other, one_run(48), generator=generator())
    assert one_run(48).count == 3
    assert made.words() == ["too few blocks"]
    assert bool(made.value.isfinite())


def test_starts_that_do_not_agree_are_refused() -> None:
    blocks = one_run(8)
    with pytest.raises(ShapeError, match="8 starts"):
        paired_bootstrap(torch.rand(9, 1), torch.rand(9, 1), blocks, generator=generator())


def test_intervals_of_a_mean_hold_what_they_say_on_rows_correlated_in_time() -> None:
    rng, n, many = np.random.default_rng(2), 80, 400
    values = torch.from_numpy(np.concatenate([0.2 + correlated((n, many), 0.5, rng) for _ in range(4)]))
    blocks = make_blocks(np.repeat(np.arange(4), n), np.tile(DT * np.arange(n), 4), length=4.0)
    made = mean_bootstrap(values, blocks, generator=generator(), level=0.9)
    inside = ((made.low < 0.2) & (made.high > 0.2)).double().mean()
    assert 0.85 < float(inside) < 0.95
    np.testing.assert_allclose(made.value.numpy(), values.numpy().mean(0))


def test_a_mean_of_few_blocks_has_no_interval_and_rows_must_agree() -> None:
    few = Blocks(np.arange(8) % 2, 2, "runs")
    made = mean_bootstrap(torch.ones(8, 1), few, generator=generator())
    assert float(made.value) == 1.0
    assert math.isnan(float(made.low))
    with pytest.raises(ShapeError, match="rows"):
        mean_bootstrap(torch.ones(7, 1), few, generator=generator())
