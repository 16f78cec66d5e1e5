"""States that were smoothed: found and undone, on a machine that NumPy integrates and SciPy's filters."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, lfilter, savgol_filter, sosfiltfilt

from nsde_torch.api.reading import read
from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.sysid.identify import identify
from nsde_torch.systems import make_system

Array = NDArray[np.float64]
Filter = Callable[[Array], Array]
DT, STIFFNESS, DAMPING = 0.01, 4.0, 0.8
SPRING = make_system("mass_spring_damper")


def butterworth(cut: float) -> Filter:
    return lambda x: np.asarray(sosfiltfilt(butter(4, cut, fs=1 / DT, output="sos"), x, axis=0))


def mean_of_past(rows: int) -> Filter:
    return lambda x: np.asarray(lfilter(np.ones(rows) / rows, 1.0, x, axis=0))


FILTERS: dict[str, Filter] = {
    "mean of the last 5 rows": mean_of_past(5),
    "mean of the last 6 rows": mean_of_past(6),
    "butterworth 10 Hz": butterworth(10.0),
    "butterworth 4 Hz": butterworth(4.0),
    "mean of 0.15 s": lambda x: np.asarray(uniform_filter1d(x, 15, axis=0)),
    "savitzky-golay": lambda x: np.asarray(savgol_filter(x, 21, 3, axis=0)),
}


def swings(
    seed: int,
    *,
    noise: float = 0.003,
    smooth: Filter | None = None,
    columns: tuple[int, ...] = (0, 1),
    lag: float = 0.0,
    rate_noise: Filter = lambda e: e,
) -> list[RawRun]:
    """A spring pushed by a force that is new every row, in process noise: 40 s in steps of 1 ms, logged every 10 ms.

    The force follows what is logged with a lag, and `rate_noise` is what a filter makes of the noise of the rate alone.
    """
    rng = np.random.default_rng(seed)
    out = []
    for name in ("a", "b"):
        n, sub = 4000, 10
        u = 2.0 * np.sin(0.7 * DT * np.arange(n)) + rng.standard_normal(n)
        x = np.zeros((n, 2))
        q, v, pushed = 0.0, 0.0, 0.0
        for k in range(n):
            x[k] = q, v
            for _ in range(sub):
                pushed += (u[k] - pushed) * (0.001 / lag if lag else 1.0)
                rate = pushed - STIFFNESS * q - DAMPING * v
                q, v = q + 0.001 * v, v + 0.001 * rate + 0.05 * 0.001**0.5 * rng.standard_normal()
        error = noise * rng.standard_normal(x.shape)
        x += np.column_stack((error[:, 0], rate_noise(error[:, 1])))
        if smooth is not None:
            x[:, list(columns)] = smooth(x[:, list(columns)])
        out.append(RawRun(name, DT * np.arange(n), x, u[:, None]))
    return out


def in_pieces(runs: list[RawRun], rows: int, smooth: Filter | None = None) -> list[RawRun]:
    """Runs as many short ones of their own, each through a smoother by itself."""
    cut = [(run, slice(a, a + rows)) for run in runs for a in range(0, len(run.t) - rows + 1, rows)]
    smooth = smooth or (lambda x: x)
    return [RawRun(f"run_{k}", r.t[at], smooth(r.x[at]), r.u[at]) for k, (r, at) in enumerate(cut)]


def told(data: DataSet) -> list[dict[str, object]]:
    return [f.values for f in data.summary.findings if f.kind == "state_smoothing"]


def errors(data: DataSet) -> Array:
    """Deviations from the truth of gain, stiffness and damping in half-widths of 99 % intervals, and relative."""
    found = identify(SPRING, data.runs)
    truth = {"force_gain": 1.0, "stiffness": STIFFNESS, "damping": DAMPING}
    true = np.array([truth[n.split(".")[-1]] for n in found.vector.labels])
    off = np.abs(found.values - true)
    return np.asarray([off / np.abs(true), off / found.half_widths(0.99)])


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.slow
def test_a_smoothed_log_gives_the_parameters_of_the_raw_one(name: str) -> None:
    data = read(swings(1, smooth=FILTERS[name]), system=SPRING)
    assert [v["states"] for v in told(data)] == [["q", "q_dot"]]
    relative, widths = errors(data)
    assert relative.max() < (0.1 if "mean" in name else 0.03)  # behind the first null nothing is known
    assert widths.max() < 1.5


@pytest.mark.parametrize(
    ("smooth", "name"),
    [
        (mean_of_past(5), "causal moving average"),
        (mean_of_past(6), "causal moving average"),
        (FILTERS["mean of 0.15 s"], "moving average"),
    ],
)
def test_a_mean_of_the_past_is_not_one_about_each_row(smooth: Filter, name: str) -> None:
    (found,) = told(read(swings(3, smooth=smooth), system=SPRING))
    assert found["smoother"] == name


@pytest.mark.parametrize("rows", [1, 10])
def test_zeros_of_a_spectrum_show_a_mean_of_one_sensor_unless_inputs_are_held(rows: int) -> None:
    rng, n, raw = np.random.default_rng(5), 6000, []
    for name in ("a", "b", "c"):
        u = np.repeat(rng.standard_normal(n // rows), rows)
        x, noise = np.zeros(n), 0.01 * rng.standard_normal(n)
        for k in range(n - 1):
            x[k + 1] = np.exp(-DT) * x[k] + (1.0 - np.exp(-DT)) * u[k]
        x = x + noise if rows > 1 else mean_of_past(10)(x + noise)
        raw.append(RawRun(name, DT * np.arange(n), x[:, None], u[:, None]))
    found = told(read(raw, system=make_system("tests.helpers.toy_systems:Decay")))
    assert [one["smoother"] for one in found] == (["causal moving average"] if rows == 1 else [])


def test_kept_smoothing_is_what_ruins_the_identification() -> None:
    data = read(swings(1, smooth=FILTERS["butterworth 4 Hz"]), system=SPRING, state_smoothing="keep")
    assert not told(data)
    assert errors(data)[0].max() > 0.1


def test_one_smoothed_sensor_of_two_is_told_alone() -> None:
    data = read(swings(2, smooth=FILTERS["butterworth 10 Hz"], columns=(1,)), system=SPRING)
    assert [v["states"] for v in told(data)] == [["q_dot"]]


@pytest.mark.parametrize("noise", [0.0, 1e-5, 0.003, 0.03])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_raw_logs_are_left_alone_whatever_their_noise(seed: int, noise: float) -> None:
    assert not told(read(swings(seed, noise=noise), system=SPRING))


@pytest.mark.parametrize("smoothed", [False, True])
@pytest.mark.slow
def test_an_estimators_smooth_noise_on_a_machine_that_lags_is_no_smoother_of_its_motion(
    smoothed: bool,
) -> None:
    # flights of a PX4: velocities of its filter, of motors whose lag nobody had declared
    soft = butterworth(15.0)
    through = {"smooth": soft} if smoothed else {"rate_noise": soft}
    data = read(swings(6, lag=0.05, noise=0.03, **through), system=SPRING)  # type: ignore[arg-type]
    assert [v["states"] for v in told(data)] == ([["q", "q_dot"]] if smoothed else [])


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(ConfigError, match="`state_smoothing` must be restore or keep; got 'off'"):
        read(swings(0), system=SPRING, state_smoothing="off")


def hanging_carts(seed: int) -> list[RawRun]:
    """A cart and a hanging pole with friction in its pivot, pushed by five waves: three runs of 30 s at 50 Hz, raw."""
    rng, out, dt, sub = np.random.default_rng(seed), [], 0.02, 4
    total, pole, half, h = 1.15, 0.25, 0.3, dt / sub

    def rate(z: Array, force: float) -> Array:
        sine, cosine, w = np.sin(z[2]), np.cos(z[2]), z[3]
        a = (force + pole * half * w * w * sine) / total
        turn = (9.8 * sine - a * cosine - 0.4 * half * w) / (half * (4 / 3 - pole * cosine**2 / total))
        return np.array([z[1], a - pole * half * turn * cosine / total, w, turn])

    for name in "abc":
        z, gust, rows, forces = np.array([0, 0, np.pi + 0.4 * rng.normal(), 0]), 0.0, [], []
        size, f, phase = rng.uniform(0.5, 1.6, 5), rng.uniform(0.3, 1.6, 5), rng.uniform(0, 6.28, 5)
        for k in range(1500):
            rows.append(z + rng.normal(size=4) * [0.0005, 0.004, 0.001, 0.01])
            waves = size * np.sin(2 * np.pi * f * k * dt + phase)
            forces.append(waves.sum() - 1.2 * rows[-1][0] - 0.6 * rows[-1][1])
            for _ in range(sub):
                gust += -gust * h / 0.3 + 0.05 * rng.normal() * np.sqrt(2 * h / 0.3)
                push = forces[-1] + gust
                one = rate(z, push)
                two = rate(z + h / 2 * one, push)
                three = rate(z + h / 2 * two, push)
                z = z + h / 6 * (one + 2 * two + 2 * three + rate(z + h * three, push))
        out.append(RawRun(name, dt * np.arange(1500), np.array(rows), np.array(forces)[:, None]))
    return out


@pytest.mark.slow
def test_a_motion_that_ends_with_its_inputs_is_not_taken_for_a_smoothed_one() -> None:
    """Behind the filter that was named, white noise would be a thousand times louder than the sensor's before it."""
    assert told(read(hanging_carts(1), system="cartpole")) == []


def coarse(*, noisy: bool) -> list[RawRun]:
    """A spring with an encoder of 4096 steps a turn: beside a noisy rate, or one without noise."""
    rng = np.random.default_rng(2)
    out = []
    dt, n, sub, grain = 0.002, 8000, 2, 2.0 * np.pi / 4096.0
    for name in ("a", "b", "c"):
        knots = np.cumsum(rng.uniform(0.8, 3.0, 30))
        u = np.interp(dt * np.arange(n), knots, rng.uniform(-1.8, 1.8, 30))
        x = np.zeros((n, 2))
        q, v = 0.0, 0.0
        for k in range(n):
            x[k] = q, v
            for _ in range(sub):
                v += 0.001 * (u[k] - STIFFNESS * q - DAMPING * v)
                q += 0.001 * v
        x[:, 0] = grain * np.round(x[:, 0] / grain)
        x[:, 1] += 0.01 * rng.standard_normal(n) if noisy else 0.0
        out.append(RawRun(name, dt * np.arange(n), x, u[:, None]))
    return out


@pytest.mark.parametrize("noisy", [True, False])
def test_the_saw_of_an_encoder_and_a_rate_without_noise_are_no_smoother(noisy: bool) -> None:
    assert not told(read(coarse(noisy=noisy), system="mass_spring_damper"))


@pytest.mark.slow
def test_runs_of_a_few_seconds_show_their_smoother_together() -> None:
    smoothed = read(in_pieces(swings(4), 200, butterworth(6.0)), system=SPRING)
    assert [v["states"] for v in told(smoothed)] == [["q", "q_dot"]]
    relative, widths = errors(smoothed)
    assert relative.max() < 0.1  # 0.8 where a window is taken to see one frequency
    assert widths.max() < 2.0
    assert told(read(in_pieces(swings(4), 200), system=SPRING)) == []
