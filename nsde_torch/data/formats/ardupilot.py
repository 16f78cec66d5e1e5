"""ArduPilot's DataFlash logs (.bin) by pymavlink's index, whole columns at a time.

Messages, fields, types and units are what the log's own FMT, FMTU and UNIT messages say. State from the estimator
(`XKF1`, or `NKF1` of old logs; `ATT` and `XKQ` where they are faster), rates from `RATE` or `IMU`, motors from `RCOU`:
the outputs whose parameter `SERVOn_FUNCTION` is a motor (33 to 40, 82 to 85), pulse widths by `MOT_PWM_MIN` and
`MOT_PWM_MAX`. Axes are NED and FRD.
"""

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.streams import Stream, StreamLog, ordered, parsing
from nsde_torch.errors import DataError

_ANGLES = {"degheading": "deg", "m/s/s": "m/s2", "µs": "us"}
_SYSTEM = {
    "FMT", "FMTU", "UNIT", "MULT", "PARM", "MSG", "MODE", "EV", "ERR", "CMD", "FILE", "DU32", "ISBD", "ISBH",
}  # fmt: skip
_HEADER = 3  # bytes before the fields of a message
_MOTORS = [*range(33, 41), *range(82, 86)]  # values of SERVOn_FUNCTION of motors 1 to 12


def open_ardupilot(path: Path) -> StreamLog:
    """The messages of one log, each a stream; where several sensors log one, a stream each."""
    from pymavlink import DFReader

    class Index(DFReader.DFReader_binary):
        """The index of a log, without a search for the clock of GPS through all of it: messages have times."""

        def init_clock(self) -> None:
            self.clock = DFReader.DFReaderClock_usec()

    with parsing(path, "ArduPilot log"):
        with contextlib.redirect_stderr(io.StringIO()):  # it prints every byte that is no message
            log = Index(str(path), zero_time_base=True)
        with contextlib.closing(log):
            streams = [s for kind in log.formats for s in _streams(log, kind)]
            parameters = _parameters(log)
    if not streams:
        raise DataError(f"{path} holds no messages of an ArduPilot log.")
    columns = _meaning({s.name: s for s in streams}, parameters)
    return StreamLog(path.stem, str(path), streams, columns, {"world": "NED", "body": "FRD"})


def _streams(log: Any, kind: int) -> list[Stream]:
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    form = log.formats[kind]
    if form.name in _SYSTEM or "TimeUS" not in form.columns:
        return []
    table = _records(log, kind)
    if table is None or len(table) < 2:
        return []
    fields, units = {}, {}
    told = form.units or []
    instance = getattr(form, "instance_field", None)
    for place, (column, letter) in enumerate(zip(form.columns, form.format, strict=False)):
        if letter in "anNZ":
            continue
        fields[column] = table[f"f{place}"].astype(np.float64) * (FORMAT_TO_STRUCT[letter][1] or 1.0)
        if place < len(told) and told[place] not in ("", "UNKNOWN"):
            units[column] = _ANGLES.get(told[place], told[place])
    t = fields.pop("TimeUS") * 1e-6
    if instance not in fields:
        return [ordered(Stream(form.name, t, fields, units))]
    which = fields.pop(instance)
    out = []
    for number in np.unique(which)[:8].astype(int).tolist():
        rows = which == number
        name = form.name if number == 0 else f"{form.name}[{number}]"
        out.append(ordered(Stream(name, t[rows], {k: v[rows] for k, v in fields.items()}, units)))
    return [stream for stream in out if len(stream.t) > 1]


def _records(log: Any, kind: int) -> NDArray[Any] | None:
    """All messages of a kind as records; None where there are none."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    form = log.formats[kind]
    offsets = np.asarray(log.offsets[kind], dtype=np.int64)
    offsets = offsets[offsets + form.len <= log.data_len]
    if not len(offsets) or any(letter not in FORMAT_TO_STRUCT for letter in form.format):
        return None
    codes = [str(FORMAT_TO_STRUCT[letter][0]) for letter in form.format]
    own = (f"S{code[:-1]}" if code.endswith("s") else f"<{code}" for code in codes)
    kinds = np.dtype([(f"f{k}", one) for k, one in enumerate(own)])
    if kinds.itemsize != form.len - _HEADER:
        return None
    data = np.frombuffer(log.data_map, dtype=np.uint8)
    out = np.empty(len(offsets), dtype=kinds)
    raw = out.view(np.uint8).reshape(len(offsets), kinds.itemsize)
    for first in range(0, len(offsets), 1 << 16):  # in pieces: an index of every byte is eight times the data
        some = offsets[first : first + (1 << 16)]
        raw[first : first + (1 << 16)] = data[some[:, None] + np.arange(_HEADER, form.len)]
    del data
    return out


def _parameters(log: Any) -> dict[str, float]:
    for kind, form in log.formats.items():
        if form.name == "PARM" and {"Name", "Value"} <= set(form.columns):
            table = _records(log, kind)
            columns = () if table is None else (table[f"f{form.columns.index(c)}"] for c in ("Name", "Value"))
            return {n.decode("ascii", "replace"): float(v) for n, v in zip(*columns, strict=True)}
    return {}


def _meaning(streams: dict[str, Stream], parameters: dict[str, float]) -> dict[str, dict[str, object]]:
    """Entries of a mapping, as the firmware defines its messages."""
    out: dict[str, dict[str, object]] = {}
    kalman = next((n for n in ("XKF1", "NKF1") if n in streams), None)
    if kalman:
        out["p"] = {"from": [f"{kalman}/{c}" for c in ("PN", "PE", "PD")], "unit": "m"}
        out["v"] = {"from": [f"{kalman}/{c}" for c in ("VN", "VE", "VD")], "unit": "m/s", "axes": "world"}
    angles = [n for n in (kalman, "ATT", "AHR2") if n and n in streams]
    fastest = max(angles, key=lambda n: (round(streams[n].rate), -angles.index(n)), default=None)
    if fastest:
        out["q"] = {"from": [f"{fastest}/{c}" for c in ("Roll", "Pitch", "Yaw")], "unit": "deg"}
    if "RATE" in streams:
        out["w"] = {"from": [f"RATE/{c}" for c in "RPY"], "unit": "deg/s"}
    elif "IMU" in streams:
        out["w"] = {"from": [f"IMU/{c}" for c in ("GyrX", "GyrY", "GyrZ")], "unit": "rad/s"}
    if "RCOU" in streams:
        function = {parameters.get(f"SERVO{k}_FUNCTION"): k for k in range(1, 17)}
        outputs = streams["RCOU"].fields
        moving = (k for k in range(1, 9) if f"C{k}" in outputs and np.ptp(outputs[f"C{k}"]) > 50)
        motors = [function[f] for f in _MOTORS if f in function] or list(moving)
        if motors:
            out["u"] = {
                "from": [f"RCOU/C{k}" for k in motors],
                "unit": "us",
                "low": parameters.get("MOT_PWM_MIN") or 1000.0,
                "high": parameters.get("MOT_PWM_MAX") or 2000.0,
                "numbering": "ardupilot",
            }
    battery = next((n for n in ("BAT", "CURR") if n in streams and "Volt" in streams[n].fields), None)
    if battery:
        out["battery_voltage"] = {"from": f"{battery}/Volt", "unit": "V"}
    return out
