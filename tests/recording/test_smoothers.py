"""Smoothers are told by what they leave of white noise: against SciPy's filters, which nothing in the package uses."""

from collections.abc import Callable
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import butter, savgol_filter, sosfilt, sosfiltfilt

from nsde_torch.recording.smoothers import Spectra, fit, likeliest, spectra_of

Array = NDArray[np.float64]
DT = 0.01


def sensor(seed: int) -> Array:
    """A motion whose spectrum falls as f^-4, and white noise, (8000, 2)."""
    rng = np.random.default_rng(seed)
    motion = np.cumsum(np.cumsum(1e-4 * rng.standard_normal((8000, 2)), axis=0) * 0.02, axis=0)
    return np.asarray(motion + 0.01 * rng.standard_normal((8000, 2)))


def seen_in(x: Array) -> Spectra:
    return cast(Spectra, spectra_of([x], DT))


SMOOTHERS: dict[str, tuple[Callable[[Array], Array], str]] = {
    "butterworth twice": (
        lambda x: sosfiltfilt(butter(4, 10.0, fs=1 / DT, output="sos"), x, axis=0),
        "Butterworth filter forwards and backwards",
    ),
    "butterworth once": (
        lambda x: sosfilt(butter(2, 8.0, fs=1 / DT, output="sos"), x, axis=0),
        "causal Butterworth filter",
    ),
    "gaussian": (lambda x: gaussian_filter1d(x, 3.0, axis=0), "Gaussian filter"),
    "mean": (lambda x: uniform_filter1d(x, 9, axis=0), "moving average"),
    "savitzky-golay": (lambda x: savgol_filter(x, 15, 3, axis=0), "Savitzky-Golay filter"),
    "spline": (
        lambda x: np.stack(
            [make_smoothing_spline(np.arange(len(c)), c, lam=50.0)(np.arange(len(c))) for c in x.T], 1
        ),
        "cubic smoothing spline",
    ),
}


@pytest.mark.parametrize("name", SMOOTHERS)
@pytest.mark.slow
def test_the_family_and_the_frequency_response_are_found(name: str) -> None:
    smooth, family = SMOOTHERS[name]
    x = sensor(3)
    seen = seen_in(smooth(x))
    assert fit(seen, None).deviance > 4.0
    likely = likeliest(seen)
    found = likely.smoother
    assert found.family.name == family
    assert likely.deviance < 1.0
    if name == "butterworth twice":  # the noise before the smoother
        assert np.sqrt(fit(seen, found).noise[:, 0] / (2 * DT)) == pytest.approx(0.01, rel=0.1)
    impulse = np.zeros((4001, 1))
    impulse[2000] = 1.0
    true = np.abs(np.fft.rfft(smooth(impulse)[:, 0]))
    f = np.fft.rfftfreq(4001, DT)
    band = (true > 0.05) & (f > 1.0) & (f < (true < 0.05).argmax() * f[1] if (true < 0.05).any() else f > 1.0)
    assert np.abs(np.abs(found.response(f))[band] / true[band] - 1.0).max() < 0.1


@pytest.mark.slow
def test_a_rate_made_of_positions_by_a_polynomial_is_told_from_a_smoothed_one() -> None:
    x = sensor(4)
    rate = savgol_filter(x, 11, 3, deriv=1, delta=DT, axis=0)
    seen = seen_in(rate)
    found = likeliest(seen, rates=True)
    assert found.smoother.family.name == "Savitzky-Golay derivative"
    assert (found.smoother.order, round(found.smoother.size)) == (4, 11)
    assert found.deviance < 1.0 < 4.0 < fit(seen, None).deviance
    assert not likeliest(seen).smoother.family.differentiates


def test_a_raw_sensor_has_the_form_that_is_assumed() -> None:
    for seed in range(6):
        assert fit(seen_in(sensor(seed)), None).deviance < 0.8


def test_short_stretches_have_no_spectrum() -> None:
    assert spectra_of([np.zeros((60, 1)) for _ in range(20)], DT) is None
