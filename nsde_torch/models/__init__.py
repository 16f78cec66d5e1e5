"""Models that predict trajectories with intervals."""

from nsde_torch.models.neural_sde import ModelSpec, NeuralSDE

__all__ = ["ModelSpec", "NeuralSDE"]
