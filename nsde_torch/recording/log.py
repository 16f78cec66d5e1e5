"""A log whose recording chain is looked at: what is known of it, what was found, what may be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.run import DataSet, Run
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.recording.faults.fault import Fault
from nsde_torch.recording.faults.registry import FAULTS, in_order
from nsde_torch.recording.lateness import Late, lateness, surely_late
from nsde_torch.recording.levels import level

Misfits: TypeAlias = Callable[[Sequence[Run]], NDArray[np.float64]]
"""Negative log likelihood per row [nats] of the declared physics in runs, by channel."""

LEVEL = 0.9
"""Level of the intervals of findings."""
NATS = 3.0
"""By how much a log has to be likelier with a fault undone."""


@dataclass(frozen=True)
class Detected:
    """Something that the recording chain did.

    Args:
        name: Name of the fault (`nsde_torch.recording.faults.registry.FAULTS`).
        values: By parameter: value, low, high (90 %; None where there is no interval), unit.
        p: Chance of it in a sound log; None where it is not a test of chance.
        sentence: What it means.
        short: Whether it is shorter than a step, or was undone by the reader, and so not called a finding.
        ties: Other faults that no data of the log tell from it.
        experiment: What would tell.
        clock: Physical seconds for each logged second, which is undone by counting with it.
        reason: Why it is not called a finding, where `short` has another one than its length.
    """

    name: str
    values: Mapping[str, tuple[float, float | None, float | None, str]]
    p: float | None
    sentence: str
    short: bool = False
    ties: tuple[str, ...] = ()
    experiment: str = ""
    clock: float = 1.0
    reason: str = ""

    @property
    def plain(self) -> dict[str, float]:
        """The values alone, as `Fault.undo` takes them."""
        return {name: value for name, (value, *_) in self.values.items()}


@dataclass(frozen=True)
class Recorded:
    """Runs with the recording chain undone.

    Args:
        runs: The runs.
        clock: Physical seconds per logged second.
        faults: What was found.
    """

    runs: tuple[Run, ...]
    clock: float
    faults: tuple[Detected, ...]

    @property
    def stages(self) -> frozenset[str]:
        """Stages that found something (`levels.STAGES`)."""
        return frozenset(FAULTS[f.name].stage for f in self.faults)

    @property
    def inputs_restored(self) -> bool:
        """Whether the inputs were averaged in the log, and are restored."""
        return bool(self.values("input_smoothing"))

    @property
    def delays(self) -> dict[str, float]:
        """By how much channels were late, by name of the state or of several [s of the log]."""
        return self.values("sensor_delay")

    @property
    def lags(self) -> dict[str, float]:
        """Time constants of filters that were undone, by name of the state or of several [s of the log]."""
        return self.values("sensor_lag")

    def values(self, name: str) -> dict[str, float]:
        """What was found of a fault, by the names that `Fault.undo` takes."""
        return {k: v for f in self.faults if f.name == name for k, v in f.plain.items()}

    def like(self, run: Run, system: SystemInfo) -> Run:
        """A further run of the same log with the same faults undone."""
        for fault in in_order():
            values = self.values(fault.name)
            run = fault.undo(run, system, values) if values else run
        return run


@dataclass(frozen=True)
class Suspect:
    """A fault that a log may hold, if the declared physics is better for it.

    Args:
        fault: What it is of.
        order: Suspects are asked for by this number.
        found: What is found if physics says so.
        against: Values that would do as well if it were nothing, those of the other direction.
    """

    fault: Fault
    order: int
    found: Detected
    against: Mapping[str, float]


class LoggedRuns:
    """Runs of a log, from which fault after fault is taken out.

    Args:
        data: Where the runs are from; it knows what the reader made of the clock.
        runs: Those to look at.
        system: Names of the states.
        alpha: Chance that any stage of a diagnosis finds something in a sound log (`levels`).
        misfit: Negative log likelihood per row [nats] of the declared physics in runs, at a clock.

    Attributes:
        runs: The runs without what was taken out.
        clock: Physical seconds for each logged second, as far as it is known.
    """

    def __init__(
        self,
        data: DataSet,
        runs: Sequence[Run],
        system: SystemInfo,
        *,
        alpha: float,
        misfit: Callable[[Sequence[Run], float], float],
    ) -> None:
        self.data, self.system = data, system
        self._alpha, self._found = alpha, set[str]()
        self.runs, self.clock = list(runs), 1.0
        self._misfit = misfit

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.system.input_names)

    @cached_property
    def late(self) -> list[Late]:
        """Channels that are late against others, as the log was when this was first asked."""
        return lateness(self.system, self.runs, clock=self.clock)

    @cached_property
    def surely(self) -> list[Late]:
        """Those of them that are surely late, by more than half a step."""
        return surely_late(self.late, self.runs[0].dt, chance=self.level("lateness"))

    def level(self, stage: str) -> float:
        """Significance level of a stage, after what was taken out so far (`levels.level`)."""
        return level(stage, self._alpha, self._found)

    def without(self, fault: Fault, values: Mapping[str, float]) -> list[Run]:
        """The runs with a fault undone."""
        return [fault.undo(run, self.system, values) for run in self.runs] if values else self.runs

    def misfit_with(self, fault: Fault, values: Mapping[str, float]) -> float:
        """What the declared physics says of the runs with a fault undone [nats per row]."""
        return self._misfit(self.without(fault, values), self.clock)

    def take_out(self, fault: Fault, found: Detected) -> None:
        """Undo a fault that was found."""
        self.runs = self.without(fault, found.plain)
        self.clock *= found.clock
        self._found |= {fault.stage}
