"""Learn a controlled stochastic model of a machine from minutes of data, and know where it is ignorant."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsde_torch.models import NeuralSDE
    from nsde_torch.models.run_directory import load

__version__ = "0.1.0"
__all__ = ["NeuralSDE", "__version__", "load"]


def __getattr__(name: str) -> Any:
    if name == "load":
        from nsde_torch.models.run_directory import load

        return load
    if name == "NeuralSDE":
        from nsde_torch.models import NeuralSDE

        return NeuralSDE
    raise AttributeError(f"module 'nsde_torch' has no attribute {name!r}")
