"""Mappings: YAML, units, axes, orders, clocks; and what kinematics and gravity say against one."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from nsde_torch.data.mapping.apply import apply
from nsde_torch.data.mapping.checks import checks
from nsde_torch.data.mapping.mapping import LogMapping, mapping_of, read_mapping
from nsde_torch.data.raw import RawRun
from nsde_torch.data.streams import Stream, StreamLog
from nsde_torch.data.system_info import changed
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.systems import make_system
from tests.helpers.leaning import leaning_flight, same_flight
from tests.helpers.log_writers import NED_MAPPING, ned_columns

QUADROTOR, SPRING = make_system("quadrotor"), make_system("mass_spring_damper")


def _mapping(content: str = NED_MAPPING) -> LogMapping:
    return mapping_of(yaml.safe_load(content))


def _log(columns: dict[str, np.ndarray]) -> StreamLog:
    fields = dict(columns)
    t = fields.pop("timestamp_us") * 1e-6
    return StreamLog("run", "log.csv", [Stream("", t, fields)])


@pytest.fixture(scope="module")
def flight() -> RawRun:
    return leaning_flight(20.0)


def test_a_log_in_other_axes_units_and_orders_gives_the_run_back(flight: RawRun) -> None:
    run = apply(_log(ned_columns(flight)), _mapping(), QUADROTOR)
    assert all(check.passed is not False for check in checks(QUADROTOR, run))
    assert np.abs(run.t - flight.t).max() < 1e-5
    assert same_flight(run, flight, 1e-12)
    assert np.abs(run.u - flight.u).max() < 1e-12


@pytest.mark.parametrize("world", ["ENU", "NED"])
@pytest.mark.parametrize("body", ["FLU", "FRD"])
def test_every_pair_of_axes_is_read(flight: RawRun, world: str, body: str) -> None:
    # the same attitude in mixed axes, by rotation matrices
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    frd = np.diag([1.0, -1, -1])
    w, b = ned if world == "NED" else np.eye(3), frd if body == "FRD" else np.eye(3)
    matrix = w @ Rotation.from_quat(flight.x[:, [7, 8, 9, 6]]).as_matrix() @ b
    q = Rotation.from_matrix(matrix).as_quat()
    parts = {"p": flight.x[:, :3] @ w.T, "v": flight.x[:, 3:6] @ w.T, "w": flight.x[:, 10:] @ b.T}
    fields = {f"{n}_{a}": v[:, k] for n, v in parts.items() for k, a in enumerate("xyz")}
    fields |= {f"q{k}": q[:, k] for k in range(4)} | {f"u{k}": flight.u[:, k] for k in range(4)}
    log = StreamLog("run", "x", [Stream("", flight.t, fields)])
    columns = {n: {"from": [f"{n}_{a}" for a in "xyz"]} for n in parts}
    columns["q"] = {"from": [f"q{k}" for k in range(4)], "order": "xyzw"}
    columns["u"] = {"from": [f"u{k}" for k in range(4)]}
    mapping = mapping_of({"frames": {"world": world, "body": body}, "columns": columns})
    assert same_flight(apply(log, mapping, QUADROTOR), flight, 1e-12)


WRONG = {
    "order: wxyz": ("order: xyzw", "order: wxyz", r"order: xyzw"),
    "rad/s": ("unit: deg/s", "unit: rad/s", r"unit: deg/s"),
    "rates FLU": ("unit: deg/s}", "unit: deg/s, body: FLU}", r"FRD for FLU"),
    "turned the other way": ("order: xyzw", "order: xyzw, turns: world to body", r"turns: body to world"),
    "metres as millimetres": ("vel_z], unit: m/s", "vel_z], unit: mm/s", r"1000 times"),
    "ENU positions": ("pos_z], unit: m", "pos_z], unit: m, world: ENU", r"NED and the positions ENU"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_a_mapping_that_contradicts_the_log_is_told_by_name(flight: RawRun, fault: str) -> None:
    before, after, words = WRONG[fault]
    assert before in NED_MAPPING
    mapping = _mapping(NED_MAPPING.replace(before, after))
    run = apply(_log(ned_columns(flight)), mapping, QUADROTOR)
    failed = [check.text for check in checks(QUADROTOR, run, mapping) if check.passed is False]
    assert re.search(words, " ".join(failed))


def test_gravity_tells_axes_that_kinematics_cannot(flight: RawRun) -> None:
    """Positions and velocities exchanged together agree with each other, and not with the lean of the attitude."""
    x = flight.x.copy()
    x[:, [0, 1, 3, 4]] = x[:, [1, 0, 4, 3]]
    (found,) = (c for c in checks(QUADROTOR, RawRun("r", flight.t, x, flight.u)) if c.passed is False)
    assert found.name == "lean and acceleration"
    assert "exchanged" in found.text


BAD = {
    "unknown key": ("frames:", "frame:", r"'frame' is none of .* Did you mean 'frames'"),
    "unknown key of an entry": ("axes: world", "axis: world", r"columns\.v`: 'axis' is none of"),
    "choice": ("order: xyzw", "order: zyxw", r"columns\.q`: `order` must be one of wxyz, xyzw"),
    "unit": ("unit: deg/s", "unit: degg/s", r"columns\.w: the unit 'degg/s' is unknown"),
    "dimension": ("unit: deg/s", "unit: m", r"the unit 'm' is none of 'rad/s'"),
    "column": ("pos_x", "pos_ex", r"reads 'pos_ex'.* Did you mean 'pos_x'"),
    "numbering": ("numbering: betaflight", "numbering: bata", r"`numbering` must be one of px4"),
    "width": ("[motor1, motor2, motor3, motor4]", "[motor1, motor2, motor3]", r"3 column\(s\) for 'u'"),
    "ends": ("low: 1000, high: 2000", "low: 1000", r"`low` and `high` belong together"),
    "lacking": ("  w: {from", "  thrust: {from", r"says nothing of w_x, w_y, w_z"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_faulty_mapping_is_one_sentence(flight: RawRun, fault: str) -> None:
    before, after, message = BAD[fault]
    assert before in NED_MAPPING
    with pytest.raises(ConfigError, match=message):
        apply(_log(ned_columns(flight)), _mapping(NED_MAPPING.replace(before, after)), QUADROTOR)


def test_a_file_that_is_no_mapping(tmp_path: Path) -> None:
    for content, message in (
        ("[1, 2]", "must hold `columns:`"),
        ("a: [", "line 1: no plain YAML"),
        ("!!python/object:os.x {}", "YAML"),
    ):
        file = tmp_path / "mapping.yaml"
        file.write_text(content, encoding="utf-8")
        with pytest.raises(ConfigError, match=message):
            read_mapping(file)
    with pytest.raises(ConfigError, match=r"none\.yaml: no regular file"):
        read_mapping(tmp_path / "none.yaml")


def test_streams_of_other_rates_come_onto_one_grid(flight: RawRun) -> None:
    """The gyroscope at 400 Hz, motors at 300 Hz, attitude at 100 Hz; commands are means over the step."""
    fine, motor = np.arange(0, 20, 1 / 400), np.arange(0, 20, 1 / 300)
    w = np.stack([np.interp(fine, flight.t, flight.x[:, 10 + k]) for k in range(3)], axis=1)
    u = 0.5 + 0.2 * np.sin(40.0 * motor[:, None] + np.arange(4))
    streams = [
        Stream("att", flight.t, {f"x{k}": flight.x[:, k] for k in range(10)}),
        Stream("gyro", fine, {f"w{k}": w[:, k] for k in range(3)}),
        Stream("motors", motor, {f"m{k}": u[:, k] for k in range(4)}),
    ]
    columns = {"p": [0, 1, 2], "v": [3, 4, 5], "q": [6, 7, 8, 9]}
    content = {n: {"from": [f"att/x{k}" for k in ks]} for n, ks in columns.items()}
    content |= {"w": {"from": [f"w{k}" for k in range(3)]}, "u": {"from": [f"motors/m{k}" for k in range(4)]}}
    run = apply(StreamLog("r", "r", streams), mapping_of({"columns": content}), QUADROTOR)
    assert len(run.t) == len(flight.t)
    assert np.nanmax(np.abs(run.x - flight.x)) < 1e-9
    at = 40.0 * flight.t[100:-100, None] + np.arange(4)
    mean = 0.5 + 0.2 * (np.cos(at) - np.cos(at + 0.4)) / 0.4
    held = 0.2 * 40 / 300  # what holding over a third of a step can be off
    assert np.abs(run.u[100:-100] - mean).max() < held


def test_slow_motors_are_refused_and_can_be_let_in(flight: RawRun) -> None:
    some = slice(None, None, 10)
    streams = [
        Stream("s", flight.t, {f"x{k}": flight.x[:, k] for k in range(13)}),
        Stream("m", flight.t[some], {f"m{k}": flight.u[some, k] for k in range(4)}),
    ]
    places = {"p": range(3), "v": range(3, 6), "q": range(6, 10), "w": range(10, 13)}
    columns = {n: {"from": [f"x{k}" for k in ks]} for n, ks in places.items()}
    columns["u"] = {"from": [f"m{k}" for k in range(4)]}
    with pytest.raises(DataError, match=r"'u' \(m\) was logged at 10 Hz; at least 50 Hz .*slowest: 10"):
        apply(StreamLog("r", "r", streams), mapping_of({"columns": columns}), QUADROTOR)
    columns["u"]["slowest"] = 10  # type: ignore[assignment]
    run = apply(StreamLog("r", "r", streams), mapping_of({"columns": columns}), QUADROTOR)
    assert np.array_equal(run.u[:-10:10], flight.u[:-10:10])


def test_clocks_that_share_no_time_are_refused(flight: RawRun) -> None:
    streams = [Stream("a", flight.t, {"q": flight.t}), Stream("b", flight.t + 1e9, {"u": flight.t})]
    mapping = mapping_of({"columns": {"q": "a/q", "force": "b/u"}})
    with pytest.raises(DataError, match="have no time in common"):
        apply(StreamLog("r", "r", streams), mapping, SPRING)


def test_inputs_have_a_scale_and_a_sign_or_are_none() -> None:
    t = np.arange(0, 5, 0.01)
    log = StreamLog("r", "r", [Stream("", t, {"q": t, "volt": np.sin(t)})])
    columns = {"q": "q", "force": {"from": "volt", "scale": 35.0, "sign": -1}}
    run = apply(log, mapping_of({"columns": columns}), SPRING)
    assert np.allclose(run.u[:, 0], -35 * np.sin(t))
    assert np.isnan(run.x[:, 1]).all()  # the rate is inferred later
    free = changed(SPRING, input_names=(), input_units=())
    assert apply(log, mapping_of({"columns": {"q": "q", "q_dot": "volt"}}), free).u.shape == (500, 0)


def test_inputs_that_their_range_does_not_hold_are_refused() -> None:
    t = np.arange(0, 5, 0.01)
    columns = {"q": "q", "force": {"from": "pwm", "low": 1000, "high": 2000}}

    def read(pwm: np.ndarray) -> RawRun:
        log = StreamLog("r", "r", [Stream("", t, {"q": t, "pwm": pwm})])
        return apply(log, mapping_of({"columns": columns}), SPRING)

    with pytest.raises(DataError, match=r"inputs are 800 to 1200, and 50% of them lie outside `low: 1000`"):
        read(1000.0 + 200.0 * np.cos(t * np.pi / 4.99))
    armed = read(np.where(t < 2.0, 900.0, 1500.0))
    assert armed.u[:, 0].tolist() == np.where(t < 2.0, 0.0, 0.5).tolist()


def test_a_channel_that_one_log_lacks_is_told_and_left_out(flight: RawRun) -> None:
    content = NED_MAPPING + "  battery_voltage: {from: vbat, unit: V}\n"
    run = apply(_log(ned_columns(flight)), _mapping(content), QUADROTOR)
    assert "battery_voltage" not in run.extra
    assert [note.message for note in run.notes] == ["no column vbat for the channel 'battery_voltage'"]
