"""Writes small ULog files byte by byte (PX4 user guide, "ULog File Format"); pyulog only copies logs."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_TYPES = {"uint64_t": "Q", "float": "f", "uint8_t": "B", "int32_t": "i"}

# topic -> [(C type, field, number of elements)]; the time comes first
FORMATS: dict[str, list[tuple[str, str, int]]] = {
    "vehicle_odometry": [
        ("uint64_t", "timestamp", 1), ("float", "position", 3), ("float", "q", 4), ("float", "velocity", 3),
        ("float", "angular_velocity", 3), ("uint8_t", "pose_frame", 1), ("uint8_t", "velocity_frame", 1),
        ("uint8_t", "reset_counter", 1),
    ],
    "vehicle_attitude": [("uint64_t", "timestamp", 1), ("float", "q", 4), ("uint8_t", "quat_reset_counter", 1)],
    "vehicle_local_position": [
        ("uint64_t", "timestamp", 1), ("float", "x", 1), ("float", "y", 1), ("float", "z", 1),
        ("float", "vx", 1), ("float", "vy", 1), ("float", "vz", 1),
    ],
    "vehicle_angular_velocity": [("uint64_t", "timestamp", 1), ("float", "xyz", 3)],
    "actuator_motors": [("uint64_t", "timestamp", 1), ("float", "control", 12)],
    "actuator_outputs": [("uint64_t", "timestamp", 1), ("float", "output", 16)],
    "battery_status": [("uint64_t", "timestamp", 1), ("float", "voltage_v", 1)],
    "vehicle_land_detected": [("uint64_t", "timestamp", 1), ("uint8_t", "landed", 1),
                              ("uint8_t", "ground_contact", 1), ("uint8_t", "maybe_landed", 1)],
    "manual_control_setpoint": [
        ("uint64_t", "timestamp", 1), ("float", "roll", 1), ("float", "pitch", 1), ("float", "yaw", 1),
        ("float", "throttle", 1),
    ],
    "vehicle_attitude_setpoint": [
        ("uint64_t", "timestamp", 1), ("float", "q_d", 4), ("float", "thrust_body", 3),
    ],
    "vehicle_rates_setpoint": [
        ("uint64_t", "timestamp", 1), ("float", "roll", 1), ("float", "pitch", 1), ("float", "yaw", 1),
    ],
}  # fmt: skip


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def write_ulog(
    path: Path,
    topics: Mapping[str, Mapping[str, Sequence[float] | np.ndarray]],
    parameters: Mapping[str, float] = {},
) -> Path:
    """Writes topics given as field -> (n,) or (n, elements); `timestamp` in seconds; fields may be left out."""
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), _message("B", bytes(40))]
    formats = {name: [f for f in FORMATS[name] if f[1] in given] for name, given in topics.items()}
    for name, known in formats.items():
        fields = ";".join(f"{c}{f'[{n}]' if n > 1 else ''} {field}" for c, field, n in known) + ";"
        out.append(_message("F", f"{name}:{fields}".encode()))
    for key, value in parameters.items():
        text = f"int32_t {key}".encode()
        out.append(_message("P", bytes([len(text)]) + text + struct.pack("<i", int(value))))
    rows: list[tuple[float, bytes]] = []
    for number, (name, fields) in enumerate(topics.items()):
        out.append(_message("A", struct.pack("<BH", 0, number) + name.encode()))
        layout = "<" + "".join(f"{n}{_TYPES[c]}" for c, _, n in formats[name])
        times = np.asarray(fields["timestamp"], dtype=float)
        for k, t in enumerate(times):
            values: list[float | int] = [round(t * 1e6)]
            for ctype, field, n in formats[name][1:]:
                cells = np.atleast_1d(np.asarray(fields[field])[k]).tolist()
                cells += [float("nan")] * (n - len(cells))
                values += [int(c) for c in cells] if ctype != "float" else cells
            rows.append((t, _message("D", struct.pack("<H", number) + struct.pack(layout, *values))))
    rows.sort(key=lambda row: row[0])
    path.write_bytes(b"".join(out + [row for _, row in rows]))
    return path
