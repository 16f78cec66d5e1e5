"""The controller as a file for the flight computer."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.export.exported import ExportedController
    from nsde_torch.export.write import export

__all__ = names(__name__)

__getattr__ = resolver(__name__)
