"""Laws of noise: whitening is causal, white where it should be, and blind to what lies across a gap.

What the past of residuals predicts is known before each row.
"""

import warnings

import numpy as np
from scipy.signal import lfilter

from nsde_torch.sysid import noise
from nsde_torch.sysid.noise import Series, estimate

ONE = Series(((0, 6000),))


def drawn(seed: int, *, carry: float = 0.0, ar: tuple[float, ...] = ()) -> np.ndarray:
    """(1 + a_1 B + ...) r = (1 - c B) e with e of standard deviation 2."""
    e = 2.0 * np.random.default_rng(seed).normal(size=7000)
    return np.asarray(lfilter([1.0, -carry], [1.0, *ar], e)[1000:])


def autocorrelation(white: np.ndarray, lag: int) -> float:
    return float((white[lag:] * white[:-lag]).sum() / (white**2).sum())


def test_an_autoregression_is_found_and_whitened() -> None:
    r = drawn(0, ar=(-0.8, 0.15))
    law = estimate(r, ONE, limit=0.0, orders=20)
    white = law.whiten(r[:, None], ONE)[1:, 0]
    assert 2 <= len(law.reflection) <= 6
    assert abs(law.std - 2.0) < 0.06
    assert max(abs(autocorrelation(white, k)) for k in range(1, 20)) < 0.05
    assert abs(white.std() - 1.0) < 0.02


def test_sensor_noise_is_found_as_a_moving_average() -> None:
    r = drawn(1, carry=0.9)
    law = estimate(r, ONE, limit=0.99, orders=20)
    assert abs(law.carry - 0.9) < 0.05
    assert abs(law.std - 2.0) < 0.06
    white = law.whiten(r[:, None], ONE)[1:, 0]
    assert max(abs(autocorrelation(white, k)) for k in range(1, 10)) < 0.05


def test_the_limit_of_c_is_one_for_a_sensor_alone_and_falls_with_what_else_is_noisy() -> None:
    assert noise.carry_limit(0.0, 0.0, 1.0, 0.01) > 0.999
    quiet, loud = (noise.carry_limit(0.0, known, 1.0, 0.01) for known in (0.1, 1.0))
    assert 0 < loud < quiet < 1
    # r = e' - e + w: autocovariances 2 s^2 + k^2 and -s^2 are those of a moving average with c + 1 / c = 2 + k^2 / s^2
    assert abs(loud + 1 / loud - 3.0) < 1e-9
    assert noise.carry_limit(1.0, 0.0, 0.0, 0.01) == 0.0


def test_a_series_that_is_known_from_its_past_warns_of_nothing() -> None:
    n = np.arange(300)
    for memory in (np.inf, 1e6):
        for r in (1e-9 * n**2.0, np.sin(0.1 * n), (-1.0) ** n):
            series = Series(((0, len(r)),))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                law = estimate(r, series, limit=0.9, orders=20, memory=memory)
                law.whiten(r[:, None], series)
            assert not (np.abs(law.reflection) >= 1.0).any()
