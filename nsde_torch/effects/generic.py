"""Effects that any system with a `force` port can have; v is the velocity that the force acts on.

A force is mass-normalised: it adds to the acceleration of the first degree of freedom.
"""

from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port


class _OneDof(Effect):
    """An effect on the `force` port of a system whose state is (position, velocity, ...)."""

    port = Port.FORCE


@final
class LinearSpring(_OneDof):
    """A spring to the origin."""

    name = "linear_spring"
    formula = "-k q"
    source = "supplement B: m q'' = -b q' - k q"
    PARAMETERS = {"stiffness": Parameter(1.0, "1/s2", low=0.0, help="spring constant over mass")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("stiffness") * x[:, :1]


@final
class ViscousFriction(_OneDof):
    """Friction in proportion to velocity."""

    name = "viscous_friction"
    formula = "-b v"
    source = "supplement B: m q'' = -b q' - k q"
    PARAMETERS = {"damping": Parameter(0.3, "1/s", low=0.0, help="damping over mass")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("damping") * x[:, 1:2]


@final
class CoulombFriction(_OneDof):
    """Dry friction of constant size against the motion, smoothed at rest."""

    name = "coulomb_friction"
    formula = "-c tanh(v / v0)"
    source = "Armstrong-Helouvry, Dupont, Canudas de Wit, Automatica 30 (1994)"
    PARAMETERS = {
        "size": Parameter(0.1, "m/s2", low=0.0, help="friction force over mass"),
        "width": Parameter(0.01, "m/s", low=0.0, help="speed at which it is 76 % developed"),
    }

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return -self.value("size") * torch.tanh(x[:, 1:2] / self.value("width"))


@final
class ConstantForce(_OneDof):
    """A force that never changes."""

    name = "constant_force"
    formula = "c"
    source = "bias of an actuator or a slope"
    PARAMETERS = {"acceleration": Parameter(0.0, "m/s2", scale=0.1, help="force over mass")}

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return self.value("acceleration").expand(x.shape[0], 1)
