"""Readers by kind: `read("csv", system, path=...)`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from nsde_torch.data.csv_folder import read_csv
from nsde_torch.data.published import read_published
from nsde_torch.data.raw import RawRun
from nsde_torch.data.run import DataSet
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError
from nsde_torch.recording.checks import assemble
from nsde_torch.recording.faults.registry import remedies


def _read_ulog(system: SystemInfo, **options: Any) -> Sequence[RawRun]:
    from nsde_torch.data.ulog import read_ulog  # pyulog is only needed here

    return read_ulog(system, **options)


READERS: dict[str, Callable[..., Sequence[RawRun]]] = {
    "csv": read_csv,
    "ulog": _read_ulog,
    "published": read_published,
}
"""Kind of data -> function (system, *, path, ...) that returns raw runs."""


def read(
    kind: str,
    system: SystemInfo,
    *,
    path: str,
    dt: float | None = None,
    gap: float | None = None,
    clock: str = "rescale",
    **options: Any,
) -> DataSet:
    """Reads and checks a data set.

    Args:
        kind: `csv`, `ulog` or `published`.
        system: The system that the data belong to.
        path: File or folder, as the kind says.
        dt: Step [s]; default: the data's own (the nominal step of a published file, else the median).
        gap: Time between rows that counts as a gap [s]; default: 2.5 steps.
        clock: `rescale`, `trust` or `refuse` a clock that disagrees with the kinematics.
        options: What the recording did, to take out (`sensor_bias={"q": 0.1}`, see `RemedyOptions`), and further
            options of the kind.

    Returns:
        The data set with its summary.

    Raises:
        ConfigError: an unknown kind or option.
        DataError: data that cannot be used; the message says where and what to do.
    """
    if kind not in READERS:
        raise ConfigError(
            f"`kind` of data must be one of {', '.join(sorted(READERS))}; got {kind!r}. (Simulated data come "
            "from `nsde_torch.simulation`.)"
        )
    told = {name: options.pop(name) for name in remedies() if name in options}
    if kind == "published" and dt is not None:
        options["dt"] = dt
    if not path:
        raise ConfigError(f"`path` is empty; data of kind {kind!r} need the path of a file or folder.")
    try:
        raw = READERS[kind](system, path=path, **options)
    except TypeError as error:
        if "unexpected keyword" in str(error):
            raise ConfigError(f"data of kind {kind!r}: {error}.") from error
        raise
    for name in [name for name in told if remedies()[name].remedy_first]:
        values = told.pop(name) or {}
        for run in raw if values else ():
            remedies()[name].undo_raw(run, system, values)
    return assemble(raw, system, kind=kind, dt=dt, gap=gap, clock=clock, **told)
