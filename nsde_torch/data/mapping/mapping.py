"""What the columns of a log mean to a system: one YAML file.

    system: quadrotor
    kind: table                                  # the reader
    time: {from: timestamp, unit: us}            # tables only; or {rate: 100}
    frames: {world: NED, body: FRD}              # the log's axes; ENU and FLU where nothing is said
    columns:
      p: {from: [x, y, z], unit: m}
      v: {from: [vx, vy, vz], unit: m/s, axes: body}
      q: {from: [qx, qy, qz, qw], order: xyzw, turns: body to world}      # or roll, pitch and yaw with a unit
      w: {from: [gyro/x, gyro/y, gyro/z], unit: deg/s, sign: [1, -1, -1]}
      u: {from: [m1, m2, m3, m4], unit: us, low: 1000, high: 2000, numbering: betaflight}
      battery_voltage: {from: vbat, unit: V}

A key of `columns` is the name of a state, an input or a further channel, or the letter that a group of them begins
with.
"""

from __future__ import annotations

from collections.abc import Mapping as Table
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from nsde_torch.data.streams import SECONDS, ClockOf
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import did_you_mean
from nsde_torch.plain_yaml import read_yaml


@dataclass(frozen=True)
class ColumnEntry:
    """How a column, or a group of columns, is logged."""

    source: tuple[str, ...]  # columns of the log
    unit: str | None = None  # of them; None: that of the system
    sign: tuple[float, ...] = ()  # of each, 1 or -1; empty: 1
    scale: float = 1.0  # further factor
    offset: float = 0.0  # what is added at last, in the unit of the system
    axes: str | None = None  # of a velocity: `world` or `body`
    order: str | None = None  # of a quaternion: `wxyz` or `xyzw`
    turns: str | None = None  # what a quaternion turns: `body to world` or `world to body`
    world: str | None = None  # axes of the world of this entry, where they differ from those of the file
    body: str | None = None  # axes of the body, likewise
    low: float | None = None  # reading of an input that means 0
    high: float | None = None  # reading of an input that means 1
    full: float | None = None
    """Speed of a rotor at full thrust, in `unit`: the input is the square of the share of it."""
    numbering: str | None = None  # whose numbers the motors have, a key of `numbering.NUMBERINGS`
    slowest: float | None = None
    """Slowest rate that is read [Hz]; None: 50 of motors, 4 of other inputs and of states."""


@dataclass(frozen=True)
class LogMapping:
    """What the columns of a log mean to a system (see the module's text)."""

    columns: Table[str, ColumnEntry]  # entries by the name of a column of the system, or of a group
    system: str = ""  # name of the system; empty where any that fits will do
    kind: str = ""  # the reader, for `nsde inspect`; empty: by the files
    time: ClockOf = field(default_factory=ClockOf)  # the clock of tables
    world: str = "ENU"  # axes of the world in the log, `ENU` or `NED`
    body: str = "FLU"  # axes of the body in the log, `FLU` or `FRD`

    def axes_of(self, entry: ColumnEntry) -> tuple[bool, bool]:
        """Whether the world of an entry is NED, and its body FRD."""
        return (entry.world or self.world) == "NED", (entry.body or self.body) == "FRD"

    def changed(self, name: str, **values: Any) -> LogMapping:
        """The mapping with values of one entry changed."""
        return replace(self, columns={**self.columns, name: replace(self.columns[name], **values)})


_KEYS = ("system", "kind", "time", "frames", "columns")
_ENTRY = {"from": "source", **{f.name: f.name for f in fields(ColumnEntry) if f.name != "source"}}
_CHOICES: dict[str, Sequence[str]] = {
    "axes": ("world", "body"), "order": ("wxyz", "xyzw"), "turns": ("body to world", "world to body"),
    "world": ("ENU", "NED"), "body": ("FLU", "FRD"),
}  # fmt: skip


def read_mapping(path: str | Path) -> LogMapping:
    """The mapping of a YAML file; a ConfigError names what is no file, no YAML, no key or out of range."""
    try:
        content = read_yaml(path)
    except ConfigError as error:
        raise ConfigError(f"`mapping`: {error}") from None
    return mapping_of(content, str(path))


def mapping_of(content: Any, source: str = "the mapping") -> LogMapping:
    """A mapping from plain containers as in the YAML file, `source` in messages; errors are those of `read_mapping`."""
    columns = content.get("columns") if isinstance(content, dict) else None
    if not isinstance(columns, dict) or not columns:
        raise ConfigError(f"{source} must hold `columns:` with an entry for each state and input.")
    _known(content, _KEYS, source)
    frames = _table(content.get("frames") or {}, f"{source}: `frames`")
    _known(frames, ("world", "body"), f"{source}: `frames`")
    time = _table(content.get("time") or {}, f"{source}: `time`")
    _known(time, ("from", "unit", "rate"), f"{source}: `time`")
    unit, rate = time.get("unit"), time.get("rate")
    if unit is not None and unit not in SECONDS:
        raise ConfigError(f"{source}: `unit` of the time must be one of {', '.join(SECONDS)}; got {unit!r}.")
    if rate is not None and not (_is_number(rate) and rate > 0):
        raise ConfigError(f"{source}: `rate` of the time must be rows a second, > 0; got {rate!r}.")
    clock = ClockOf(None if time.get("from") is None else str(time["from"]), unit, rate)
    return LogMapping(
        {str(name): _entry(value, f"{source}: `columns.{name}`") for name, value in columns.items()},
        system=str(content.get("system") or ""),
        kind=str(content.get("kind") or ""),
        time=clock,
        world=_choice(frames.get("world", "ENU"), "world", f"{source}: `frames.world`"),
        body=_choice(frames.get("body", "FLU"), "body", f"{source}: `frames.body`"),
    )


def _entry(value: Any, what: str) -> ColumnEntry:
    given = {"from": value} if isinstance(value, str | list) else dict(_table(value, what))
    _known(given, tuple(_ENTRY), what)
    source = given.pop("from", None)
    source = [source] if isinstance(source, str) else source
    names = tuple(source) if isinstance(source, list | tuple) else ()
    if not names or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{what} needs `from:`, the column of the log or a list of them.")
    out: dict[str, Any] = {}
    for key, one in given.items():
        if one is None:
            continue
        if key in _CHOICES:
            out[key] = _choice(one, key, f"{what}: `{key}`")
        elif key in ("unit", "numbering"):
            out[key] = str(one)
        elif key == "sign":
            signs: tuple[Any, ...] = tuple(one) if isinstance(one, list | tuple) else (one,) * len(names)
            if len(signs) != len(names) or any(s not in (1, -1) for s in signs):
                raise ConfigError(
                    f"{what}: `sign` must be 1 or -1, or one for each of {len(names)}; got {one!r}."
                )
            out[key] = tuple(float(str(s)) for s in signs)
        elif not _is_number(one):
            raise ConfigError(f"{what}: `{key}` must be a number; got {one!r}.")
        else:
            out[key] = float(str(one))
    if ("low" in out) != ("high" in out) or ("low" in out and out["low"] == out["high"]):
        raise ConfigError(f"{what}: `low` and `high` belong together, and must differ.")
    if out.get("full") == 0.0:
        raise ConfigError(f"{what}: `full` must not be 0.")
    return ColumnEntry(names, **out)


def _plain(entry: ColumnEntry) -> dict[str, Any]:
    out: dict[str, Any] = {"from": entry.source[0] if len(entry.source) == 1 else list(entry.source)}
    for one in fields(ColumnEntry)[1:]:
        value = getattr(entry, one.name)
        if value != one.default:
            out[one.name] = [int(s) for s in value] if one.name == "sign" else value
    return out


def text(mapping: LogMapping) -> str:
    """A mapping as YAML, an entry a line; what is as it always is left out."""

    def flow(value: Any) -> str:
        out = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=9999, allow_unicode=True)
        return str(out).strip()

    clock = {"from": mapping.time.source, "unit": mapping.time.unit, "rate": mapping.time.rate}
    time = {key: value for key, value in clock.items() if value is not None}
    usual = (mapping.world, mapping.body) == ("ENU", "FLU")
    frames = {} if usual else {"world": mapping.world, "body": mapping.body}
    lines = [f"{key}: {said}" for key, said in (("system", mapping.system), ("kind", mapping.kind)) if said]
    lines += [f"{key}: {flow(table)}" for key, table in (("time", time), ("frames", frames)) if table]
    lines += ["columns:", *(f"  {name}: {flow(_plain(entry))}" for name, entry in mapping.columns.items())]
    return "\n".join(lines) + "\n"


def targets(system: SystemInfo, name: str) -> tuple[str, ...]:
    """Columns of a system that an entry names; for an unknown name, the channel of that name."""
    every = (*system.state_names, *system.input_names, *system.exogenous)
    group = tuple(one for one in every if name in (one.rpartition("_")[0], one.partition("_")[0]))
    return (name,) if name in every else group or (name,)


def _known(given: Table[str, Any], keys: Sequence[str], what: str) -> None:
    for key in given:
        if key not in keys:
            raise ConfigError(f"{what}: {key!r} is none of {', '.join(keys)}.{did_you_mean(str(key), keys)}")


def _table(value: Any, what: str) -> Table[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{what} must be a table `key: value`; got {value!r}.")
    return value


def _choice(value: Any, key: str, what: str) -> str:
    if value not in _CHOICES[key]:
        raise ConfigError(f"{what} must be one of {', '.join(_CHOICES[key])}; got {value!r}.")
    return str(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
