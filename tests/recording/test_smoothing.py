"""Smoothers and moving averages are found where there is one, by name and width, and not where there is none."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter, savgol_filter

from nsde_torch.data import DataSet, Run
from nsde_torch.recording import read
from nsde_torch.recording.fault import LoggedRuns
from nsde_torch.recording.faults import InputSmoothing
from nsde_torch.recording.smoothers import Spectra, fit, likeliest, spectra_of
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.systems import make_system

Array = NDArray[np.float64]
DT = 0.01
N = 6001


def commands(kind: str, seed: int, n: int = N) -> Array:
    """Inputs (n, 4) of several kinds, before any smoothing."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n, 4))
    if kind == "white":
        return white
    if kind == "red":  # a controller's commands: strong at low frequencies, noise above
        return lfilter([1.0], [1.0, -0.95], white, axis=0) + 0.05 * rng.standard_normal((n, 4))
    assert kind == "steps"  # a pilot's stick: held for a while, then moved; and a little noise
    lengths = rng.integers(10, 80, n // 10 + 1)
    held = np.stack([np.repeat(rng.standard_normal(len(lengths)), lengths)[:n] for _ in range(4)], 1)
    return np.asarray(held + 0.02 * white)


KINDS = ("white", "red", "steps")


def averaged(u: Array, samples: int) -> Array:
    kernel = np.ones(samples) / samples
    return np.stack([np.convolve(c, kernel, mode="same") for c in u.T], 1)


def run(u: Array, name: str = "run") -> Run:
    n = len(u)
    return Run(name, DT * np.arange(n), np.zeros((n, 1)), u)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("samples", [10, 15, 20, 25, 30, 40])
def test_the_width_of_an_average_is_found_within_a_sample(kind: str, samples: int) -> None:
    found = smoothing_width([run(averaged(commands(kind, seed), samples), str(seed)) for seed in (0, 1)], 4)
    assert found == pytest.approx(samples * DT, abs=1.01 * DT)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("rows", "inputs", "seeds"), [(N, 4, 25), (600, 1, 20), (1000, 1, 20), (1500, 1, 20)]
)
def test_raw_inputs_show_no_average(kind: str, rows: int, inputs: int, seeds: int) -> None:
    found = {seed: smoothing_width([run(commands(kind, seed, rows))], inputs) for seed in range(seeds)}
    assert {seed: width for seed, width in found.items() if width} == {}


@pytest.mark.parametrize("kind", KINDS)
def test_a_first_order_lag_is_no_average(kind: str) -> None:
    for keep, seed in product(np.exp(-DT / np.array([0.02, 0.05, 0.1, 0.3])), range(6)):
        lagged = lfilter([1 - keep], [1.0, -keep], commands(kind, seed), axis=0)
        assert smoothing_width([run(lagged)], 4) == 0.0


def held(samples: int) -> Array:
    return np.repeat(commands("red", 0, N // samples + 1), samples, axis=0)[:N]


@pytest.mark.parametrize(
    ("u", "inputs"),
    [
        (np.full((N, 4), 0.4), 4),
        (np.full((N, 4), 0.4) + 1e-12 * commands("white", 0), 4),
        *((held(samples), 4) for samples in (8, 10, 20)),  # between updates of a command
        (averaged(commands("white", 0, 400), 40), 4),  # too short
        (np.hstack([commands("white", 0), averaged(commands("white", 0), 40)]), 4),  # of exogenous columns
    ],
)
def test_constant_held_short_and_exogenous_columns_show_no_average(u: Array, inputs: int) -> None:
    assert smoothing_width([run(u)], inputs) == 0.0


def test_published_flights_were_averaged_over_four_tenths_of_a_second(published: Path) -> None:
    data = read("published", make_system("hexacopter"), path=str(published / "hexacopter" / "trajs.pkl"))
    assert smoothing_width(list(data.runs), 6) == pytest.approx(0.4, abs=1.01 * DT)


@pytest.mark.parametrize("seed", range(3, 8))
def test_a_telegraph_at_even_spacing_on_sines_is_no_average(seed: int) -> None:
    rng, rows, dt = np.random.default_rng(seed), 5000, 0.005
    t = dt * np.arange(rows)
    sines = sum(
        np.sin(2 * np.pi * f * t + p) for f, p in zip((0.3, 0.9, 2.3), rng.uniform(0, 6, 3), strict=True)
    )
    telegraph = np.repeat(rng.choice([-1.5, 1.5], rows // 100), 100)
    u = np.round(0.7 * sines + telegraph, 3)[:, None]
    made = [Run(str(k), t, np.zeros((rows, 1)), u[:: 1 if k else -1]) for k in (0, 1)]
    assert smoothing_width(made, 1) == 0.0


def sensor(seed: int) -> Array:
    """A motion whose spectrum falls as f^-4, and white noise, (8000, 2)."""
    rng = np.random.default_rng(seed)
    motion = np.cumsum(np.cumsum(1e-4 * rng.standard_normal((8000, 2)), axis=0) * 0.02, axis=0)
    return np.asarray(motion + 0.01 * rng.standard_normal((8000, 2)))


def seen_in(x: Array) -> Spectra:
    return cast(Spectra, spectra_of([x], DT))


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


@pytest.mark.parametrize("past", [True, False])
def test_physics_says_whether_a_mean_is_of_the_past(past: bool) -> None:
    u, rows = commands("steps", 3)[:, :1], 13
    logged = lfilter(np.ones(rows) / rows, 1.0, u, axis=0) if past else averaged(u, rows)
    one = Run("a", DT * np.arange(N), np.cumsum(np.concatenate(([[0.0]], DT * u[:-1])), 0), logged)

    def misfit(runs: Sequence[Run], clock: float) -> float:
        return float(np.log(np.mean([np.square(np.diff(r.x, axis=0) - DT * r.u[:-1]).mean() for r in runs])))

    system = make_system("mass_spring_damper")
    log = LoggedRuns(cast(DataSet, None), [one], system, alpha=0.01, misfit=misfit)
    found = InputSmoothing().detect(log)
    assert found is not None
    assert found.plain == {InputSmoothing.past if past else "width": pytest.approx(rows * DT)}
    back = InputSmoothing().undo(one, system, found.plain)
    assert np.std(back.u - u) < 0.25 * np.std(logged - u)
