"""Data sets: readers, checks, splits and windows.

Names are resolved on first use, so that torch loads only for windows and pyulog only for logs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsde_torch.data.checks import assemble
    from nsde_torch.data.csv_folder import write_csv
    from nsde_torch.data.findings import Finding
    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.registry import READERS, read
    from nsde_torch.data.run import DataSet, Run
    from nsde_torch.data.splits import Split, split
    from nsde_torch.data.summary import DataSummary
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.data.unpickler import read_pickle
    from nsde_torch.data.windows import Windows

_HOME = {
    "assemble": "checks",
    "write_csv": "csv_folder",
    "Finding": "findings",
    "RawRun": "raw",
    "READERS": "registry",
    "read": "registry",
    "DataSet": "run",
    "Run": "run",
    "Split": "splits",
    "split": "splits",
    "DataSummary": "summary",
    "SystemInfo": "system_info",
    "read_pickle": "unpickler",
    "Windows": "windows",
}

__all__ = [
    "READERS",
    "DataSet",
    "DataSummary",
    "Finding",
    "RawRun",
    "Run",
    "Split",
    "SystemInfo",
    "Windows",
    "assemble",
    "read",
    "read_pickle",
    "split",
    "write_csv",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'nsde_torch.data' has no attribute {name!r}")
    value = getattr(import_module(f"nsde_torch.data.{_HOME[name]}"), name)
    globals()[name] = value
    return value
