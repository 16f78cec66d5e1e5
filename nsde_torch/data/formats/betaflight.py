"""Betaflight's black box logs (.bbl, .bfl) by orangebox: every log of the file is a run.

Rates are `gyroADC` (deg/s, FLU: the firmware counts the nose down and a turn to the left as positive), motors
`motor[k]` between the ends of the header `motorOutput`, battery `vbatLatest` in hundredths of a volt. There is no
position.
"""

import logging
from array import array
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.streams import Stream, StreamLog, optional, ordered, parsing, unreadable
from nsde_torch.errors import DataError

# it reports every file, and every event that it does not know
logging.getLogger("orangebox").setLevel(logging.CRITICAL)
_STATES = ("loopIteration", "flightModeFlags", "stateFlags", "failsafePhase")


def open_betaflight(path: Path, *, index: int = 1) -> StreamLog:
    """One of the logs of a file, by its number from 1."""
    parser_of = optional("orangebox", "betaflight", path).Parser.load
    numbers = array("d")  # a list of floats would take four times the memory
    try:
        parser = parser_of(str(path), index, allow_invalid_header=True)
        names, headers = list(parser.field_names), dict(parser.headers)
        main = [k for k, name in enumerate(names) if name not in _STATES]
        for frame in parser.frames():
            values = (frame.data[k] for k in main)  # None of what no slow frame has given yet
            numbers.extend([float(v) if isinstance(v, int | float) else float("nan") for v in values])
    except Exception as error:  # a log that ends with the battery ends without its last event
        if not numbers:
            raise unreadable(path, "Betaflight log", error) from error
    if len(numbers) < 2 * len(main):
        raise DataError(f"{path}: log {index} holds no frames.")
    table = np.array(numbers).reshape(-1, len(main))
    fields = {names[k]: table[:, j] for j, k in enumerate(main)}
    t = fields.pop("time") * 1e-6
    units = {name: "deg/s" for name in fields if name.startswith("gyro")}
    stream = ordered(Stream("", t, fields, units))
    return StreamLog(path.stem, str(path), [stream], _meaning(fields, headers), {"body": "FLU"})


def logs_of(path: Path) -> int:
    """How many logs a file holds."""
    parser_of = optional("orangebox", "betaflight", path).Parser.load
    with parsing(path, "Betaflight log"):
        return int(parser_of(str(path), 1, allow_invalid_header=True).reader.log_count)


def _meaning(fields: dict[str, Array], headers: dict[str, Any]) -> dict[str, dict[str, object]]:
    out: dict[str, dict[str, object]] = {}
    gyro = [f"gyroADC[{k}]" for k in range(3)]
    if all(name in fields for name in gyro):
        out["w"] = {"from": gyro, "unit": "deg/s"}
    motors = [f"motor[{k}]" for k in range(12) if f"motor[{k}]" in fields]
    if motors:
        low, high = _ends(headers, np.stack([fields[m] for m in motors]))
        out["u"] = {"from": motors, "low": low, "high": high, "numbering": "betaflight"}
    if "vbatLatest" in fields:
        out["battery_voltage"] = {"from": "vbatLatest", "unit": "V", "scale": 0.01}
    return out


def _ends(headers: dict[str, Any], motors: Array) -> tuple[float, float]:
    ends = headers.get("motorOutput")
    if isinstance(ends, list | tuple) and len(ends) == 2 and float(ends[1]) > float(ends[0]):
        return float(ends[0]), float(ends[1])
    return (48.0, 2047.0) if float(np.nanmedian(motors)) < 900 else (1000.0, 2000.0)
