"""Faults of a recording chain, each against what it does to a known signal."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.recording.chain import Recording
from nsde_torch.systems import make_system

DT = 0.01
SPRING, HEXACOPTER = make_system("mass_spring_damper"), make_system("hexacopter")


def logged(chain: Recording, n: int = 400, *, seed: int = 0) -> tuple[RawRun, RawRun]:
    """A spring's run whose states and inputs are noise, before and after."""
    rng = np.random.default_rng(seed)
    run = RawRun("a", DT * np.arange(n), rng.standard_normal((n, 2)), rng.standard_normal((n, 1)))
    return run, chain.apply(run, SPRING, dt=DT, rng=np.random.default_rng(1))


def test_without_a_fault_a_run_is_logged_as_it_was() -> None:
    before, after = logged(Recording())
    np.testing.assert_array_equal(after.x, before.x)
    np.testing.assert_array_equal(after.u, before.u)
    assert Recording().as_dict(DT) == {}


def test_late_states_make_inputs_seem_early() -> None:
    chain = Recording(input_delay=0.05)
    before, after = logged(chain)
    assert len(after.t) == 395
    np.testing.assert_array_equal(after.x, before.x[:-5])
    np.testing.assert_array_equal(after.u, before.u[5:])
    assert chain.as_dict(DT) == {"input_delay_s": 0.05}


@pytest.mark.parametrize("steps", [40, 41])
def test_a_centred_average_has_its_null_at_one_over_its_width_and_does_not_move_the_rest(steps: int) -> None:
    chain = Recording(input_smoothing=steps * DT)
    t = DT * np.arange(2000)
    null, slow = np.sin(2 * np.pi * t / (steps * DT)), np.sin(2 * np.pi * 0.1 * t)
    run = RawRun("a", t, np.zeros((2000, 2)), (null + slow)[:, None])
    u = chain.apply(run, SPRING, dt=DT, rng=np.random.default_rng(0)).u[100:-100, 0]
    np.testing.assert_allclose(u, slow[100:-100], atol=0.01)


def test_a_biased_sensor_is_off_by_as_much() -> None:
    before, after = logged(Recording(sensor_bias={"q_dot": 0.3}))
    np.testing.assert_allclose(after.x - before.x, np.tile([0.0, 0.3], (400, 1)), atol=1e-12)


def test_missing_rows_leave_their_times_out() -> None:
    before, after = logged(Recording(dropout=0.2), 4000)
    assert 0.75 < len(after.t) / len(before.t) < 0.85
    rows = np.round(after.t / DT).astype(int)
    np.testing.assert_array_equal(after.x, before.x[rows])
    assert after.t[0] == before.t[0]
    assert after.t[-1] == before.t[-1]


def test_late_and_filtered_sensors_lag_behind_the_others() -> None:
    t = DT * np.arange(600)
    x = np.stack([np.sin(3 * t), 3 * np.cos(3 * t)], 1)
    run = RawRun("a", t, x, np.zeros((600, 1)))
    chain = Recording(sensor_delay={"q": 1.7 * DT}, sensor_lag={"q_dot": 0.1}, input_delay=2 * DT)
    chain.check(SPRING)
    assert chain.rows_late(DT) == 4
    after = chain.apply(run, SPRING, dt=DT, rng=np.random.default_rng(0))
    then = DT * (np.arange(596) + 2)  # the states are two rows behind the inputs
    np.testing.assert_allclose(after.x[:, 0], np.sin(3 * (then - 1.7 * DT)), atol=1e-5)
    settled = np.real(3 * np.exp(3j * then) / (1 + 0.3j))[400:]
    np.testing.assert_allclose(after.x[400:, 1], settled, atol=2e-3)
    assert chain.as_dict(DT) == {
        "input_delay_s": 2 * DT,
        "sensor_delay_s": {"q": 1.7 * DT},
        "sensor_lag_s": {"q_dot": 0.1},
    }


def test_a_turned_frame_turns_attitude_and_rates_and_leaves_the_world_alone() -> None:
    rng, n = np.random.default_rng(2), 7
    attitude, mounting = Rotation.random(n, random_state=3), Rotation.from_rotvec([0.1, -0.2, 0.3])
    x = rng.standard_normal((n, 13))
    x[:, 6:10] = np.roll(attitude.as_quat(), 1, axis=1)
    chain = Recording(frame_misalignment=[float(v) for v in np.degrees([0.1, -0.2, 0.3])])
    run = RawRun("a", DT * np.arange(n), x, np.zeros((n, 6)))
    after = chain.apply(run, HEXACOPTER, dt=DT, rng=rng).x
    turned = Rotation.from_quat(np.roll(after[:, 6:10], -1, axis=1))
    assert (attitude * mounting * turned.inv()).magnitude().max() < 1e-6
    np.testing.assert_allclose(after[:, 10:], mounting.inv().apply(x[:, 10:]), atol=1e-9)
    np.testing.assert_array_equal(after[:, :6], x[:, :6])


@pytest.mark.parametrize(
    ("chain", "word"),
    [
        (Recording(dropout=0.9), "dropout"),
        (Recording(clock_scale=0.1), "clock_scale"),
        (Recording(sensor_bias={"x": 1.0}), "q, q_dot"),
        (Recording(sensor_delay={"x": 1.0}), "q, q_dot"),
        (Recording(sensor_lag={"q": -1.0}), "sensor_lag.q"),
        (Recording(frame_misalignment=(1.0, 0.0, 0.0)), "attitude"),
        (Recording(frame_misalignment=(1.0, 0.0)), "three angles"),
    ],
)
def test_what_a_system_cannot_have_is_refused(chain: Recording, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        chain.check(SPRING)
