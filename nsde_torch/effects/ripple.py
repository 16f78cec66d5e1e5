"""Forces that repeat with the position of one coordinate: the teeth of a motor, an axis out of balance.

(Proca, Keyhani, El-Antably, Lu, Dai, "Analytical model for permanent magnet motors with surface mounted magnets", IEEE
Transactions on Energy Conversion 18, 2003, for the cogging torque as a series in the angle of the rotor.)
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Parameter
from nsde_torch.effects.law import Law


@final
class Ripple(Law):
    """A force that repeats a number of times a turn."""

    name = "ripple"
    kinds = ("joint", "axis")
    reads_position = True
    formula = "a sin(n q) + b cos(n q)"
    source = "cogging torque, Proca et al., IEEE Transactions on Energy Conversion 18 (2003)"
    PARAMETERS = {
        "sine": Parameter(0.0, "force", scale=0.1, help="part that is nothing at the origin"),
        "cosine": Parameter(0.0, "force", scale=0.1, help="part that is largest at the origin"),
        "order": Parameter(6.0, "1", low=0.5, scale=1.0, help="repeats in a turn"),
    }
    along = "position"
    null = {"sine": 0.0, "cosine": 0.0}
    amplitudes = ("sine", "cosine")
    shapes = {"order": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 24.0)}
    sentence = "A force on {it} repeats {order} times a turn (sine {sine}, cosine {cosine})."
    separate = "turn slowly through the whole range, to and fro"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        angle = self.value("order") * self.q(x)
        return self.value("sine") * torch.sin(angle) + self.value("cosine") * torch.cos(angle)
