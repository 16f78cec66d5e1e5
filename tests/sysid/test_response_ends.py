"""Sensors that do not show what the inputs do: a machine that NumPy integrates, SciPy's filters, no noise to see."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, sosfiltfilt

from nsde_torch.api.reading import read
from nsde_torch.data.raw import RawRun
from nsde_torch.sysid.identify import identify
from nsde_torch.sysid.response_ends import ends_of_response
from nsde_torch.systems import make_system

Array = NDArray[np.float64]
DT, STIFFNESS, DAMPING = 0.005, 6.0, 0.6
SPRING = make_system("mass_spring_damper")


def butterworth(cut: float) -> Callable[[Array], Array]:
    return lambda x: np.asarray(sosfiltfilt(butter(3, cut, fs=1 / DT, output="sos"), x, axis=0))


def pushed(
    seed: int,
    *,
    states: Callable[[Array], Array] = lambda x: x,
    input_noise: float = 0.0,
    lag: float = 0.0,
    delay: int = 0,
    noise: float = 0.0,
    loop: float = 0.0,
) -> list[RawRun]:
    """A spring under a force with a spectrum that falls, 60 s in steps of 1 ms, logged every 5 ms.

    The force is logged with white noise, acts with a lag [s] and a delay (rows), and answers the noisy states (`loop`).
    """
    rng = np.random.default_rng(seed)
    out = []
    for name in ("a", "b"):
        n, sub = 6000, 5
        wanted = 40.0 * gaussian_filter1d(rng.standard_normal(n), 4.0)
        x, u = np.zeros((n, 2)), np.zeros(n)
        q, v, acts = 0.0, 0.0, 0.0
        error = noise * rng.standard_normal((n, 2))
        for k in range(n):
            x[k] = q, v
            u[k] = wanted[k] - loop * float((x[k] + error[k]) @ [4.0, 1.5])
            for _ in range(sub):
                goal = u[max(k - delay, 0)]
                acts = goal if not lag else acts + (goal - acts) * 0.001 / lag
                q, v = q + 0.001 * v, v + 0.001 * (acts - STIFFNESS * q - DAMPING * v)
                v += 0.1 * 0.001**0.5 * rng.standard_normal()
        logged = u + input_noise * rng.standard_normal(n)
        out.append(RawRun(name, DT * np.arange(n), states(x + error), logged[:, None]))
    return out


def end_of(runs: list[RawRun]) -> float | None:
    """Frequency at which the rate no longer shows the force [Hz]."""
    data = read(runs, system=SPRING, state_smoothing="keep")
    (found,) = ends_of_response(data.runs, SPRING, [(1,)], data.clock_scale)
    return None if found is None else found.falls_to(0.5)


@pytest.mark.parametrize("cut", [4.0, 8.0])
def test_the_frequency_at_which_smoothed_states_end_is_found(cut: float) -> None:
    end = end_of(pushed(1, states=butterworth(cut)))
    assert end is not None
    assert 0.75 * cut < end < 1.35 * cut


def test_noise_of_the_logged_input_is_found() -> None:
    end = end_of(pushed(2, input_noise=4.0))
    assert end is not None
    assert 8.0 < end < 40.0  # where the force that acts falls below the noise of the log


def test_less_noise_of_the_input_than_the_machine_has_is_left() -> None:
    assert end_of(pushed(2, input_noise=0.5)) is None


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"lag": 0.06},
        {"delay": 7},
        {"lag": 0.03, "delay": 3, "noise": 0.002},
        {"noise": 0.02, "loop": 1.0},
        {"noise": 0.02, "loop": 1.0, "lag": 0.05},
    ],
    ids=str,
)
def test_lags_delays_and_loops_are_no_smoother(how: dict[str, float]) -> None:
    assert end_of(pushed(3, **how)) is None  # type: ignore[arg-type]


def test_a_machine_without_inputs_shows_all() -> None:
    pendulum = make_system("mass_spring_damper")
    runs = [RawRun(run.name, run.t, run.x, 0.0 * run.u) for run in pushed(4)]
    data = read(runs, system=pendulum, state_smoothing="keep")
    assert ends_of_response(data.runs, pendulum, [(1,)]) == [None]


@pytest.mark.slow
def test_values_are_right_where_noise_of_the_logged_input_is_taken_out() -> None:
    runs = pushed(5, input_noise=4.0)
    kept, without = (read(runs, system=SPRING, state_smoothing=how) for how in ("keep", "restore"))
    assert [finding.kind for finding in without.summary.findings] == ["input_noise"]
    off = [abs(float(identify(SPRING, data.runs).values[0]) - 1.0) for data in (kept, without)]
    assert off[1] < 0.04
    assert off[0] > 0.5
