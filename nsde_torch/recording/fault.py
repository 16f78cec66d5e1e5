"""What a fault of a recording chain is: how it is put into simulated runs, found in a log, and taken out of one.

A log is asked for one fault after another, each at a significance level of the fallback procedure,

    level_k = alpha / K + (level_{k-1} where stage k - 1 found something, else 0)

for the K stages of a diagnosis. Whatever is missing, the chance that any stage finds what is not there is at most
alpha: a stage that finds nothing has spent its share, one that finds something hands its level on (Wiens,
Pharmaceutical Statistics 2 (2003)). It finds all that Bonferroni's correction over the stages finds, and may find more.

The command line reads the options of all faults for its keys, and `--help` has no need of arrays: this file and
`faults` import numpy, and all that needs it, inside their functions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from numpy.random import Generator

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.run import DataSet, Run
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.latency import Latency

STAGES = ("clock", "lateness", "biases", "effects", "structure")
"""In order. The first three are faults of the recording chain, `structure` the tests of the residuals."""
NATS = 3.0  # by how much a log has to be likelier with a fault undone


def level(stage: str, alpha: float, found: Collection[str] = ()) -> float:
    """Significance level of a stage, which p values corrected within the stage are compared with.

    `alpha` is the chance that any stage finds something where nothing is there, `found` the stages that found some.
    """
    place = STAGES.index(stage)
    shares = 1
    while shares <= place and STAGES[place - shares] in found:
        shares += 1
    return alpha * shares / len(STAGES)


@dataclass(frozen=True)
class Detected:
    """Something that the recording chain did."""

    name: str  # of the fault (a key of `FAULTS`)
    values: Mapping[str, tuple[float, float | None, float | None, str]]
    """By parameter: value, low, high (90 %; None where there is no interval), unit."""
    p: float | None  # chance of it in a sound log; None where it is not a test of chance
    sentence: str
    short: bool = False
    """Whether it is shorter than a step, or was undone by the reader, and so not called a finding."""
    ties: tuple[str, ...] = ()  # other faults that no data of the log distinguish from it
    experiment: str = ""  # what would distinguish them
    clock: float = 1.0  # physical seconds for each logged second, which is undone by counting with it
    reason: str = ""  # why it is not called a finding, where `short` has another one than its length

    @property
    def plain(self) -> dict[str, float]:
        """The values alone, as `Fault.undo` takes them."""
        return {name: value for name, (value, *_) in self.values.items()}


@dataclass(eq=False)
class LoggedRuns:
    """Runs of a log, from which fault after fault is taken out."""

    data: DataSet  # where the runs are from; it knows what the reader made of the clock
    runs: Sequence[Run]  # those to look at, without what was taken out
    system: SystemInfo  # names of the states
    _: KW_ONLY
    alpha: float  # chance that any stage of a diagnosis finds something in a sound log (`level`)
    misfit: Callable[[Sequence[Run], float], float]
    """Negative log likelihood per row [nats] of the declared physics in runs, at a clock."""

    def __post_init__(self) -> None:
        self.clock = 1.0  # physical seconds for each logged second, as far as it is known
        self._found = set[str]()

    @cached_property
    def late(self) -> tuple[list[Latency], list[Latency]]:
        """How late channels are in the log as it was when this was first asked, and those that surely are."""
        from nsde_torch.recording.latency import late_channels, surely_late

        late = late_channels(self.system, self.runs, clock=self.clock)
        return late, surely_late(late, self.runs[0].dt, chance=self.level("lateness"))

    def level(self, stage: str) -> float:
        """Significance level of a stage, after what was taken out so far."""
        return level(stage, self.alpha, self._found)

    def misfit_with(self, fault: Fault, values: Mapping[str, float]) -> float:
        """What the declared physics says of the runs with a fault undone [nats per row]."""
        return self.misfit(self._without(fault, values), self.clock)

    def take_out(self, fault: Fault, found: Detected) -> None:
        """Undo a fault that was found."""
        self.runs = self._without(fault, found.plain)
        self.clock *= found.clock
        self._found |= {fault.stage}

    def _without(self, fault: Fault, values: Mapping[str, float]) -> Sequence[Run]:
        return [fault.undo(run, self.system, values) for run in self.runs] if values else self.runs


class Fault(ABC):
    """One kind of fault.

    What it does to a run (`simulate`) it must say; what cannot be found, or not undone, is left as it is here.
    """

    name: ClassVar[str]  # its name in options (`recording.NAME`), findings and truths
    rank: ClassVar[int]  # its place in the chain: faults act, and are looked for and undone, in this order
    stage: ClassVar[str] = ""
    """The stage whose significance level it is tested at (one of `STAGES`); empty where no p value decides."""
    option: ClassVar[Any]
    """Its size in a simulation, declared by `nsde_torch.options.key`; the default is that there is none of it."""
    annotation: ClassVar[Any] = float  # type of the size
    truth: ClassVar[str] = ""  # its name in the truth of a simulation, with its unit; empty: `name`
    remedy: ClassVar[Any] = None
    """The option of a reader that takes it out, declared by `key`, by name of a state; None: a reader cannot."""
    remedy_first: ClassVar[bool] = False  # whether a reader takes it out before it looks at anything
    remedy_smooths: ClassVar[bool] = False
    """Whether taking it out smooths states, after which no smoother of the log can be identified."""
    mixes_times: ClassVar[bool] = False  # whether a row of the log depends on other rows than its own

    # simulated

    def present(self, value: Any) -> bool:
        """Whether a size is more than none."""
        if isinstance(value, Mapping):
            return any(value.values())
        return any(value) if isinstance(value, Sequence) else value != self.option.default

    def check(self, value: Any, system: SystemInfo) -> None:
        """Refuse a size that this system cannot have, by a ConfigError; the range of `option` has been checked."""
        return

    def rows_before(self, value: Any, dt: float) -> int:
        """Rows of the past that the first row of the log needs, at a step `dt` [s] of the log."""
        return 0

    @abstractmethod
    def simulate(self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: Generator) -> None:
        """Do to a run what a fault of this size does, at a step of the log [s].

        It is as the chain before left it; its arrays are replaced, not written into.
        """

    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """The fault as it was applied, for the truth of a simulation, with units in the keys."""
        some = {k: v for k, v in value.items() if v} if isinstance(value, Mapping) else value
        return {self.truth or self.name: some}

    # in a log

    def detect(self, log: LoggedRuns) -> Detected | None:
        """What the log shows of the fault without any dynamics, faults of lower rank undone; None: nothing."""
        return None

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        """A run without the fault, of sizes as `detect` finds them or a user gives them; itself if nothing can be done.

        A ConfigError where there is no such name, or no such size.
        """
        return run

    def undo_raw(self, run: RawRun, system: SystemInfo, values: Mapping[str, float]) -> None:
        """Take the fault out of a run that nothing has looked at yet (`remedy_first`); its arrays are replaced.

        Errors are those of `undo`.
        """
        raise NotImplementedError
