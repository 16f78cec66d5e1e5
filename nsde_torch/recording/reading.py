"""Reading by kind: `read("csv", system, path=...)`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nsde_torch.data.raw import RawRun
from nsde_torch.data.readers import READERS, Kind, name_of, reader
from nsde_torch.data.run import DataSet
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError
from nsde_torch.recording.checks import assemble
from nsde_torch.recording.faults.registry import remedies


def read(
    kind: Kind,
    system: SystemInfo,
    *,
    path: str,
    dt: float | None = None,
    gap: float | None = None,
    clock: str = "rescale",
    derived_rates: str = "infer",
    own_rate: bool = False,
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
        derived_rates: `infer` or `keep` rates that were made of positions.
        own_rate: Whether the step stays that of the log where `dt` is longer (see `assemble`).
        options: What the recording did, to take out (`sensor_bias={"q": 0.1}`, see `RemedyOptions`), and further
            options of the kind.

    Returns:
        The data set with its summary.

    Raises:
        ConfigError: an unknown kind or option.
        DataError: data that cannot be used; the message says where and what to do.
    """
    make, name = reader(kind), name_of(kind)
    told = {fault: options.pop(fault) for fault in remedies() if fault in options}
    if dt is not None and name in READERS and READERS[name].takes_step:
        options["dt"] = dt
    if not path:
        raise ConfigError(f"`path` is empty; data of kind {name!r} need the path of a file or folder.")
    raw = _called(make, name, system, path=path, **options)
    for fault in [fault for fault in told if remedies()[fault].remedy_first]:
        values = told.pop(fault) or {}
        named = {run.name for run in raw}
        strange = sorted(k for k, v in (values or {}).items() if isinstance(v, Mapping) and k not in named)
        if strange:
            raise ConfigError(
                f"`{fault}` names {strange[0]!r}, which is no run; runs are {', '.join(sorted(named))}."
            )
        for run in raw if values else ():
            remedies()[fault].undo_raw(run, system, values)
    return assemble(
        raw,
        system,
        kind=name,
        dt=dt,
        gap=gap,
        clock=clock,
        derived_rates=derived_rates,
        own_rate=own_rate,
        **told,
    )


def _called(make: Callable[..., Any], name: str, system: SystemInfo, **given: Any) -> Sequence[RawRun]:
    """What a reader returns, once its arguments are found to be those of a reader."""
    try:
        inspect.signature(make).bind(system, **given)
    except (TypeError, ValueError) as error:  # other arguments, or a function in C that does not tell its own
        raise ConfigError(
            f"data of kind {name!r}: {error}. A reader is a function `read(system, *, path, ...)`."
        ) from error
    raw: Sequence[RawRun] = make(system, **given)
    if not isinstance(raw, Sequence) or not all(isinstance(run, RawRun) for run in raw):
        raise ConfigError(
            f"data of kind {name!r}: a reader returns a list of `nsde_torch.data.RawRun`; got {type(raw).__name__}."
        )
    return raw
