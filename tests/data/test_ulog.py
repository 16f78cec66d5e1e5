"""PX4 logs: frames by hand-worked cases, one clock, and missing topics named with the remedy."""

from pathlib import Path

import numpy as np
import pytest

from nsde_torch.data import DataSet
from nsde_torch.data.quaternion import attitude_to_enu, rotate, swap_body, swap_world
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording import read
from tests.helpers.data_systems import CARTPOLE, QUADROTOR, multirotor
from tests.helpers.flights import flight
from tests.helpers.ulog_bytes import write_ulog


def logged(seconds: float = 12.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict]:
    """A flight (ENU/FLU) and the PX4 topics that log it in NED/FRD."""
    t, x, u = flight(seconds, motors=4)
    p, v, w = swap_world(x[:, :3]), swap_world(x[:, 3:6]), swap_body(x[:, 10:])
    q = attitude_to_enu(x[:, 6:10])
    stamp = 50.0 + t
    topics = {
        "vehicle_odometry": {"timestamp": stamp, "position": p, "q": q, "velocity": v, "angular_velocity": w,
                             "pose_frame": np.full(len(t), 1), "velocity_frame": np.full(len(t), 1)},
        "actuator_motors": {"timestamp": stamp, "control": u},
        "battery_status": {"timestamp": stamp[::100], "voltage_v": 16 - 0.01 * t[::100]},
    }  # fmt: skip
    return t, x, u, topics


def logged_as(tmp_path: Path, topics: dict, *, parameters: dict | None = None, **options: object) -> DataSet:
    """The data set of a log of these topics."""
    path = write_ulog(tmp_path / "log.ulg", topics, parameters or {})
    return read("ulog", QUADROTOR, path=str(path), **options)  # type: ignore[arg-type]


def same_state(run: object, x: np.ndarray, atol: float = 1e-5) -> None:
    got = run.x * 1.0  # type: ignore[attr-defined]
    got[:, 6:10] *= np.sign((got[:, 6:10] * x[:, 6:10]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(got, x, atol=atol)


def test_odometry_in_ned_comes_out_in_enu_with_battery_voltage(tmp_path: Path) -> None:
    t, x, u, topics = logged()
    data = logged_as(tmp_path, topics)
    same_state(data[0], x)
    np.testing.assert_allclose(data[0].u, u, atol=1e-6)
    np.testing.assert_allclose(data[0].t, 50 + t, atol=1e-6)
    np.testing.assert_allclose(data[0].extra["battery_voltage"], 16 - 0.01 * t, atol=1e-5)
    assert data.summary.findings == ()
    system = multirotor("quadrotor", 4, exogenous=("battery_voltage",))
    assert read("ulog", system, path=str(tmp_path))[0].u.shape[1] == 5


def test_the_velocity_frame_field_decides(tmp_path: Path) -> None:
    _, x, _, topics = logged()
    q, v = topics["vehicle_odometry"]["q"], topics["vehicle_odometry"]["velocity"]
    topics["vehicle_odometry"]["velocity"] = rotate(q * [1, -1, -1, -1], v)
    topics["vehicle_odometry"]["velocity_frame"] = np.full(len(q), 3)
    same_state(logged_as(tmp_path, topics)[0], x)
    topics["vehicle_odometry"]["velocity_frame"] = np.full(len(q), 2)
    with pytest.raises(DataError, match="velocities in frame 2 and poses in frame 1"):
        logged_as(tmp_path, topics)


def three_topics(topics: dict) -> dict:
    odometry = topics.pop("vehicle_odometry")
    stamp = odometry["timestamp"]
    return topics | {
        "vehicle_attitude": {"timestamp": stamp, "q": odometry["q"]},
        "vehicle_local_position": {"timestamp": stamp[::5], **{
            n: a[::5] for n, a in zip(("x", "y", "z", "vx", "vy", "vz"),
                                      (*odometry["position"].T, *odometry["velocity"].T), strict=True)}},
        "vehicle_angular_velocity": {"timestamp": stamp[::2], "xyz": odometry["angular_velocity"][::2]},
    }  # fmt: skip


def test_three_slower_topics_come_onto_the_clock_of_the_attitude(tmp_path: Path) -> None:
    _, x, u, topics = logged()
    data = logged_as(tmp_path, three_topics(topics))
    same_state(data[0], x, atol=5e-3)
    np.testing.assert_allclose(data[0].u, u, atol=1e-6)
    (finding,) = data.summary.findings
    assert finding.kind == "slow_topic"
    assert "vehicle_local_position 20 Hz" in finding.message


def test_attitudes_that_the_logger_left_out_take_no_position_with_them(tmp_path: Path) -> None:
    # PX4 on a busy machine: one in six attitudes missing. Steps of two rows were means of means then, and gave
    # gains of 36.9 and 35.8 for 40.
    _, x, _, topics = logged()
    topics = three_topics(topics)
    place = topics["vehicle_local_position"]
    attitude = topics["vehicle_attitude"]
    # positions at every fifth row; their attitudes are the ones that are missing
    keep = np.array([k % 5 != 0 or k % 2 == 0 for k in range(len(attitude["timestamp"]))])
    topics["vehicle_attitude"] = {k: v[keep] for k, v in attitude.items()}
    run = logged_as(tmp_path, topics, dt=0.05)[0]
    np.testing.assert_allclose(run.x[:, 3], place["vy"][: len(run.x)], atol=1e-6)  # east
    np.testing.assert_allclose(run.x[:, 6:10], x[::5][: len(run.x), 6:10], atol=5e-3)


def test_time_on_the_ground_is_left_out_unless_asked_for(tmp_path: Path) -> None:
    t, _, _, topics = logged()
    topics["vehicle_land_detected"] = {"timestamp": [50.0, 52.0, 61.0], "landed": [1, 0, 1]}
    data = logged_as(tmp_path, topics)
    assert (data[0].t[0], data[0].t[-1]) == (pytest.approx(52.0), pytest.approx(60.99))
    assert len(logged_as(tmp_path, topics, in_air=False)[0]) == len(t)


def _standing(topics: dict, *, after: float) -> dict:
    """The flight with rows of a machine that stands where it took off, for some seconds before and after it."""
    odometry, motors = topics["vehicle_odometry"], topics["actuator_motors"]
    n = round(after * 100)
    out = {
        k: np.concatenate([np.repeat(v[:1], n, 0), v, np.repeat(v[-1:], n, 0)]) for k, v in odometry.items()
    }
    stamp = 50.0 - 0.01 * n + 0.01 * np.arange(len(out["timestamp"]))
    ground = np.r_[0:n, len(stamp) - n : len(stamp)]
    out["timestamp"] = stamp
    out["position"] = out["position"] - np.array([0.0, 0.0, 3.0])  # the flight is well above it
    out["position"][ground, 2] = 0.02 * np.sin(ground)
    out["velocity"][ground] = out["angular_velocity"][ground] = 0.0
    u = np.concatenate([np.full((n, 4), 0.1), motors["control"], np.full((n, 4), 0.02)])
    return topics | {"vehicle_odometry": out, "actuator_motors": {"timestamp": stamp, "control": u}}


@pytest.mark.parametrize("flag", ["ground_contact", "maybe_landed"])
def test_a_machine_that_stands_is_on_the_ground_before_px4_says_that_it_landed(
    tmp_path: Path, flag: str
) -> None:
    t, _, _, topics = logged()
    topics = _standing(topics, after=3.0)
    end = 50.0 + t[-1]
    # `landed` ends a second before it lifts off and comes two seconds after it stands
    detected = {"timestamp": [47.0, 49.0, end + 1.0, end + 2.0], "landed": [1, 0, 0, 1]}
    detected[flag] = [1, 0, 1, 1]
    data = logged_as(tmp_path, topics | {"vehicle_land_detected": detected})
    assert (data[0].t[0], data[0].t[-1]) == (pytest.approx(50.0, abs=0.011), pytest.approx(end, abs=0.011))
    assert "on_ground" in [f.kind for f in data.summary.findings]


def test_an_estimate_that_sinks_at_touch_down_is_on_the_ground(tmp_path: Path) -> None:
    t, _, _, topics = logged()
    topics = _standing(topics, after=3.0)
    end = 50.0 + t[-1]
    sunk = topics["vehicle_odometry"]["position"][:, 2]
    late = topics["vehicle_odometry"]["timestamp"] > end
    sunk[late] += 0.25 * (topics["vehicle_odometry"]["timestamp"][late] - end)  # NED: down
    detected = {"timestamp": [47.0, 49.0, end + 2.5], "landed": [1, 0, 1]}
    data = logged_as(tmp_path, topics | {"vehicle_land_detected": detected})
    assert data[0].t[-1] == pytest.approx(end, abs=0.011)


@pytest.mark.parametrize("parts", [False, True])
def test_a_reset_of_the_estimate_cuts_the_run_and_is_told(tmp_path: Path, parts: bool) -> None:
    t, _, _, topics = logged()
    counter = np.where(t < 6.0, 3, 4)
    odometry = topics["vehicle_odometry"]
    if parts:
        topics = three_topics(topics)
        topics["vehicle_attitude"]["quat_reset_counter"] = counter
    else:
        odometry["reset_counter"] = counter
    data = logged_as(tmp_path, topics)
    assert len(data[0].segments) == 2
    assert "estimate_reset" in [f.kind for f in data.summary.findings]
    assert data[0].t[data[0].segments[0][1] - 1] == pytest.approx(55.99, abs=0.011)


def test_outputs_are_mapped_by_the_output_functions(tmp_path: Path) -> None:
    _, _, u, topics = logged()
    topics.pop("actuator_motors")
    pwm = np.full((len(u), 16), 900.0)
    pwm[:, [3, 2, 1, 0]] = 1100 + 800 * u
    stamp = topics["vehicle_odometry"]["timestamp"]
    topics["actuator_outputs"] = {"timestamp": stamp, "output": pwm}
    parameters = {f"PWM_MAIN_FUNC{4 - k}": 101 + k for k in range(4)}
    for end, width in (("MIN", 1100), ("MAX", 1900)):
        parameters |= {f"PWM_MAIN_{end}{k + 1}": width for k in range(4)}
    data = logged_as(tmp_path, topics, parameters=parameters)
    np.testing.assert_allclose(data[0].u, u, atol=1e-4)


def test_missing_topics_are_named_with_the_remedy(tmp_path: Path) -> None:
    *_, topics = logged()
    motors = topics.pop("actuator_motors")
    with pytest.raises(DataError, match=r"lacks the topics \['actuator_motors'\].*SDLOG_PROFILE"):
        logged_as(tmp_path, topics)
    topics = three_topics(topics) | {"actuator_motors": motors}
    topics.pop("vehicle_angular_velocity")
    with pytest.raises(DataError, match=r"\['vehicle_angular_velocity'\] \(or `vehicle_odometry`\).*logger"):
        logged_as(tmp_path, topics)
    with pytest.raises(DataError, match=r"lacks the topics \['vehicle_odometry'\]"):
        read("ulog", QUADROTOR, path=str(tmp_path / "log.ulg"), state="odometry")


def test_topics_too_slow_to_interpolate_are_refused(tmp_path: Path) -> None:
    *_, topics = logged()
    slow = three_topics(topics)
    slow["vehicle_local_position"] = {k: v[::10] for k, v in slow["vehicle_local_position"].items()}
    with pytest.raises(DataError, match="`vehicle_local_position` was logged at 2 Hz; at least 4 Hz"):
        logged_as(tmp_path, slow, state="attitude")


def test_motors_as_the_default_profile_logs_them_are_refused_with_the_bit_that_logs_more(
    tmp_path: Path,
) -> None:
    *_, topics = logged()
    topics["actuator_motors"] = {k: v[::10] for k, v in topics["actuator_motors"].items()}
    with pytest.raises(DataError, match=r"`actuator_motors` was logged at 10 Hz.*50 Hz.*bit 4.*PROFILE 17"):
        logged_as(tmp_path, topics)
    assert "held" in logged_as(tmp_path, topics, motor_rate=10.0).summary.findings[0].action


def test_what_is_no_log_and_systems_that_are_no_multirotor_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.ulg").write_bytes(b"not a log at all, not at all")
    with pytest.raises(DataError, match="is not a readable ULog file"):
        read("ulog", QUADROTOR, path=str(tmp_path))
    with pytest.raises(DataError, match="does not exist"):
        read("ulog", QUADROTOR, path=str(tmp_path / "none.ulg"))
    with pytest.raises(ConfigError, match="Choose `hexacopter` or `quadrotor`"):
        read("ulog", CARTPOLE, path=str(tmp_path / "bad.ulg"))
    with pytest.raises(ConfigError, match="`state` must be one of"):
        read("ulog", QUADROTOR, path=str(tmp_path / "bad.ulg"), state="gps")


def test_sticks_and_setpoints_become_columns_in_our_frames(tmp_path: Path) -> None:
    t, x, _, topics = logged()
    slow, w = 50.0 + t[::4], swap_body(x[::4, 10:])  # setpoints at a quarter of the rate, held in between
    nan = np.full(len(slow), np.nan)
    topics["manual_control_setpoint"] = {
        "timestamp": slow, "roll": np.sin(slow), "pitch": nan, "yaw": 0 * slow, "throttle": 0.5 + 0 * slow,
    }  # fmt: skip
    topics["vehicle_attitude_setpoint"] = {
        "timestamp": slow, "q_d": attitude_to_enu(x[::4, 6:10]),
        "thrust_body": np.stack([nan, nan, -0.4 + 0 * slow], 1),
    }  # fmt: skip
    topics["vehicle_rates_setpoint"] = {
        "timestamp": slow, "roll": w[:, 0], "pitch": w[:, 1], "yaw": w[:, 2],
    }  # fmt: skip
    extra = logged_as(tmp_path, topics)[0].extra
    held = np.arange(len(t)) // 4 * 4
    np.testing.assert_allclose(extra["stick_roll"], np.sin(50.0 + t[held]), atol=1e-5)
    assert "stick_pitch" not in extra  # PX4 leaves what it does not know unset
    for k, name in enumerate(("setpoint_rate_x", "setpoint_rate_y", "setpoint_rate_z")):
        np.testing.assert_allclose(extra[name], x[held, 10 + k], atol=1e-5)
    w_, x_, y_, z_ = x[held, 6:10].T
    np.testing.assert_allclose(np.sin(extra["setpoint_pitch"]), 2 * (w_ * y_ - z_ * x_), atol=1e-4)
    yaw = np.arctan2(2 * (w_ * z_ + x_ * y_), 1 - 2 * (y_**2 + z_**2))
    np.testing.assert_allclose(np.cos(extra["setpoint_yaw"] - yaw), 1.0, atol=1e-4)
    np.testing.assert_allclose(extra["setpoint_thrust"], 0.4, atol=1e-5)
