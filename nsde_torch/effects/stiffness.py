"""Springs on one coordinate; q is its position.

A spring that hardens or softens adds a cube (Duffing, Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz,
1918).
"""

from typing import final

from torch import Tensor

from nsde_torch.effects.base import Parameter
from nsde_torch.effects.law import Law


@final
class LinearSpring(Law):
    """A spring to the origin."""

    name = "linear_spring"
    reads_position = True
    kinds = ("rail", "joint")
    formula = "-k q"
    source = "supplement B: m q'' = -b q' - k q"
    PARAMETERS = {"stiffness": Parameter(1.0, "force/position", low=0.0, help="spring constant")}
    along = "position"
    null = {"stiffness": 0.0}
    amplitudes = ("stiffness",)
    sentence = "A spring pulls {it} to the origin with {stiffness}."
    separate = "push at several amplitudes"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        return -self.value("stiffness") * self.q(x)


@final
class CubicStiffness(Law):
    """A spring that hardens (or softens) with its extension."""

    name = "cubic_stiffness"
    reads_position = True
    kinds = ("rail", "joint")
    formula = "-k q^3"
    source = "Duffing (1918)"
    PARAMETERS = {"stiffness": Parameter(0.0, "force/position3", scale=1.0, help="cubic constant")}
    along = "position"
    null = {"stiffness": 0.0}
    amplitudes = ("stiffness",)
    sentence = "A spring against {it} changes with extension: a force of {stiffness} times the cube of it."
    separate = "push at several amplitudes, far beyond the usual ones"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        q = self.q(x)
        return -self.value("stiffness") * q * q * q
