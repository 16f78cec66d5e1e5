"""Springs on the port `force`; q is the position that the force acts along, all terms are over mass.

A spring that hardens or softens adds a cube (Duffing, Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz,
1918).
"""

from typing import final

from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port


@final
class LinearSpring(Effect):
    """A spring to the origin."""

    name = "linear_spring"
    port = Port.FORCE
    formula = "-k q"
    source = "supplement B: m q'' = -b q' - k q"
    PARAMETERS = {"stiffness": Parameter(1.0, "1/s2", low=0.0, help="spring constant over mass")}
    along = "position"
    null = {"stiffness": 0.0}
    amplitudes = ("stiffness",)
    sentence = "A spring pulls to the origin with {stiffness} over mass."
    separate = "push at several amplitudes"

    @classmethod
    def candidate(cls, system: str) -> bool:
        """Never: a spring is declared where there is one."""
        return False

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("stiffness") * x[:, :1]


@final
class CubicStiffness(Effect):
    """A spring that hardens (or softens) with its extension."""

    name = "cubic_stiffness"
    port = Port.FORCE
    formula = "-k q^3"
    source = "Duffing (1918)"
    PARAMETERS = {"stiffness": Parameter(0.0, "1/(m2 s2)", scale=1.0, help="cubic constant over mass")}
    along = "position"
    null = {"stiffness": 0.0}
    amplitudes = ("stiffness",)
    sentence = "The stiffness changes with extension: a force of {stiffness} over mass times the cube of it."
    separate = "push at several amplitudes, far beyond the usual ones"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        q = x[:, :1]
        return -self.value("stiffness") * q * q * q
