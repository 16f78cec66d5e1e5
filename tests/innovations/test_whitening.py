"""The whitening map of torch is that of the ARMA noise models."""

import numpy as np
import torch

from nsde_torch.innovations.whitening import Whitening
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.series import Series

NOISES = (
    Noise(0.0, np.zeros(0), 2.0),
    Noise(0.85, np.array([-0.5, 0.2]), 0.3),
    Noise(0.8, np.array([-0.3]), 0.1),
)
SERIES = Series(((0, 180), (180, 500)))


def test_rows_are_those_of_the_noise_model_away_from_the_start_of_a_stretch() -> None:
    rows = np.random.default_rng(0).standard_normal((500, 3))
    white = Whitening(NOISES, SERIES)(torch.from_numpy(rows.T.copy()).float()).numpy()
    for k, noise in enumerate(NOISES):
        own = noise.whiten(rows[:, [k]], SERIES)[:, 0]
        for i, (a, b) in enumerate(SERIES.edges):
            inside = slice(a + 120, b)
            np.testing.assert_allclose(white[k, inside], own[a + i + 121 : b + i + 1], atol=2e-3)


def test_members_are_whitened_alike_and_pass_gradients() -> None:
    whiten = Whitening(NOISES, SERIES)
    rows = torch.randn(2, 3, 500, generator=torch.Generator().manual_seed(1), requires_grad=True)
    both = whiten(rows)
    torch.testing.assert_close(both[1], whiten(rows[1]))
    (slope,) = torch.autograd.grad(both.square().sum(), rows)
    assert bool((slope.abs().sum((0, 1)) > 0).all())


def test_no_stretch_reaches_into_the_next() -> None:
    rows = torch.zeros(3, 500)
    rows[:, 100] = 1.0
    white = Whitening(NOISES, SERIES)(rows)
    assert float(white[:, 180:].abs().max()) < 1e-6
    assert float(white[:, 100:180].abs().max()) > 1.0
