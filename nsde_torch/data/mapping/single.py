"""Columns of machines without an attitude: each state and input by its name, or by one that means the same."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from nsde_torch.data.formats.log import StreamLog, full
from nsde_torch.data.mapping.kinematic import INTERVAL_S
from nsde_torch.data.mapping.mapping import ColumnEntry, targets
from nsde_torch.data.mapping.names import bare, is_measured
from nsde_torch.data.streams import moving
from nsde_torch.data.system_info import SystemInfo

_POSITIONS = {
    "q",
    "x",
    "y",
    "pos",
    "position",
    "angle",
    "theta",
    "phi",
    "qm",
    "displacement",
    "deflection",
    "output",
}
_RATES = {
    "v",
    "vel",
    "velocity",
    "speed",
    "dq",
    "qd",
    "qdot",
    "dx",
    "xd",
    "xdot",
    "omega",
    "dtheta",
    "thetadot",
    "angvel",
}
_INPUTS = {
    "u",
    "f",
    "force",
    "input",
    "tau",
    "torque",
    "voltage",
    "current",
    "command",
    "cmd",
    "control",
    "vir",
    "motor",
}
_FEWEST = 10  # movements that tell a rate
_MEASURED = re.compile(r"_(meas|measured|act|actual|filt|filtered|enc|encoder)(?=\d*$)")
_COMMANDED = re.compile(r"_(cmd|command|commanded)(?=\d*$)")


@dataclass
class ColumnsFound:
    """Entries, and what is missing or open."""

    columns: dict[str, ColumnEntry] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def propose_single(
    log: StreamLog, system: SystemInfo, said: Mapping[str, ColumnEntry] | None = None
) -> ColumnsFound:
    """Entries for the states and inputs of a machine without an attitude.

    Args:
        log: The streams.
        system: The machine.
        said: Entries that the format gives; those that are of the system are taken.
    """
    out = ColumnsFound()
    names = {*system.state_names, *system.input_names, *system.exogenous}
    given: set[str] = set()
    for name, entry in (said or {}).items():
        own = targets(system, name)
        if set(own) <= names and len(own) == len(entry.source):
            out.columns[name] = entry
            given |= set(own)
    free: dict[str, tuple[str, str | None]] = {}
    still: set[str] = set()
    for stream in log.streams:
        for column, values in stream.fields.items():
            name, unit = bare(column)
            free[full(stream, column)] = (name, stream.units.get(column) or unit)
            if not moving(values[:, None])[0]:
                still.add(full(stream, column))
    names_of = list(free)
    rates = {rate: position for position, rate, _ in system.position_derivatives}
    for wanted in (*system.state_names, *system.input_names, *system.exogenous):
        if wanted in given:
            continue
        found = _named(wanted, free, still, system, rates)
        if wanted in rates:  # `v` may be a voltage: a rate of another name is one by its position
            place = out.columns.get(rates[wanted])
            same = [key for key in found if _squeezed(free[key][0]) == _squeezed(wanted)]
            found = same or [
                key for key in found if place is not None and _follows(log, place.source[0], key)
            ]
        if len(found) == 1:
            name = found[0]
            unit = free.pop(name)[1]
            out.columns[wanted] = ColumnEntry((name,), unit=unit)
        elif found:
            out.open.append(f"{wanted} may be {' or '.join(found)}")
            out.columns[wanted] = ColumnEntry((found[0],), unit=free.pop(found[0])[1])
        elif wanted not in rates and wanted not in system.optional_inputs:
            asked = [key for key, (name, _) in free.items() if not is_measured(name)]
            more = ""
            if asked and wanted in system.state_names:
                more = f" (taken for setpoints: {', '.join(asked)})"
            elif wanted in system.input_names and names_of:
                more = f" (where nothing drove it, any column times 0: `{wanted}: {{from: {names_of[0]}, scale: 0}}`)"
            out.missing.append(f"a column for {wanted}{more}")
        elif wanted in system.optional_inputs and (left := [key for key in free if key not in still]):
            out.notes.append(
                f"{wanted} is taken to be 0 throughout: none of {', '.join(left)} has such a name"
            )
    return out


def _named(
    wanted: str,
    free: dict[str, tuple[str, str | None]],
    still: set[str],
    system: SystemInfo,
    rates: dict[str, str],
) -> list[str]:
    """Columns of a name that means `wanted`: the same, else a synonym where the system has one such, else alike."""
    plain = {key: _squeezed(name) for key, (name, _) in free.items()}
    same = [key for key, name in plain.items() if name == _squeezed(wanted)]
    if same:
        return same
    plain = {key: _MEASURED.sub("", name.lower()) for key, (name, _) in free.items()}
    if wanted in system.input_names:
        plain = {key: _COMMANDED.sub("", name) for key, name in plain.items()}
    plain = {key: _squeezed(name) for key, name in plain.items()}
    plain = {key: name for key, name in plain.items() if key not in still}
    if wanted in system.state_names:  # a setpoint is no state, however much it is called like one
        plain = {key: name for key, name in plain.items() if is_measured(free[key][0])}
    positions = [n for n in system.state_names if n not in rates]
    words = _RATES if wanted in rates else _POSITIONS if wanted in positions else _INPUTS
    several = len(system.input_names if words is _INPUTS else positions) > 1
    number = re.sub(r"\D", "", wanted)
    if several and not number:  # of joints without numbers nothing says which is which
        words = set()
    alike = [key for key, name in plain.items() if name in words and not several]
    alike = alike or [
        key for key, name in plain.items() if _of_joint(name, words, number if several else None)
    ]
    if alike:
        return alike
    near = difflib.get_close_matches(_squeezed(wanted), list(plain.values()), n=1, cutoff=0.8)
    return [key for key, name in plain.items() if near and name == near[0]]


def _of_joint(name: str, words: set[str], number: str | None) -> bool:
    """Whether a name is one of some words and a number; None: any number."""
    stem = name.rstrip("0123456789")
    return stem in words and (number is None or name[len(stem) :] == number)


def _follows(log: StreamLog, position: str, rate: str) -> bool:
    """Whether a column is the rate of another, in whatever units, by the movement over 0.25 s; True where none says."""
    (one, p), (other, v) = log.find(position), log.find(rate)
    if one is not other or not one.timed:
        return True
    every = max(1, round(INTERVAL_S * one.rate))
    good = np.isfinite(one.fields[p] + one.fields[v])
    place, speed = one.fields[p][good], one.fields[v][good]
    moved = np.diff(place[::every])
    told = np.diff(np.cumsum(speed)[::every])
    if len(moved) < _FEWEST or not np.ptp(moved) or not np.ptp(told):
        return True
    return bool(np.corrcoef(moved, told)[0, 1] ** 2 > 0.9)


def _squeezed(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", re.split(r"[./]", name.lower())[-1])
