"""Settings of the design of an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nsde_torch.errors import ConfigError
from nsde_torch.options import check, documented, key


@documented
@dataclass(frozen=True)
class DesignOptions:
    """Settings of the design of an experiment."""

    members: tuple[tuple[str, ...], ...] | None = key(
        None,
        "what may be true, each a list of effects beside the declared physics: [[coulomb_friction,constant_force],"
        "[asymmetric_friction]]; null: the first tie of the diagnosis",
    )
    parameters: tuple[str, ...] | None = key(
        None,
        "parameters to show, `effect.parameter` or `name` of the declared physics; null: where nothing is tied, those "
        "that the diagnosis does not show",
    )
    duration: float | None = key(
        None, "length of the experiment; null: that of the longest run", unit="s", above=0
    )
    limits: Mapping[str, Any] = key(
        {},
        "lowest and highest value of inputs and states, {force: [-1, 1], q: [-0.5, 0.5]}; what is not named stays "
        "within what the runs held",
    )
    hertz: tuple[float, float] | None = key(
        None,
        "lowest and highest frequency of the inputs; null: once in the experiment to 0.2 a step",
        unit="Hz",
    )
    start: Mapping[str, float] = key(
        {}, "first values of states; what is not named: at rest where the runs started (median)"
    )
    samples: int = key(
        5, "sets of parameters, drawn as the data leave them open, that inputs are judged at", low=1
    )
    proposals: int | None = key(
        None, "inputs that are judged together; null: 120, of multirotors, which fly slower, 48", low=4
    )
    generations: int | None = key(
        None, "rounds of proposals, each near the best of the last; null: 12, of multirotors 6", low=0
    )
    rehearsals: int = key(8, "simulated experiments of each member, fitted as measured ones are", low=2)
    seed: int = key(0, "seed of proposals, parameters and noise", low=0)

    def __post_init__(self) -> None:
        check(type(self), vars(self))
        if self.members is not None and (len(self.members) < 2 or len(set(self.members)) < len(self.members)):
            raise ConfigError(
                f"`members` takes two or more different lists of effects; got {[list(m) for m in self.members]}."
            )
        if self.members is not None and self.parameters is not None:
            raise ConfigError("`members` and `parameters` are two questions; ask one.")
        if self.hertz is not None and not 0 < self.hertz[0] < self.hertz[1]:
            raise ConfigError(f"`hertz` must be two rising frequencies above 0 Hz; got {list(self.hertz)}.")
