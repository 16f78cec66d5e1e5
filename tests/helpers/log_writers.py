"""One run written as logs of other formats and conventions, as their programs write them."""

import shutil
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.quaternion import attitude_to_enu, conjugate, euler_zyx, rotate, swap_body, swap_world
from nsde_torch.data.raw import RawRun

Array = NDArray[np.float64]

BETAFLIGHT = (3, 0, 1, 2)  # places of Betaflight's motors 1 to 4 among PX4's


def ned_columns(run: RawRun) -> dict[str, Array]:
    """A quadrotor's run in NED and FRD: microseconds, deg/s, scalar-last quaternions, Betaflight's motors."""
    p, v = swap_world(run.x[:, :3]), swap_world(run.x[:, 3:6])
    q, w = attitude_to_enu(run.x[:, 6:10]), np.rad2deg(swap_body(run.x[:, 10:13]))
    out = {"timestamp_us": np.round(run.t * 1e6 + 5e6)}
    out |= {f"pos_{a}": p[:, k] for k, a in enumerate("xyz")}
    out |= {f"vel_{a}": v[:, k] for k, a in enumerate("xyz")}
    out |= {f"q{a}": q[:, k] for k, a in zip((1, 2, 3, 0), "xyzw", strict=True)}
    out |= {f"gyro_{a}": w[:, k] for k, a in enumerate("xyz")}
    out |= {f"motor{k + 1}": 1000 + 1000 * run.u[:, j] for k, j in enumerate(BETAFLIGHT)}
    return out


NED_MAPPING = """\
system: quadrotor
kind: table
time: {from: timestamp_us, unit: us}
frames: {world: NED, body: FRD}
columns:
  p: {from: [pos_x, pos_y, pos_z], unit: m}
  v: {from: [vel_x, vel_y, vel_z], unit: m/s, axes: world}
  q: {from: [qx, qy, qz, qw], order: xyzw}
  w: {from: [gyro_x, gyro_y, gyro_z], unit: deg/s}
  u: {from: [motor1, motor2, motor3, motor4], unit: us, low: 1000, high: 2000, numbering: betaflight}
"""
"""What the columns of `ned_columns` mean."""


def write_table(path: Path, columns: dict[str, Array]) -> Path:
    kind = path.suffix
    if kind in (".csv", ".tsv"):
        mark, rows = "," if kind == ".csv" else "\t", np.column_stack(list(columns.values()))
        np.savetxt(path, rows, "%.17g", mark, header=mark.join(columns), comments="")
    elif kind == ".npz":
        np.savez(path, **columns)
    elif kind == ".mat":
        from scipy.io import savemat

        savemat(path, {name: values[:, None] for name, values in columns.items()})
    elif kind == ".h5":
        import h5py

        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[f"log/{name}"] = values
    else:
        import pyarrow
        import pyarrow.parquet as parquet

        parquet.write_table(pyarrow.table(columns), path)
    return path


def _ros_messages(run: RawRun, types: Mapping[str, Any]) -> Iterator[tuple[str, str, int, Any]]:
    """An odometry (ENU, FLU, twist along the body's axes) and motor commands: topic, type, time [ns], message."""
    odometry, motors = "nav_msgs/msg/Odometry", "std_msgs/msg/Float32MultiArray"
    ros1 = "seq" in types["std_msgs/msg/Header"].__dataclass_fields__
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    body = rotate(conjugate(run.x[:, 6:10]), run.x[:, 3:6])

    def made(kind: str, *values: object, **named: object) -> Any:
        return types[f"geometry_msgs/msg/{kind}"](*values, **named)

    for k, t in enumerate(run.t):
        at, x = round(t * 1e9) + 1_700_000_000_000_000_000, run.x[k].tolist()
        stamp = types["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
        pose = made(
            "Pose", position=made("Point", *x[:3]), orientation=made("Quaternion", x[7], x[8], x[9], x[6])
        )
        linear, angular = made("Vector3", *body[k].tolist()), made("Vector3", *x[10:13])
        twist, none = made("Twist", linear=linear, angular=angular), np.zeros(36)
        message = types[odometry](
            header=types["std_msgs/msg/Header"](**({"seq": k} if ros1 else {}), stamp=stamp, frame_id="map"),
            child_frame_id="base_link",
            pose=made("PoseWithCovariance", pose=pose, covariance=none),
            twist=made("TwistWithCovariance", twist=twist, covariance=none),
        )
        yield "/odom", odometry, at, message
        yield "/motor_commands", motors, at, types[motors](layout=layout, data=run.u[k].astype(np.float32))


def write_ros(path: Path, run: RawRun) -> Path:
    """A run as a bag of ROS 1 (.bag), of ROS 2 (a folder), or as an MCAP file with messages of ROS 2 (.mcap)."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    ros1, mcap = path.suffix == ".bag", path.suffix == ".mcap"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    plugin = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
    folder = path.with_suffix(".made") if mcap else path
    writer = rosbag1.Writer(path) if ros1 else rosbag2.Writer(folder, version=9, storage_plugin=plugin)
    with writer as bag:
        topics: dict[str, Any] = {}
        for topic, kind, at, message in _ros_messages(run, store.types):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, kind, typestore=store)
            raw = store.serialize_ros1(message, kind) if ros1 else store.serialize_cdr(message, kind)
            bag.write(topics[topic], at, raw)
    if mcap:
        next(folder.glob("*.mcap")).rename(path)
        shutil.rmtree(folder)
    return path


# ---- ArduPilot ---------------------------------------------------------------------------------------------

_MARK = b"\xa3\x95"
_SIZES = {"Q": 8, "f": 4, "H": 2, "B": 1, "n": 4, "N": 16, "Z": 64, "c": 2, "C": 2, "d": 8, "I": 4}


def write_ardupilot(path: Path, run: RawRun) -> Path:
    """A run as a DataFlash log: NED and FRD, angles in deg, pulse widths, as ArduCopter logs an X quadrotor."""
    kinds = {
        128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
        64: ("PARM", "QNff", "TimeUS,Name,Value,Default"),
        65: ("XKF1", "QBffffffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD"),
        66: ("RATE", "Qfff", "TimeUS,R,P,Y"),
        67: ("RCOU", "QHHHHHH", "TimeUS,C1,C2,C3,C4,C5,C6"),
    }
    out = bytearray()

    def message(kind: int, *values: object) -> None:
        text = "<" + "".join({"n": "4s", "N": "16s", "Z": "64s"}.get(c, c) for c in kinds[kind][1])
        out.extend(_MARK + bytes([kind]) + struct.pack(text, *values))

    for kind, (name, form, columns) in kinds.items():
        size = 3 + sum(_SIZES[c] for c in form)
        message(128, kind, size, name.encode(), form.encode(), columns.encode())
    # motors 1 to 4 are on the outputs 3, 1, 2, 4
    outputs = {1: 2, 2: 3, 3: 1, 4: 4}
    for channel, motor in outputs.items():
        message(64, 0, f"SERVO{channel}_FUNCTION".encode(), 32 + motor, 0)
    for name, value in (("MOT_PWM_MIN", 1100), ("MOT_PWM_MAX", 1900)):
        message(64, 0, name.encode(), value, 0)
    p, v = swap_world(run.x[:, :3]), swap_world(run.x[:, 3:6])
    angles = np.rad2deg(euler_zyx(attitude_to_enu(run.x[:, 6:10])))
    rates = np.rad2deg(swap_body(run.x[:, 10:13]))
    for k, t in enumerate(run.t):
        at = round(t * 1e6) + 10_000_000
        message(65, at, 0, *angles[k], *v[k], 0.0, *p[k])
        message(66, at, *rates[k])
        pulses = [round(1100 + 800 * run.u[k, outputs[c] - 1]) for c in (1, 2, 3, 4)]
        message(67, at, *pulses, 1500, 0)
    path.write_bytes(bytes(out))
    return path


# ---- Betaflight --------------------------------------------------------------------------------------------


def _variable(value: int) -> bytes:
    """A number of seven bits a byte, the last without its top bit."""
    out = bytearray()
    while value > 127:
        out.append((value & 127) | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def _signed(value: int) -> bytes:
    return _variable((value << 1) ^ (value >> 63) if value < 0 else value << 1)


def write_betaflight(path: Path, run: RawRun, *, logs: int = 1) -> Path:
    """A run as a black box log of intra frames alone: gyro in deg/s (FLU), motors from 48 to 2047."""
    names = ["loopIteration", "time"]
    names += [*(f"gyroADC[{k}]" for k in range(3)), *(f"motor[{k}]" for k in range(4))]
    fields = {"I name": ",".join(names), "I signed": "0,0,1,1,1,1,1,1,1"}
    fields |= {f"{frame} predictor": "0,0,0,0,0,0,0,0,0" for frame in "IP"}
    fields |= {f"{frame} encoding": "1,1,0,0,0,0,0,0,0" for frame in "IP"}
    head = [
        *("Product:Blackbox flight data recorder by Nicholas Sherlock", "Data version:2", "I interval:1"),
        *("P interval:1", "Firmware type:Cleanflight", "Firmware revision:Betaflight 4.4.0 (test)"),
        *("minthrottle:1000", "maxthrottle:2000", "motorOutput:48,2047", "gyro_scale:0x3f800000"),
        *(f"Field {name}:{value}" for name, value in fields.items()),
    ]
    out = bytearray()
    for _ in range(logs):
        out += "".join(f"H {line}\n" for line in head).encode()
        for k, t in enumerate(run.t):
            gyro = np.rad2deg(run.x[k, 10:13])
            motors = [48 + 1999 * run.u[k, j] for j in BETAFLIGHT]
            out += b"I" + _variable(k) + _variable(round(t * 1e6) + 1_000_000)
            out += b"".join(_signed(round(float(value))) for value in (*gyro, *motors))
        out += b"E\xffEnd of log\x00"
    path.write_bytes(bytes(out))
    return path


PX4 = {
    "px4_msgs/msg/VehicleOdometry": """\
uint64 timestamp
uint64 timestamp_sample
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
""",
    "px4_msgs/msg/ActuatorMotors": """\
uint64 timestamp
uint64 timestamp_sample
uint16 reversible_flags
float32[12] control
""",
}


def write_px4_mcap(path: Path, run: RawRun) -> Path:
    """A run as messages of `px4_msgs`, with a topic of JSON and one of an encoding that is not read."""
    import json

    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    for kind, text in PX4.items():
        store.register(get_types_from_msg(text, kind))
    p, v = swap_world(run.x[:, :3]), swap_world(run.x[:, 3:6])
    q, w = attitude_to_enu(run.x[:, 6:10]), swap_body(run.x[:, 10:13])
    state = {"position": p, "q": q, "velocity": v, "angular_velocity": w}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for topic, (kind, text) in zip(("/fmu/odometry", "/fmu/motors"), PX4.items(), strict=True):
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[kind] = writer.register_channel(topic, "cdr", schema)
        battery = writer.register_channel("/battery", "json", 0)
        blob = writer.register_channel("/blob", "protobuf", 0)
        for k, t in enumerate(run.t):
            at, stamp = round(t * 1e9) + 10**18, round(t * 1e6) + 5_000_000
            control = np.full(12, np.nan, dtype=np.float32)
            control[:4] = run.u[k]
            odometry = {name: column[k].astype(np.float32) for name, column in state.items()}
            odometry |= {"timestamp": stamp + 40, "pose_frame": 1, "velocity_frame": 1}
            motors = {"timestamp": stamp + 30, "reversible_flags": 0, "control": control}
            for (kind, channel), values in zip(channels.items(), (odometry, motors), strict=True):
                message = store.types[kind](timestamp_sample=stamp, **values)
                writer.add_message(channel, at, bytes(store.serialize_cdr(message, kind)), at)
            if k % 50 == 0:
                writer.add_message(battery, at, json.dumps({"cell": {"volts": [4.1, 4.0]}}).encode(), at)
                writer.add_message(blob, at, b"\x08\x01", at)
        writer.finish()
    return path
