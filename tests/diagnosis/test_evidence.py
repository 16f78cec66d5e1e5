"""Evidence and p values keep what they promise: exact folds, honest errors, chances; and what data cannot show.

Linear regressions with known noise stand for the fits of a diagnosis; every claim is held against many draws.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ncf

from nsde_torch.diagnosis.evidence import chance, jackknife, left_out, not_shown
from nsde_torch.diagnosis.gram_table import GramTable
from nsde_torch.diagnosis.joint_selection import JointSelection, Round
from nsde_torch.diagnosis.outcome import estimated
from nsde_torch.diagnosis.result import outlier_warnings
from nsde_torch.inference.sensitivity import Grams
from nsde_torch.inference.spread import spread
from nsde_torch.sysid.regression import Regression, shown

Array = NDArray[np.float64]

ROWS, BLOCKS, FOLDS, NULLS = 480, 40, 4, 300
BLOCK = np.arange(ROWS) * BLOCKS // ROWS
FOLD = np.arange(BLOCKS) * FOLDS // BLOCKS


def linear(x: Array, y: Array, blocks: NDArray[np.int64]) -> Regression:
    """The least-squares fit of y (N,) by x (N, k), at its optimum; `blocks` are those of time, of each row (N,)."""
    k = x.shape[1]
    theta = np.linalg.lstsq(x, y, rcond=None)[0] if k else np.zeros(0)
    white, what = (y - x @ theta)[None], shown(-x, np.ones(k))

    def covariance() -> object:
        return spread(-x[None] @ what.basis, white, blocks, 0)

    bounds = {"scale": np.ones(k), "low": np.full(k, -np.inf), "high": np.full(k, np.inf)}
    vector = SimpleNamespace(per_input=[], labels=[f"b_{j}" for j in range(k)], units=["1"] * k, **bounds)
    found = {"white": white, "slopes": -x[None], "theta": theta, "shown": what, "vector": vector}
    noises = [SimpleNamespace(std=1.0, parameters=0)]
    return cast(Regression, SimpleNamespace(noises=noises, spread=covariance, **found))


def lasting(rng: np.random.Generator, rows: int, blocks: NDArray[np.int64], share: float) -> Array:
    """Noise of unit variance (rows,), a share of which is the same all through a block of time."""
    level = rng.normal(size=int(blocks.max()) + 1)
    return np.asarray(share**0.5 * level[blocks] + (1 - share) ** 0.5 * rng.normal(size=rows))


def drawn(seed: int, share: float, size: float = 0.0) -> tuple[Array, Array]:
    """Scores by block (B, 2) of two orthonormal columns, the first of this size in the noise; their information."""
    rng = np.random.default_rng(seed)
    z = np.linalg.qr(rng.normal(size=(ROWS, 2)))[0]
    white, parts = z[:, 0] * size + lasting(rng, ROWS, BLOCK, share), [z[b == BLOCK] for b in range(BLOCKS)]
    return np.stack([p.T @ white[b == BLOCK] for b, p in enumerate(parts)]), np.stack(
        [p.T @ p for p in parts]
    )


@pytest.mark.parametrize("share", [0.0, 0.3], ids=["white", "lasting"])
@pytest.mark.parametrize(
    "test",
    [jackknife, lambda *draw: left_out(*draw, FOLD), lambda *draw: chance(*draw, FOLD)],
    ids=["jackknife", "folds", "together"],
)
def test_no_p_value_is_below_a_level_more_often_than_that(
    test: Callable[[Array, Array], float], share: float
) -> None:
    p = np.array([test(*drawn(seed, share)) for seed in range(NULLS)])
    for level in (0.01, 0.05, 0.2, 0.5):
        assert (p < level).mean() <= level + 3.0 * (level * (1 - level) / NULLS) ** 0.5  # standard errors


def test_an_alternative_is_found_as_often_as_the_noncentral_f_distribution_says() -> None:
    alpha, size, degrees = 0.01, 4.0, BLOCKS - 2
    found = np.mean([jackknife(*drawn(seed, 0.0, size)) < alpha for seed in range(400)])
    expected = float(ncf.sf(ncf.isf(alpha, 2, degrees, 0.0), 2, degrees, size**2))
    assert found == pytest.approx(expected, abs=0.06)
    assert found > 0.75


@pytest.mark.parametrize("share", [0.0, 0.3])
@pytest.mark.parametrize("count", [12, 40])
def test_intervals_of_ninety_per_cent_hold_the_truth_that_often(share: float, count: int) -> None:
    block, held = np.arange(ROWS) * count // ROWS, 0
    truth = np.array([1.0, -0.5])
    for seed in range(200):
        rng = np.random.default_rng(seed)
        x = np.column_stack((rng.normal(size=ROWS), lasting(rng, ROWS, block, 0.8)))
        fit = linear(x, x @ truth + lasting(rng, ROWS, block, share), block)
        for e, value in zip(estimated(fit, fit.spread(), [0, 1]), truth, strict=True):
            held += cast(float, e.low) <= value <= cast(float, e.high)
    assert 0.87 <= held / 400 <= 0.95


def _selected(*errors: float, alone: float = np.inf) -> JointSelection:
    """A selection whose looks gave a constant force these standard errors, and `alone` if all else were known."""
    smallest = {"constant_force": {"constant_force.acceleration": (min(errors), alone)}}
    return JointSelection(cast(Any, None), cast(Any, None), {}, (Round((), ""),), smallest)


def test_an_effect_is_listed_when_four_standard_errors_exceed_a_quarter_of_its_usual_size() -> None:
    # the usual size of a constant force is 0.1 m/s2
    assert not_shown(_selected(0.006), found=(), alpha=0.01) == []
    (listed,) = not_shown(_selected(0.007), found=(), alpha=0.01)
    assert (listed.effect, listed.smallest, listed.usual) == ("constant_force", pytest.approx(0.028), 0.1)
    assert listed.experiment
    assert not_shown(_selected(np.inf), found=(), alpha=0.01)[0].smallest is None


def _with_outliers(times: dict[int, list[float]]) -> Any:
    joint = SimpleNamespace(final=SimpleNamespace(at=SimpleNamespace(outlier_times=times)))
    return SimpleNamespace(outcome=SimpleNamespace(joint=joint), runs=("first", "second"))


def test_rows_that_were_left_out_are_said_with_their_run_and_time() -> None:
    (warning,) = outlier_warnings(cast(Any, _with_outliers({1: [22.41, 22.42, 22.5]})))
    assert "3 of 'second', from t = 22.41 to 22.5 s" in warning["sentence"]
    assert warning["kind"] == "outliers"
    assert outlier_warnings(_with_outliers({})) == []


def test_what_one_block_alone_shows_is_not_taken_from_the_others() -> None:
    rng = np.random.default_rng(0)
    blocks, rows = 8, 50
    jacobian, law = rng.normal(size=(blocks, rows, 2)), rng.normal(size=(blocks, rows))
    jacobian[1:, :, 1] *= 1e-4  # a width that shows in the first block
    error = 0.3 * law + rng.normal(size=(blocks, rows))
    columns = np.concatenate((error[..., None], jacobian, law[..., None]), 2)
    held = Grams(np.einsum("bri,brj->bij", columns, columns), blocks * rows, 3)
    gained, _, step = GramTable(held, np.array([1, 2]), np.arange(blocks)).gain((0, 3))
    assert step == pytest.approx([0.3], abs=0.15)
    assert 5.0 < gained.sum() < 40.0  # 0.5 * 400 * 0.09 nats
