"""Brownian increments: law, determinism, coarsening."""

import pytest
import torch

from nsde_torch.errors import ShapeError, SolverError
from nsde_torch.sde import brownian, coarsen


def draw(seed: int = 0, **options: object) -> torch.Tensor:
    arguments = {"dt": 0.25, "generator": torch.Generator().manual_seed(seed), **options}
    return brownian(3, 4, 6, 2, **arguments)  # type: ignore[arg-type]


def test_one_seed_gives_one_path_of_the_shape_and_type_asked_for_and_global_state_is_left_alone() -> None:
    before = torch.get_rng_state()
    assert torch.equal(draw(7), draw(7))
    assert not torch.equal(draw(7), draw(8))
    assert draw().shape == (3, 4, 6, 2)
    assert draw(dtype=torch.float64).dtype == torch.float64
    assert torch.equal(before, torch.get_rng_state())


def test_increments_have_mean_zero_and_variance_dt() -> None:
    dw = brownian(100, 100, 10, 2, dt=0.25, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert abs(float(dw.mean())) < 5 * 0.5 / dw.numel() ** 0.5
    assert float(dw.var()) == pytest.approx(0.25, rel=0.02)


def test_coarse_increments_are_the_sums_of_the_fine_ones() -> None:
    dw = draw(dtype=torch.float64)
    coarse = coarsen(dw, 3)
    assert coarse.shape == (3, 4, 2, 2)
    assert torch.allclose(coarse[:, :, 1], dw[:, :, 3:].sum(2))
    assert torch.allclose(coarsen(dw, 6)[:, :, 0], dw.sum(2))


def test_steps_lie_outermost_in_memory_so_that_rollouts_copy_nothing() -> None:
    assert draw().permute(2, 0, 1, 3).is_contiguous()


def test_a_factor_that_does_not_divide_the_steps_is_refused() -> None:
    with pytest.raises(ShapeError, match="must divide the 6 steps"):
        coarsen(draw(), 4)


@pytest.mark.parametrize("dt", [0.0, -0.1, float("nan"), float("inf")])
def test_a_step_that_is_not_positive_and_finite_is_refused(dt: float) -> None:
    with pytest.raises(SolverError, match="`dt`"):
        draw(dt=dt)


def test_no_particles_are_refused() -> None:
    with pytest.raises(SolverError, match="`particles`"):
        brownian(0, 1, 1, 1, dt=0.1, generator=torch.Generator())
