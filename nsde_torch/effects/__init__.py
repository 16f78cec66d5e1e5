"""The catalogue of effects: physical terms that a system can be given by name.

An effect of your own is a class in a file of yours, named `module:Class` wherever a name of the catalogue can stand
(`system.effects=[my_effects:Cogging]`, `plant.effects=[...]`):

    class Cogging(Law):
        reads_position = True
        formula = "-c sin(2 pi q / p)"
        source = "teeth of a linear motor"
        size = Size(0.0, "force", scale=0.1, help="largest force")
        pitch = Parameter(0.05, "position", low=0.0, help="distance of the teeth")
        shapes = {"pitch": (0.02, 0.05, 0.1)}
        sentence = "The teeth hold {it} with up to {size} every {pitch}."

        def term(self, t, x, u, memory):
            return -self.size * torch.sin(2 * torch.pi * self.q(x) / self.pitch)

It is a law of one coordinate, and so an effect on every coordinate of a machine: `my_effects:Cogging[q2]`. A term that
is no such law derives from `Effect` and has a `port` and `forward`.

`nsde diagnose also=[my_effects:Cogging]` tries it beside the catalogue: fits start without it, where each `Size` is 0
(or from `null`, where it says that), at every point of the grid `shapes`.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.effects.base import Effect, Parameter, Parametrised, Port, Size
    from nsde_torch.effects.coordinates import Coordinate
    from nsde_torch.effects.law import Law
    from nsde_torch.effects.registry import (
        EFFECTS,
        canonical_name,
        effect_class,
        effects_of,
        key_of,
        make_effect,
        register,
    )

__all__ = names(__name__)

__getattr__ = resolver(__name__)
