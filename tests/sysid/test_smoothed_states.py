"""States that were smoothed: found and undone, on a machine that NumPy integrates and SciPy's filters."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, lfilter, sosfiltfilt

from nsde_torch.api.reading import read
from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.sysid.identify import identify
from nsde_torch.systems import make_system
from tests.helpers.machines import Array, held, simulated
from tests.helpers.own_machines import Rotor

Filter = Callable[[Array], Array]
DT, STIFFNESS, DAMPING = 0.01, 4.0, 0.8
SPRING = make_system("mass_spring_damper")


def butterworth(cut: float) -> Filter:
    return lambda x: np.asarray(sosfiltfilt(butter(4, cut, fs=1 / DT, output="sos"), x, axis=0))


def mean_of_past(rows: int) -> Filter:
    return lambda x: np.asarray(lfilter(np.ones(rows) / rows, 1.0, x, axis=0))


def spring(x: Array, u: Array) -> list[float]:
    return [x[1], u[0] - STIFFNESS * x[0] - DAMPING * x[1]]


def swings(
    seed: int,
    *,
    noise: float = 0.003,
    smooth: Filter | None = None,
    columns: tuple[int, ...] = (0, 1),
) -> list[RawRun]:
    """A spring pushed by a force that is new every row, in process noise: 40 s, logged every 10 ms."""
    rng, out, which = np.random.default_rng(seed), [], list(columns)
    for number in range(2):
        u = 2.0 * np.sin(0.7 * DT * np.arange(4000)) + rng.standard_normal(4000)
        run = simulated(
            number, spring, [0.0, 0.0], u[:, None], DT, noise=noise, kick=(0.0, 0.05), rng=rng, fine=2
        )
        if smooth is not None:
            run.x[:, which] = smooth(run.x[:, which])
        out.append(run)
    return out


def told(data: DataSet) -> list[dict[str, object]]:
    return [f.values for f in data.summary.findings if f.kind == "state_smoothing"]


def errors(data: DataSet) -> Array:
    """Deviations from the truth of gain, stiffness and damping in half-widths of 99 % intervals, and relative."""
    found = identify(SPRING, data.runs)
    truth = {"force_gain": 1.0, "stiffness": STIFFNESS, "damping": DAMPING}
    true = np.array([truth[n.split(".")[-1]] for n in found.vector.labels])
    off = np.abs(found.values - true)
    return np.asarray([off / np.abs(true), off / found.half_widths(0.99)])


@pytest.mark.parametrize(
    ("smooth", "name"),
    [
        (mean_of_past(6), "causal moving average"),
        pytest.param(
            lambda x: np.asarray(uniform_filter1d(x, 15, axis=0)), "moving average", marks=pytest.mark.slow
        ),
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
    data = read(swings(1, smooth=butterworth(4.0)), system=SPRING, state_smoothing="keep")
    assert not told(data)
    assert errors(data)[0].max() > 0.1


def test_one_smoothed_sensor_of_two_is_told_alone() -> None:
    data = read(swings(2, smooth=butterworth(10.0), columns=(1,)), system=SPRING)
    assert [v["states"] for v in told(data)] == [["q_dot"]]


@pytest.mark.parametrize("noise", [0.0, 1e-5, 0.003, 0.03])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_raw_logs_are_left_alone_whatever_their_noise(seed: int, noise: float) -> None:
    assert not told(read(swings(seed, noise=noise), system=SPRING))


def test_an_unknown_policy_is_refused() -> None:
    with pytest.raises(ConfigError, match="`state_smoothing` must be restore or keep; got 'off'"):
        read(swings(0), system=SPRING, state_smoothing="off")


def coarse(*, noisy: bool) -> list[RawRun]:
    """A spring with an encoder of 4096 steps a turn: beside a noisy rate, or one without noise."""
    rng, dt, grain, out = np.random.default_rng(2), 0.002, 2.0 * np.pi / 4096.0, []
    for number in range(3):
        knots = np.cumsum(rng.uniform(0.8, 3.0, 30))
        u = np.interp(dt * np.arange(8000), knots, rng.uniform(-1.8, 1.8, 30))[:, None]
        run = simulated(number, spring, [0.0, 0.0], u, dt, noise=(0.0, 0.01 * noisy), rng=rng, fine=1)
        out.append(replace(run, x=np.column_stack((grain * np.round(run.x[:, 0] / grain), run.x[:, 1]))))
    return out


@pytest.mark.parametrize("noisy", [True, False])
def test_the_saw_of_an_encoder_and_a_rate_without_noise_are_no_smoother(noisy: bool) -> None:
    assert not told(read(coarse(noisy=noisy), system="mass_spring_damper"))


def test_an_input_that_is_held_over_rows_is_no_mean_of_the_states() -> None:
    """A wind that varies slowly is beside it, and a friction that is not declared."""
    rng, t, runs = np.random.default_rng(1), 0.05 * np.arange(1500), []

    def rates(x: Array, u: Array) -> list[float]:
        return [2.0 * u[0] + 0.7 * u[1] - 0.5 * x[0] - 2.0 * np.tanh(x[0] / 0.6)]

    for number in range(3):
        torque, phase = held(rng, -3.0, 3.0, len(t), each=35), rng.uniform(0.0, 6.0)
        u = np.column_stack((torque, 1.0 + np.sin(0.2 * t + phase)))
        runs.append(simulated(number, rates, [0.0], u, 0.05, noise=(0.003,), rng=rng, fine=2))
    assert told(read(runs, system=Rotor())) == []


def test_a_motion_under_a_few_waves_does_not_hide_the_filter() -> None:
    rng, dt, rows, raw = np.random.default_rng(6), 0.005, 4000, []
    both = expm(dt * np.array([[0.0, 1.0, 0.0], [-25.0, -1.5, 40.0], [0.0, 0.0, 0.0]]))
    for name in ("a", "b", "c"):
        t, size = dt * np.arange(rows), rng.uniform(0.5, 1.5, 6)
        waves = np.sin(np.outer(t, 2.0 * np.pi * rng.uniform(0.5, 8.0, 6)) + rng.uniform(0.0, 6.0, 6))
        u, x = np.round(waves @ size, 8), np.zeros((rows, 2))
        for k in range(rows - 1):
            x[k + 1] = both[:2, :2] @ x[k] + both[:2, 2] * u[k]
        x += np.array([0.0015, 0.02]) * rng.standard_normal((rows, 2))
        logged = np.asarray(sosfiltfilt(butter(2, 12.0, fs=1 / dt, output="sos"), x, axis=0))
        raw.append(RawRun(name, t, np.round(logged, 10), u[:, None]))
    (found,) = told(read(raw, system=SPRING))
    assert (found["smoother"], found["order"]) == ("Butterworth filter forwards and backwards", 2)
    assert float(str(found["half_power_hz"])) == pytest.approx(9.6, rel=0.05)
    assert float(str(found["band_hz"])) > 20.0
