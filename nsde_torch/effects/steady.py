"""Forces that do not depend on how a machine moves: constant ones, and those that swing with the clock."""

from math import pi

import torch
from torch import Tensor

from nsde_torch.effects.base import Parameter, Size, elapsed
from nsde_torch.effects.law import Law


class ConstantForce(Law):
    """A force that never changes."""

    formula = "c"
    source = "bias of an actuator or a slope"
    acceleration = Size(0.0, "force", scale=0.1, help="force (over mass, where forces are)")
    sentence = "A force that never changes acts on {it}, with {acceleration}."
    separate = "leave it alone, at rest, in several places"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.acceleration.expand(x.shape[0], 1)


class PeriodicForce(Law):
    """A force that oscillates with the clock of the log, as an unbalanced rotor's."""

    formula = "a sin(2 pi f t) + b cos(2 pi f t)"
    source = "imbalance of a rotating part; den Hartog, Mechanical Vibrations (1934)"
    sine = Size(0.0, "force", scale=0.1, help="part in phase with the clock")
    cosine = Size(0.0, "force", scale=0.1, help="part a quarter ahead of it")
    frequency = Parameter(1.0, "Hz", low=0.0, scale=0.1, help="oscillations per second")
    shapes = {"frequency": ()}
    relative = {"frequency": "spectrum"}
    sentence = "A force on {it} swings {frequency}, whatever the machine does (sine {sine}, cosine {cosine})."
    separate = "record without input: what swings on with the clock is not the machine"

    def angle(self, t: float | Tensor, x: Tensor) -> Tensor:
        """Angle at a time [rad], in the precision of states; turns in that of the clock: a log may start at 1e9 s."""
        return (2.0 * pi * torch.remainder(self.frequency * elapsed(t, x), 1.0)).to(x.dtype)

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        angle = self.angle(t, x)
        term = self.sine * torch.sin(angle) + self.cosine * torch.cos(angle)
        return term.reshape(-1, 1).expand(x.shape[0], 1)
