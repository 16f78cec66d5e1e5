"""Channels of a run by name, moved in time and filtered: what late sensors do, and what takes it back.

Times are seconds of the log's own clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError, DataError

Array = NDArray[np.float64]


def common_name(names: Sequence[str]) -> str:
    """What several states are called together: `p` for `p_x`, `p_y` and `p_z`."""
    return names[0] if len(names) == 1 else names[0].rsplit("_", 1)[0]


def channel_columns(system: SystemInfo, channel: str) -> list[int]:
    """Columns of a state, or of all whose common name this is.

    Raises:
        ConfigError: there is none, or it is a part of an attitude, which moves as one.
    """
    names = list(system.state_names)
    of_attitude = [] if system.quaternion is None else names[system.quaternion]
    if channel in of_attitude:
        raise ConfigError(
            f"{channel!r} is a part of an attitude; name it whole: {common_name(of_attitude)!r}."
        )
    if channel in names:
        return [names.index(channel)]
    out = [k for k, name in enumerate(names) if name.startswith(channel + "_")] if channel else []
    if not out:
        vectors = sorted({n.rsplit("_", 1)[0] for n in names if n not in of_attitude} - set(names))
        whole = [*([common_name(of_attitude)] if of_attitude else []), *(v for v in vectors if v)]
        raise ConfigError(
            f"{channel!r} is no state of system {system.name!r}; states: {', '.join(names)}"
            + (f"; several at once: {', '.join(whole)}." if whole else ".")
        )
    return out


def on_time(
    run: Run, system: SystemInfo, late: Mapping[str, float], filters: Mapping[str, float] | None = None
) -> Run:
    """A run whose late channels are moved to where they belong, x(t) = x_log(t + d); the ends of its segments go.

    What a filter of first order made late is undone first, x = x_log + T x_log'.

    Args:
        run: The run.
        system: Names of the states.
        late: By state, or by the common name of several: by how much it is late [s of the log]; early, if negative.
        filters: By state or common name: time constant of a filter [s of the log].

    Raises:
        ConfigError: an unknown channel, or a time that is not a number.
        DataError: the run is too short.
    """
    moves = [(channel_columns(system, channel), _checked(channel, d) / run.dt) for channel, d in late.items()]
    sped = [
        (channel_columns(system, channel), _checked(channel, d)) for channel, d in (filters or {}).items()
    ]
    x = run.x.copy()
    for a, b in run.segments:
        for columns, seconds in sped:
            x[a:b, columns] = unfiltered(x[a:b, columns], seconds / run.dt)
    segments = []
    first = max((0, *(int(np.ceil(-rows - 1e-9)) for _, rows in moves)))
    last = max((0, *(int(np.ceil(rows - 1e-9)) for _, rows in moves)))
    for a, b in run.segments:
        if b - a - first - last < 2:
            continue
        for columns, rows in moves:
            x[a:b, columns] = moved(x[a:b, columns], rows)
        if system.quaternion is not None:
            x[a:b, system.quaternion] /= np.linalg.norm(x[a:b, system.quaternion], axis=1, keepdims=True)
        segments.append((a + first, b - last))
    if not segments:
        said = ", ".join(f"{1e3 * by:.3g} ms of {name}" for name, by in late.items())
        raise DataError(
            f"run {run.name!r} has no stretch that is long enough to take delays out of it ({said}). "
            "Leave the run out, or record without gaps."
        )
    return replace(run, x=x, segments=tuple(segments))


def moved(x: Array, rows: float) -> Array:
    """Rows as they are `rows` later (earlier, if negative), by a cubic spline; at the end the last one is repeated."""
    k = np.arange(len(x), dtype=np.float64)
    at = np.clip(k + rows, 0.0, len(x) - 1.0)
    if len(x) < 4:
        return np.stack([np.interp(at, k, column) for column in x.T], 1)
    return np.asarray(CubicSpline(k, x)(at))


def unfiltered(x: Array, rows: float) -> Array:
    """What a filter of first order with a time constant of `rows` was given, x + rows dx/drow by a cubic spline."""
    if len(x) < 4:
        return x
    return x + rows * np.asarray(CubicSpline(np.arange(len(x), dtype=np.float64), x)(np.arange(len(x)), 1))


def filtered(x: Array, rows: float) -> Array:
    """A filter of first order with a time constant of `rows`, at rest at the first row, straight between rows."""
    if rows <= 0:
        return x
    keep = float(np.exp(-1.0 / rows))
    new, old = 1.0 - rows * (1.0 - keep), rows * (1.0 - keep) - keep
    return np.asarray(lfilter([new, old], [1.0, -keep], x, axis=0, zi=x[:1] * (keep + old))[0])


def changed(
    x: Array, system: SystemInfo, values: Mapping[str, float], change: Callable[[Array, float], Array]
) -> Array:
    """States whose channels are each changed by a number, an attitude back on the sphere.

    Args:
        x: States (n, nx).
        system: Names of the states.
        values: Number by state, or by the common name of several.
        change: Function of columns and their number.
    """
    x = x.copy()
    for name, value in values.items():
        columns = channel_columns(system, name)
        x[:, columns] = change(x[:, columns], value)
    if system.quaternion is not None:
        x[:, system.quaternion] /= np.linalg.norm(x[:, system.quaternion], axis=1, keepdims=True)
    return x


def check_times(name: str, values: Mapping[str, float], system: SystemInfo) -> None:
    """Refuse times of an option that are of no state, or below 0 s.

    Raises:
        ConfigError: names the option, and what it was given.
    """
    for channel, value in values.items():
        channel_columns(system, channel)
        if not (isfinite(value) and value >= 0):
            raise ConfigError(f"`{name}.{channel}` must be a time of 0 s or more; got {value!r}.")


def _checked(channel: str, d: object) -> float:
    if isinstance(d, bool) or not isinstance(d, int | float) or not isfinite(d):
        raise ConfigError(f"the time of {channel!r} must be a finite time [s]; got {d!r}.")
    return float(d)
