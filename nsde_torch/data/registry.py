"""Reading by kind: `read("csv", system, path=...)`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

from nsde_torch.data.checks import assemble
from nsde_torch.data.raw import RawRun
from nsde_torch.data.readers import READERS, Kind, name_of, reader
from nsde_torch.data.run import DataSet
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError


def read(
    kind: Kind,
    system: SystemInfo,
    *,
    path: str,
    dt: float | None = None,
    gap: float | None = None,
    clock: str = "rescale",
    sensor_bias: Mapping[str, float] | None = None,
    sensor_delay: Mapping[str, float] | None = None,
    sensor_lag: Mapping[str, float] | None = None,
    **options: Any,
) -> DataSet:
    """Reads and checks a data set.

    Args:
        kind: Key of `READERS`, `module:function` of the user's own, or the function.
        system: The system that the data belong to.
        path: File or folder, as the kind says.
        dt: Step [s]; default: the data's own (the nominal step of a published file, else the median).
        gap: Time between rows that counts as a gap [s]; default: 2.5 steps.
        clock: `rescale`, `trust` or `refuse` a clock that disagrees with the kinematics.
        sensor_bias: What sensors read too much, by name of a state, in its unit; taken out before anything else.
        sensor_delay: By how much states are logged late, by name of a state or common name of several [s of the log].
        sensor_lag: Time constants of filters that states went through, to undo, by the same names [s of the log].
        options: Further options of the kind.

    Returns:
        The data set with its summary.

    Raises:
        ConfigError: an unknown kind or option.
        DataError: data that cannot be used; the message says where and what to do.
    """
    make, name = reader(kind), name_of(kind)
    if dt is not None and name in READERS and READERS[name].takes_step:
        options["dt"] = dt
    if not path:
        raise ConfigError(f"`path` is empty; data of kind {name!r} need the path of a file or folder.")
    try:
        raw: Sequence[RawRun] = make(system, path=path, **options)
    except TypeError as error:
        if "unexpected keyword" in str(error):
            raise ConfigError(f"data of kind {name!r}: {error}.") from error
        raise
    for state, value in (sensor_bias or {}).items():
        _unbias(raw, system, state, value)
    late = {"sensor_delay": sensor_delay, "sensor_lag": sensor_lag}
    return assemble(raw, system, kind=name, dt=dt, gap=gap, clock=clock, **late)


def _unbias(raw: Sequence[RawRun], system: SystemInfo, name: str, value: float) -> None:
    if name not in system.state_names:
        raise ConfigError(
            f"`sensor_bias` names {name!r}, which is no state; states: {', '.join(system.state_names)}."
        )
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ConfigError(f"`sensor_bias.{name}` must be a finite number; got {value!r}.")
    for run in raw:
        run.x = run.x.copy()
        run.x[:, list(system.state_names).index(name)] -= value
