"""How slow a machine is, from how long what moves takes to change."""

import numpy as np
import pytest

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.data.pace import at_their_pace, typical_time

RNG = np.random.default_rng(3)


def wandering(seconds: float, dt: float, rows: int) -> Array:
    """A column that forgets in so many seconds (rows, 1)."""
    x, keep = np.zeros(rows), np.exp(-dt / seconds)
    for k, push in enumerate(RNG.standard_normal(rows - 1)):
        x[k + 1] = keep * x[k] + (1.0 - keep**2) ** 0.5 * push
    return x[:, None]


def run(dt: float, state: Array, force: Array, **further: object) -> Run:
    return Run("r", dt * np.arange(float(len(state))), state, force, **further)


@pytest.mark.parametrize(
    ("seconds", "dt", "pace"), [(0.5, 0.01, 1.0), (100.0, 2.0, 100.0 * 0.69 / 0.5), (0.01, 2e-4, 0.069)]
)
def test_it_is_that_of_what_moves(seconds: float, dt: float, pace: float) -> None:
    x, u = (wandering(seconds, dt, 20_000) for _ in range(2))  # log 2 of the time until half of the variance
    (found,) = at_their_pace([run(dt, x, u)])
    assert found.pace == pytest.approx(pace, rel=0.25)
    noisy = x + 0.3 * RNG.standard_normal(x.shape)
    assert at_their_pace([run(dt, noisy, u)])[0].pace == pytest.approx(pace, rel=0.4)


def test_a_slow_state_under_a_quick_input_is_no_slow_machine() -> None:
    x, u = wandering(100.0, 0.1, 20_000), wandering(0.4, 0.1, 20_000)
    assert at_their_pace([run(0.1, x, u)])[0].pace == 1.0


def test_white_noise_and_what_stands_say_nothing() -> None:
    x = np.column_stack((wandering(100.0, 1.0, 20_000), RNG.standard_normal(20_000), np.ones(20_000)))
    (found,) = at_their_pace([run(1.0, x, np.zeros((20_000, 1)))])
    assert found.pace == pytest.approx(138.0, rel=0.25)


def test_short_pieces_do_not_make_a_machine_fast() -> None:
    x, u = (wandering(0.5, 0.01, 500) for _ in range(2))
    pieces = tuple((a, a + 5) for a in range(0, 500, 5))
    (found,) = at_their_pace([run(0.01, x, u, segments=pieces)])
    assert found.pace == 1.0
    assert typical_time([found]) == np.inf
