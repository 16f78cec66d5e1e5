"""Which columns are motor commands, in what unit, and by whose numbers; and the battery's voltage."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.formats.log import StreamLog, full
from nsde_torch.data.mapping import names as kinds
from nsde_torch.data.mapping.files import LogFile
from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping
from nsde_torch.data.mapping.names import Named
from nsde_torch.data.streams import moving
from nsde_torch.data.system_info import SystemInfo

_BATTERY = re.compile(r"(^|[^a-z])(vbat|v_bat|bat_?volt\w*|battery_?voltage|voltage_v|volt)$")
_CRAZYFLIE = re.compile(r"state_?estimate|pm_?\.?vbat|motor_m[1-4]", re.I)
_TURNS = {"rpm": "rpm", "rad/s": "rad/s", "rad_s": "rad/s", "rads": "rad/s"}
_SPEEDS = re.compile(r"rotor|omega|speed|vel")
_SHORTEST_US = 800.0  # of pulses that turn a motor; of a thousand, one may be shorter
_TURNS_US = 980.0
_NEGATIVE = -0.02  # a motor's command is none


@dataclass
class InputsFound:
    """Entries of inputs and channels, and what is not sure of them."""

    columns: dict[str, ColumnEntry] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def propose_inputs(
    log: StreamLog, system: SystemInfo, found: Sequence[Named], said: Mapping[str, ColumnEntry]
) -> InputsFound:
    """Motors and battery of a multirotor.

    Args:
        log: The streams.
        system: The machine.
        found: Vectors in the log.
        said: Entries that the format gives.
    """
    out = InputsFound()
    wanted = len(system.input_names)
    if "u" in said:
        _take(out, log, said["u"], wanted)
    else:
        candidates: list[ColumnEntry] = []
        longer: list[ColumnEntry] = []
        for one in kinds.pick(found, kinds.MOTORS):
            stream = next(s for s in log.streams if s.name == one.stream)
            values = stream.columns(*one.columns)
            moves = moving(values)
            if int(moves.sum()) >= wanted and not (values < _NEGATIVE).any():
                columns = [c for c, m in zip(one.columns, moves, strict=True) if m][:wanted]
                entry = ColumnEntry(tuple(f"{one.stream}/{c}" if one.stream else c for c in columns))
                unit = one.unit or stream.units.get(columns[0])
                found_here = _in_unit(entry, stream.columns(*columns), unit)
                (candidates if int(moves.sum()) == wanted else longer).append(found_here)
        if longer and not candidates:
            candidates = longer
            told = ", ".join(longer[0].source)
            out.open.append(f"more than {wanted} columns of commands move; the motors are taken to be {told}")
        if not candidates:
            out.missing.append(f"{wanted} motor commands that move")
        else:
            entry = candidates[0]
            if any(_CRAZYFLIE.search(name) for name in log.names()) and wanted == 4:
                entry = replace(entry, numbering="crazyflie")
            else:
                out.notes.append("motors are taken to be numbered as PX4 does")
            out.columns["u"] = entry
            if len(candidates) > 1:
                told = " or ".join(", ".join(one.source) for one in candidates)
                out.open.append(f"the motor commands may be {told}")
    if "battery_voltage" in said:
        out.columns["battery_voltage"] = said["battery_voltage"]
    else:
        volts = [
            full(s, c) for s in log.streams for c in s.fields if _BATTERY.search(kinds.bare(c)[0].lower())
        ]
        if len(volts) == 1:
            out.columns["battery_voltage"] = ColumnEntry((volts[0],), unit="V")
    return out


def _take(out: InputsFound, log: StreamLog, entry: ColumnEntry, wanted: int) -> None:
    """The motors that the format names, if there are as many as the system has."""
    if len(entry.source) == wanted:
        out.columns["u"] = entry
    else:
        out.missing.append(f"{wanted} motors (the log has {len(entry.source)}: choose the system)")


def _in_unit(entry: ColumnEntry, values: Array, unit: str | None) -> ColumnEntry:
    """Motor commands with the ends of their range, or speeds of rotors, by their names and by what they read."""
    flat = values[np.isfinite(values)]
    top = float(np.quantile(flat, 0.999))
    running = flat[flat > 0.02 * top]
    low = float(np.quantile(running, 0.001)) if len(running) else 0.0
    unit = unit or next(
        (unit for mark, unit in _TURNS.items() if mark in " ".join(entry.source).lower()), None
    )
    speeds = unit in _TURNS.values() or _SPEEDS.search(" ".join(entry.source).lower())
    if top <= 1.05:
        return replace(entry, unit="1")
    if top <= 105.0:
        return replace(entry, unit="%")
    # pulses below 1000 us are those of motors that stand, of one length or two
    stands = len(np.unique(running[running < _TURNS_US])) <= 2
    if not speeds and low > _SHORTEST_US and top <= 2250.0 and stands:
        return replace(entry, unit="us", low=1000.0, high=2000.0)
    if not speeds and 30000.0 < top <= 65535.0:  # a duty cycle in 16 bits
        return replace(entry, low=0.0, high=65535.0)
    return replace(entry, unit=unit, full=_rounded(float(flat.max())))


def full_of_all(mapping: LogMapping, files: Sequence[LogFile]) -> LogMapping:
    """The mapping with the speed of full thrust at least as large as any in the logs: a greater one is refused.

    Args:
        mapping: Proposed by the first log.
        files: All logs.
    """
    entry = mapping.columns.get("u")
    if entry is None or entry.full is None:
        return mapping
    most = entry.full
    for file in files[1:]:
        log = file.open(mapping.time)
        for source in entry.source:
            if log.has(source):
                stream, column = log.find(source)
                most = max(most, _rounded(float(np.nanmax(stream.fields[column], initial=1e-3))))
    return mapping.changed("u", full=most)


def _rounded(value: float) -> float:
    """A speed a little above one that was read."""
    size = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / size) * size)
