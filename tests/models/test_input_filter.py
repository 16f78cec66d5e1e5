"""The input filter: it leaves gains alone, keeps to its own time grid, and can undo a moving average."""

import pytest
import torch
from torch import Tensor

from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.models.networks import InputFilter


def inputs(batch: int, horizon: int, seed: int = 0, n: int = 2) -> Tensor:
    return torch.randn(batch, horizon, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def make_filter(reach: int, dt: float = 0.05, seed: int | None = 0) -> InputFilter:
    made = InputFilter(reach, dt).double().requires_grad_(False)
    if seed is not None:
        made.weights.normal_(generator=torch.Generator().manual_seed(seed))
    return made


@pytest.mark.parametrize("dt", [0.05, 0.02, 0.1])
def test_constants_pass_unchanged_whatever_the_weights(dt: float) -> None:
    u = torch.tensor([0.3, -2.0], dtype=torch.float64).expand(2, 15, 2)
    torch.testing.assert_close(make_filter(4)(u, dt), u)


def test_inside_a_window_it_is_the_stated_sum() -> None:
    made, u = make_filter(2), inputs(1, 12)
    w = made.weights - made.weights.mean()
    for k in range(2, 10):
        expected = u[0, k] + sum(w[j + 2] * u[0, k + j] for j in range(-2, 3))
        torch.testing.assert_close(made(u, 0.05)[0, k], expected)


def test_weights_exist_that_undo_a_moving_average() -> None:
    """A smooth signal averaged over 0.4 s is restored to a few per cent; least squares finds the weights."""
    dt, n = 0.05, 2001
    t = dt * torch.arange(n, dtype=torch.float64)
    g = torch.Generator().manual_seed(0)
    phase = 6.28 * torch.rand(30, generator=g, dtype=torch.float64)
    frequency = 1.6 * torch.rand(30, generator=g, dtype=torch.float64)  # below the null at 2.5 Hz
    angle = 6.283185307179586 * frequency
    raw = torch.sin(angle[:, None] * t + phase[:, None]).sum(0)
    half = angle * 0.2
    gain = torch.where(half > 0, torch.sin(half) / half, torch.ones_like(half))
    smooth = (gain[:, None] * torch.sin(angle[:, None] * t + phase[:, None])).sum(0)
    made = make_filter(8, dt, seed=None)
    columns = []
    for j in range(17):
        made.weights.zero_()
        made.weights[j] = 1.0
        columns.append(made(smooth[None, :, None], dt)[0, 20:-20, 0] - smooth[20:-20])
    design = torch.stack(columns, 1)
    made.weights.copy_(
        torch.linalg.lstsq(design, (raw - smooth)[20:-20, None], driver="gelsd").solution[:, 0]
    )
    restored = made(smooth[None, :, None], dt)[0, 20:-20, 0]
    before = float((smooth - raw)[20:-20].std() / raw.std())
    after = float((restored - raw[20:-20]).std() / raw.std())
    assert before > 0.25
    assert after < 0.1 * before


def test_sampling_restores_logged_inputs_and_leaves_applied_ones() -> None:
    spec = SDESpec("hexacopter", dt=0.05, horizon=10, step="euler_maruyama", filter_reach=2)
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0)).requires_grad_(False)
    model.filter.weights.normal_(generator=torch.Generator().manual_seed(1))
    x0 = torch.zeros(1, 13)
    x0[:, 6] = 1.0
    u = 0.4 + 0.05 * inputs(1, 10, n=6).float()

    def sample(u: Tensor, applied: bool) -> Tensor:
        g = torch.Generator().manual_seed(0)
        return model.sample(x0, u, dt=0.05, particles=2, generator=g, applied=applied)

    torch.testing.assert_close(sample(u, False), sample(model.applied_inputs(u, 0.05), True))
    assert not torch.allclose(sample(u, False), sample(u, True))
