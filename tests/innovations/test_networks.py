"""Networks learn what innovations show, nothing where nothing is missing, and not what inputs remember."""

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor, nn

from nsde_torch.innovations.networks import Learned, NetworkSettings, fit_networks
from nsde_torch.models.networks import MLP
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.series import Series

N = 3000
SERIES = Series(((0, 1200), (1200, N)))
NOISE = Noise(0.5, np.array([-0.4]), 1.0)
SETTINGS = NetworkSettings(
    steps=100, rate=0.01, every=20, patience=3, folds=3, block=150, penalty=lambda _: torch.zeros(())
)


def coloured(white: np.ndarray) -> np.ndarray:
    """Noise whose law is `NOISE`."""
    return np.asarray(lfilter([1.0, -NOISE.carry], NOISE.polynomial, white))


def learn(
    change: np.ndarray, y: np.ndarray, seed: int, nuisance: Tensor | None = None
) -> tuple[Learned, Tensor]:
    network = MLP(1, (8, 8), 1, activation=torch.tanh, generator=torch.Generator().manual_seed(seed))
    nn.init.zeros_(network.layers[-1].weight)  # type: ignore[arg-type, union-attr]
    seen = torch.from_numpy(y[:, None]).float()

    def predict(module: nn.Module) -> Tensor:
        return module(seen).T  # type: ignore[no-any-return]

    learned = fit_networks(
        network,
        predict,
        torch.from_numpy(change[None]).float(),
        [NOISE],
        SERIES,
        [[0]],
        SETTINGS,
        nuisance=torch.zeros(N, 0) if nuisance is None else nuisance,
        keep=[False],
        generator=torch.Generator().manual_seed(seed),
    )
    return learned, predict(network).detach()[0]


def test_a_force_of_the_state_is_learned() -> None:
    rng = np.random.default_rng(0)
    y = lfilter([0.1], [1.0, -0.9], 3 * rng.standard_normal(N))
    truth = 0.8 * np.tanh(2 * y)
    learned, found = learn(truth + coloured(rng.standard_normal(N)), y, 0)
    assert learned.kept == (True,)
    assert np.corrcoef(found.numpy(), truth)[0, 1] > 0.95
    assert learned.gain[0] > 3 * learned.error[0]


def test_nothing_is_learned_where_nothing_is_missing() -> None:
    kept = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        y = lfilter([0.1], [1.0, -0.9], 3 * rng.standard_normal(N))
        kept.append(learn(coloured(rng.standard_normal(N)), y, seed)[0].kept[0])
    assert sum(kept) <= 1


def test_a_network_of_the_state_does_not_stand_in_for_a_lag_of_inputs_that_answer_the_state() -> None:
    rng = np.random.default_rng(3)
    y = lfilter([0.1], [1.0, -0.9], 3 * rng.standard_normal(N))
    u = -y + 0.3 * rng.standard_normal(N)
    late = lfilter([0.0, 0.3], [1.0, -0.7], u) - u  # what a lag leaves of the input
    change = 1.5 * late + coloured(rng.standard_normal(N))
    history = torch.from_numpy(
        np.stack([u, *(lfilter([0.0, 1 - c], [1.0, -c], u) for c in (0.0, 0.5, 0.8))], 1)
    )
    assert learn(change, y, 0)[0].kept == (True,)
    assert learn(change, y, 0, history.float())[0].kept == (False,)
