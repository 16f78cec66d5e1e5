"""White sensor noise out of smooth motions: how much is left, and what is left alone."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from nsde_torch.data import Run, Windows
from nsde_torch.data.denoise import denoised

Array = NDArray[np.float64]
DT = 0.01


def swing(seed: int, n: int, noise: float, *, gap: bool = False) -> tuple[Run, Array]:
    """A decaying swing (position, velocity), measured with white noise, and the swing itself."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    phase = rng.uniform(0, 2 * np.pi)
    q = np.exp(-0.2 * t) * np.cos(2.0 * t + phase)
    truth = np.stack([q, np.gradient(q, DT)], 1)
    x = truth + noise * rng.standard_normal(truth.shape)
    segments = ((0, n // 2), (n // 2, n)) if gap else ((0, n),)
    return Run(f"swing_{seed}", t, x, np.zeros((n, 1)), segments=segments), truth


@pytest.mark.parametrize("noise", [0.003, 0.03, 0.2])
def test_what_is_left_of_the_noise_is_as_small_as_it_says(noise: float) -> None:
    runs, truths = zip(*(swing(seed, 800, noise) for seed in range(4)), strict=True)
    smooth, share = denoised(runs)
    left = np.sqrt(np.mean([np.square(s - t).mean(0) for s, t in zip(smooth, truths, strict=True)], 0))
    assert (share < 0.4).all()
    assert (left < 1.5 * share * noise).all()
    assert (left > 0.6 * share * noise).all()


def test_a_jump_between_segments_is_not_smoothed_over() -> None:
    run, _ = swing(0, 600, 0.01, gap=True)
    x = np.array(run.x)
    x[300:] += 5.0
    jumped = Run("jumped", run.t, x, run.u, segments=run.segments)
    (smooth,), _ = denoised([jumped])
    assert abs(np.diff(smooth[:, 0])[299] - 5.0) < 0.1


def test_windows_start_from_denoised_states_and_compare_with_measured_ones() -> None:
    run, truth = swing(2, 600, 0.05)
    plain = Windows([run], DT, 20, dtype=torch.float64)
    clean = Windows([run], DT, 20, dtype=torch.float64, denoise=True)
    pick = torch.arange(50, 500)
    assert torch.equal(plain.initial_states(pick), plain.batch(pick)[0][:, 0])
    assert torch.equal(clean.batch(pick)[0], plain.batch(pick)[0])
    error = clean.initial_states(pick) - torch.from_numpy(truth[50:500])
    assert float(error.square().mean().sqrt()) < 0.02
    assert (clean.start_share < 0.4).all()
    assert torch.equal(plain.start_share, torch.ones(2, dtype=torch.float64))
