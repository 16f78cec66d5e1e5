"""Plans and estimators as C: for files that are exported, and for libraries that the controller here calls."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.control.codegen.library import NoCompiler
    from nsde_torch.control.codegen.sources import estimator_library, solver_library

__all__ = ["NoCompiler", "estimator_library", "solver_library"]

__getattr__ = resolver(__name__)
