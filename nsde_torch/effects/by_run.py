"""What differs from run to run of a log: a parameter, the mass, a steady force, the zero of a sensor.

Each has numbers for the runs of the log that it was found in, and reads the number of the run from the column `run`; of
any other run it knows nothing, and does nothing. `RunDifference` changes a parameter of the machine or of an effect,

    theta_r = theta + d_r;      of the mass: gains and forces that are over the mass, divided by 1 + d_r

in all runs but the first, which is the reference: the data show differences alone. The others are effects of the
catalogue with a size for each run.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port, Size
from nsde_torch.effects.forces import AddedInertia, PositionBias
from nsde_torch.effects.multirotor_forces import ConstantWorldForce
from nsde_torch.effects.steady import ConstantForce, PeriodicForce

RUN = "run"
"""Column with the number of the run, 0 of the reference."""
MASS = "mass"
"""Target of a difference of the mass."""
_NAME = re.compile(r"run_difference\[(.+)\]")
Values = Mapping[str, float | list[float]]


class ByRun(Effect):
    """An effect with numbers for each run: of component j, those of all runs beside one another.

    They are the first of its parameters; others are the same in all runs.
    """

    exogenous = (RUN,)
    width: ClassVar[int] = 1  # numbers for each run
    first: ClassVar[int] = 0  # number of the first run that has some

    def __init__(self, values: Values | None = None, *, n_inputs: int = 1) -> None:
        key = self.numbers()
        given = (values or {}).get(key)
        count = len(given) if isinstance(given, (list, tuple)) else self.width
        spec = replace(self.PARAMETERS[key], initial=(0.0,) * max(count, 1))
        self.PARAMETERS = {**self.PARAMETERS, key: spec}  # type: ignore[misc]
        self.runs: tuple[str, ...] = ()  # names of the runs by their number; empty where nobody said
        super().__init__(values, n_inputs=n_inputs)
        self.drawn: Tensor | None = None
        """Numbers of each row (N, width), of runs that nobody has seen; None: those of the run that it is of."""

    @classmethod
    def numbers(cls) -> str:
        """Name of the parameter with numbers for each run."""
        return next(iter(cls.PARAMETERS))

    @property
    def reference(self) -> str:
        """Name of the run that others are held against; empty where each has numbers, or nobody said."""
        return self.runs[0] if self.first and self.runs else ""

    def run_of(self, index: int) -> str:
        """Name of the run that a number is of, by its place; empty where nobody said."""
        each = len(self.runs) - self.first
        return self.runs[self.first + index % each] if self.runs else ""

    def of_run(self, u: Tensor) -> Tensor:
        """The numbers of the run of each row (N, width), from `u` of `forward`; 0 of a run that it does not know."""
        if self.drawn is not None:
            return self.drawn
        each, run = self.value(self.numbers()), self.channel(RUN, u)
        table = each.reshape(*each.shape[:-1], self.width, -1)
        numbers = torch.arange(self.first, self.first + table.shape[-1], dtype=run.dtype, device=run.device)
        own = (run == numbers).to(each.dtype)
        return own @ table.T if table.dim() == 2 else (table * own[:, None]).sum(-1)


class RunForce(ByRun, ConstantForce):
    """A force that is steady in each run and differs between runs."""

    formula = "c_r in run r"
    source = "slope of a track, trim or bias of an actuator that was set anew"
    includes = ("constant_force",)
    sentence = "A steady force acts on {it} that differs between runs: {acceleration}."
    separate = "leave it alone, at rest, in each of the places where it was recorded"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.of_run(u)


class RunZero(ByRun, PositionBias):
    """The sensor of a position reads too much, by another amount in each run."""

    formula = "q - b_r in run r, for all that depends on q"
    source = "zero of an encoder that counts from where it was switched on"
    includes = ("position_bias",)
    sentence = "The zero of the position of {it} differs between runs: it reads {bias} too much."
    separate = "let it hang at rest at the start of each run: what is read there is the bias"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.of_run(u)


class RunWorldForce(ByRun, ConstantWorldForce):
    """A force of the world that is steady in each run and differs between runs: wind of another day."""

    width = 3
    formula = "c_r in run r"
    source = "wind of another day, a cable"
    includes = ("constant_world_force",)
    sentence = "A steady force of the world differs between runs: {acceleration} (to east, to north, up)."
    separate = "hover with the nose in several directions in each run"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.of_run(u)


class RunInertia(ByRun, AddedInertia):
    """What moves is heavier or longer in a run than in the first one: a load that was added or taken off.

    Of a machine whose parameters are all over its inertia, that of the first run is part of them: with a share of its
    own there, data showed none of the shares of a knee whose leg differed (tests/diagnosis/test_between_runs.py).
    """

    first = 1
    formula = "-s_r v' in run r, of the acceleration that all else makes"
    source = "another load"
    includes = ("added_inertia",)
    sentence = (
        "{it} accelerates by a share of {share} less than in the run that it is held against (below 0: more): another "
        "load moves with it."
    )
    separate = "weigh what moves in each run, or let it oscillate freely"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.of_run(u)


class RunPeriodicForce(ByRun, PeriodicForce):
    """A force that oscillates with the same frequency in each run and begins each with a phase of its own.

    A candidate like any other where runs have numbers: a wave of each run is seen in every part of it.
    """

    width = 2
    formula = "a_r sin(2 pi f t) + b_r cos(2 pi f t) in run r"
    source = "imbalance of a part that turns before a recording begins"
    PARAMETERS = {
        "waves": Parameter(0.0, "force", scale=0.1, help="sine, then cosine, in each run"),
        "frequency": PeriodicForce.frequency,
    }
    amplitudes = ("waves",)
    includes = ("periodic_force",)
    sentence = (
        "A force on {it} oscillates with {frequency}, whatever the machine does, with a phase of its own in each run "
        "(sines, then cosines: {waves})."
    )

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        angle = self.angle(t, x).reshape(-1, 1)
        return (self.of_run(u) * torch.cat((torch.sin(angle), torch.cos(angle)), 1)).sum(1, keepdim=True)


class RunDifference(ByRun):
    """A parameter that differs between runs."""

    target: ClassVar[str] = ""
    """`name` of the machine's own parameter, `effect/name` of an effect's, or `MASS`."""
    first = 1
    port = Port.PARAMETER
    formula = "theta + d_r in run r"
    source = "another load, battery, spring or propeller"
    change = Size(0.0, "1", scale=0.1, help="in each run but the reference, against that")
    separate = "record a run of each kind again, in another order"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """The change (N, width); of the mass, relative."""
        return self.of_run(u)


OF_ALL_RUNS: tuple[type[ByRun], ...] = (RunForce, RunZero, RunWorldForce)
_CLASSES: tuple[type[ByRun], ...] = (*OF_ALL_RUNS, RunInertia)
BY_RUN: dict[str, type[Effect]] = {cls.name: cls for cls in _CLASSES}
"""Effects with a size for each run: no candidates of a search, which leaves whole runs out."""
OF_EACH_RUN = {cls.includes[0]: cls.name for cls in OF_ALL_RUNS}
"""The effect with a size for each run, by that with one for all."""


def difference_name(target: str) -> str:
    """Name of the effect that a parameter differs between runs."""
    return f"run_difference[{target}]"


def target_of(name: str) -> str:
    """The target of an effect of this name; empty if it is no difference."""
    found = _NAME.fullmatch(name)
    return found[1] if found else ""


@cache
def difference_class(target: str, width: int = 1, unit: str = "1", scale: float = 0.1) -> type[RunDifference]:
    """The effect that a parameter of so many numbers differs between runs; see `RunDifference.target`."""
    effect, _, own = target.rpartition("/")
    what = "The mass" if target == MASS else f"{own} of {effect}" if effect else target
    own_values: dict[str, Any] = {
        "__module__": __name__,
        "__qualname__": difference_name(target),
        "__doc__": RunDifference.__doc__,
        "name": difference_name(target),
        "target": target,
        "width": width,
        "PARAMETERS": {"change": replace(RunDifference.PARAMETERS["change"], unit=unit, scale=scale)},
        "sentence": f"{what} differs between runs by {{change}}.",
    }
    return type(difference_name(target), (RunDifference,), own_values)
