"""What a user says of a machine: its name, the physics that is declared of it, and constants that are not its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.effects.files import is_file, own_name, read_for
from nsde_torch.options import REQUIRED, check, documented, key
from nsde_torch.systems.values import dotted

if TYPE_CHECKING:
    from nsde_torch.systems.base import System


@documented
@dataclass(frozen=True)
class SystemOptions:
    """A machine by name, with its declared physics. A constant of None is the system's own."""

    name: str = key(REQUIRED, "name of a system of the package, or module:Class of your own")
    effects: tuple[str, ...] = key(
        (),
        "physical terms to add to the declared physics: names, module:Class, or an effects.yaml of nsde diagnose",
        file=True,
    )
    declared: tuple[str, ...] | None = key(
        None, "physical terms instead of the declared ones; null: keep those"
    )
    parameters: dict[str, Any] = key({}, "initial values, system.parameters.NAME=1 or ...EFFECT.NAME=1")
    options: dict[str, Any] = key({}, "further arguments of the system's class, system.options.NAME=1")
    dt: float | None = key(
        None,
        "step of the model; null: the system's own, as the nearest whole multiple of the data's",
        unit="s",
        above=0,
    )
    horizon: int | None = key(None, "steps of a training window; null: the system's own", unit="steps", low=1)
    sigma_max: tuple[float, ...] | None = key(
        None, "largest diffusion, one per state; null: the system's own", unit="state/s^0.5", low=0
    )
    ball_radius: float | None = key(
        None,
        "radius of the ball of the convexity loss; null: the system's own",
        unit="std of the features",
        above=0,
    )
    lambda_mu: float | None = key(
        None, "weight of the reward on strong convexity; null: the system's own", low=0
    )

    def __post_init__(self) -> None:
        check(type(self), vars(self))

    @property
    def values(self) -> dict[str, Any]:
        """Initial values of declared parameters, by `name` or `effect.name`."""
        return dict(dotted(self.parameters))

    def make(self) -> System:
        """The system; a ConfigError where there is no such one, or no such effect, parameter or option."""
        from nsde_torch.systems.registry import make_system

        return make_system(
            self.name, effects=self.effects, declared=self.declared, values=self.values, **self.options
        )


Effects = str | Path | Sequence[str | Path | Mapping[str, Any]] | Mapping[str, Any]
"""Effects as a user may write them (see `system_options`)."""


def system_options(
    system: str | type[System] | SystemOptions,
    *,
    effects: Effects = (),
    declared: Sequence[str] | None = None,
    parameters: Mapping[str, Any] | None = None,
) -> SystemOptions:
    """A machine with its declared physics, from what a user may write.

    A system is a key of `SYSTEMS`, `package.module:Class`, a class that a module of the user's own defines, or options.
    Effects are names, `{name: {parameter: value}}`, files `effects.yaml` of a diagnosis, or a list of these; their
    values are where a training starts from, and `parameters`, by `name` or `effect.name`, win over them. A ConfigError
    refuses a file that cannot be used, or one of another system.
    """
    if isinstance(system, type):
        system = key_of_class(system)
    made = system if isinstance(system, SystemOptions) else SystemOptions(system)
    names = list(made.effects)
    values: dict[str, Any] = {}
    for name, given in _named(effects, made.name):
        names.append(name)
        values |= {f"{own_name(name)}.{k}": v for k, v in given.items()}
    return replace(
        made,
        effects=tuple(dict.fromkeys(names)),
        declared=made.declared if declared is None else tuple(declared),
        parameters={**values, **made.values, **dict(dotted(parameters or {}))},
    )


def _named(effects: Effects, system: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Effects with their values, by the key of the catalogue or `module:Class`."""
    if isinstance(effects, Mapping):
        yield from ((str(name), values or {}) for name, values in effects.items())
    elif isinstance(effects, Path) or (isinstance(effects, str) and is_file(effects)):
        yield from read_for(effects, system).items()
    elif isinstance(effects, str):
        yield effects, {}
    else:
        for item in effects:
            yield from _named(item, system)


def key_of_class(system: type[System]) -> str:
    """What names a system's class in any process: its key in `SYSTEMS`, or `module:Class`."""
    from nsde_torch.systems.registry import SYSTEMS

    known = {cls: name for name, cls in SYSTEMS.items()}
    return known.get(system, f"{system.__module__}:{system.__qualname__}")
