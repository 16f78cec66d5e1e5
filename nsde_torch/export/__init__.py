"""The controller as a file for the flight computer."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.export.exported import ExportedController
    from nsde_torch.export.write import export

__all__ = [
    "ExportedController",
    "export",
]

__getattr__ = resolver(__name__)
