"""What lies behind an environment: a batch of machines, true or learned, that are pushed a sample at a time."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor


class Dynamics(ABC):
    """A batch of machines. What a path carries beside its state (memory, disturbance) stays in here.

    Attributes:
        name: For tables and files.
    """

    name: str

    @property
    @abstractmethod
    def state(self) -> Tensor:
        """True states (N, nx), whatever the sensors say."""

    @abstractmethod
    def reset(self, x0: Tensor) -> Tensor:
        """Start N machines at rest in the states (N, nx); returns them as measured."""

    @abstractmethod
    def restart(self, rows: Tensor, x0: Tensor) -> Tensor:
        """Start some of the machines anew.

        Args:
            rows: Indices (K,).
            x0: Their states (K, nx).

        Returns:
            These states as measured (K, nx).
        """

    @abstractmethod
    def step(self, u: Tensor) -> Tensor:
        """Advance all machines by one sample under the inputs (N, nu), which act as given; returns measured states."""
