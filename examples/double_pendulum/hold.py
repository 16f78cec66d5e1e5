"""A controller for `nsde simulate ... options.controller=hold:hold`: both joints are held near where they hang."""

from torch import Tensor


def hold(t: float, x: Tensor) -> Tensor:
    """Torques (runs, 2) [N m] at a time [s], from the measured states (runs, 4)."""
    return -1.0 * x[:, :2] - 0.05 * x[:, 2:]
