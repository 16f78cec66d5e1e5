"""Data sets: runs, what reads them from files, splits and windows.

Names are resolved on first use, so that torch loads only for windows and pyulog only for logs.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.data.csv_folder import write_csv
    from nsde_torch.data.published import read_pickle
    from nsde_torch.data.raw import Finding, RawRun
    from nsde_torch.data.readers import READERS, Reader
    from nsde_torch.data.run import DataSet, Run, Split, split
    from nsde_torch.data.summary import DataSummary
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.data.windows import Windows

__all__ = names(__name__)

__getattr__ = resolver(__name__)
