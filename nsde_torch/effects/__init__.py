"""The catalogue of effects: physical terms that a system can be given by name.

An effect of your own is a class in a file of yours, named `module:Class` wherever a name of the catalogue can stand
(`system.effects=[my_effects:Cogging]`, `plant.effects=[...]`):

    class Cogging(Effect):
        name = "cogging"
        port = Port.FORCE
        formula = "-c sin(2 pi q / p)"
        source = "teeth of a linear motor"
        PARAMETERS = {"size": Parameter(0.0, "m/s2", scale=0.1, help="largest force over mass"),
                      "pitch": Parameter(0.05, "m", low=0.0, help="distance of the teeth")}
        null, amplitudes, shapes = {"size": 0.0}, ("size",), {"pitch": (0.02, 0.05, 0.1)}

        def forward(self, t, x, u, memory):
            return -self.value("size") * torch.sin(2 * torch.pi * x[:, :1] / self.value("pitch"))

`nsde diagnose also=[my_effects:Cogging]` tries it beside the catalogue: fits start from `null` at every point of the
grid `shapes`, and `amplitudes` are what is nothing without it.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.effects.base import Effect, Parameter, Parametrised, Port
    from nsde_torch.effects.registry import EFFECTS, effect_class, effects_of, key_of, make_effect, register

__all__ = [
    "EFFECTS",
    "Effect",
    "Parameter",
    "Parametrised",
    "Port",
    "effect_class",
    "effects_of",
    "key_of",
    "make_effect",
    "register",
]

__getattr__ = resolver(
    __name__,
    {
        "EFFECTS": "registry",
        "Effect": "base",
        "Parameter": "base",
        "Parametrised": "base",
        "Port": "base",
        "effect_class": "registry",
        "effects_of": "registry",
        "key_of": "registry",
        "make_effect": "registry",
        "register": "registry",
    },
)
