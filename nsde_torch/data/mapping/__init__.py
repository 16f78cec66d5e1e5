"""What the columns of logs mean to a system: a mapping, its proposal, its checks, and runs through it."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.data.mapping.checks import LogCheck
    from nsde_torch.data.mapping.mapping import ColumnEntry, LogMapping, read_mapping
    from nsde_torch.data.mapping.proposal import Proposal

__all__ = ["ColumnEntry", "LogCheck", "LogMapping", "Proposal", "read_mapping"]

__getattr__ = resolver(__name__)
