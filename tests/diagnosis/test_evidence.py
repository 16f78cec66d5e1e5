"""Evidence and p values keep what they promise: exact folds, honest errors, chances; and what data cannot show.

Linear regressions with known noise stand for the fits of a diagnosis; every claim is held against many draws.
"""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ncf

from nsde_torch.diagnosis.evidence import chance, jackknife, left_out, not_shown
from nsde_torch.diagnosis.joint_selection import JointSelection, Round
from nsde_torch.diagnosis.outcome import estimated
from nsde_torch.diagnosis.result import outlier_warnings
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


def scores(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Orthonormal columns (N, q), and their information by block (B, q, q)."""
    z = np.linalg.qr(rng.normal(size=(ROWS, count)))[0]
    return z, np.stack([z[b == BLOCK].T @ z[b == BLOCK] for b in range(BLOCKS)])


def by_block(z: Array, white: Array) -> Array:
    """Scores of columns (N, q) by block (B, q)."""
    return np.stack([z[b == BLOCK].T @ white[b == BLOCK] for b in range(BLOCKS)])


def below(p: list[float], level: float) -> float:
    return float(np.mean(np.array(p) < level))


def slack(level: float, draws: int) -> float:
    """What a rate may lie above its level by chance: three standard errors."""
    return level + 3.0 * (level * (1 - level) / draws) ** 0.5


# ---- p values under the null ------------------------------------------------------------------------------


def null(seed: int, share: float) -> tuple[float, float, float]:
    """p values of two columns that explain nothing: by the jackknife, by folds, together."""
    rng = np.random.default_rng(seed)
    z, grams = scores(rng, 2)
    pulls = by_block(z, lasting(rng, ROWS, BLOCK, share))
    return jackknife(pulls, grams), left_out(pulls, grams, FOLD), chance(pulls, grams, FOLD)


@pytest.mark.parametrize("share", [0.0, 0.3], ids=["white", "lasting"])
def test_no_p_value_is_below_a_level_more_often_than_that(share: float) -> None:
    nulls = [list(column) for column in zip(*(null(s, share) for s in range(NULLS)), strict=True)]
    for p in nulls:
        for level in (0.01, 0.05, 0.2, 0.5):
            assert below(p, level) <= slack(level, NULLS)
    assert below(nulls[0], 0.5) > 0.4  # not by never finding anything


def test_an_information_that_draws_tell_makes_no_chance_too_small() -> None:
    p, draws = [], 40
    for seed in range(400):
        rng = np.random.default_rng(seed)
        z, grams = scores(rng, 6)
        # the information is that of draws, and scores are in its units
        root = np.linalg.cholesky(np.cov(rng.normal(size=(draws, 6)).T, bias=True))
        turn = np.linalg.inv(root)
        pulls = by_block(z, rng.normal(size=ROWS)) @ turn.T
        p.append(chance(pulls, turn @ grams @ turn.T, FOLD, draws))
    for level in (0.01, 0.05, 0.1, 0.2):
        assert below(p, level) <= slack(level, 400)


# ---- power ------------------------------------------------------------------------------------------------


def test_an_alternative_is_found_as_often_as_the_noncentral_f_distribution_says() -> None:
    alpha, size, found = 0.01, 4.0, []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        z, grams = scores(rng, 2)
        found.append(jackknife(by_block(z, z[:, 0] * size + rng.normal(size=ROWS)), grams))
    degrees = BLOCKS - 2
    expected = float(ncf.sf(ncf.isf(alpha, 2, degrees, 0.0), 2, degrees, size**2))
    assert below(found, alpha) == pytest.approx(expected, abs=0.06)
    assert below(found, alpha) > 0.75


# ---- intervals --------------------------------------------------------------------------------------------


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


# ---- multiplicity -----------------------------------------------------------------------------------------


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
