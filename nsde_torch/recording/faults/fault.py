"""What a fault of a recording chain is: how it is put into simulated runs, found in a log, and taken out of one.

Files of this folder import numpy and all that needs it inside their functions: the command line reads the options of
all faults for its keys, and `--help` has no need of arrays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    import numpy as np

    from nsde_torch.data.raw import RawRun
    from nsde_torch.data.run import Run
    from nsde_torch.data.system_info import SystemInfo
    from nsde_torch.recording.log import Detected, LoggedRuns, Misfits, Recorded, Suspect


class Fault(ABC):
    """One kind of fault.

    What it does to a run (`simulate`) it must say; what cannot be found, or not undone, is left as it is here.

    Attributes:
        name: Its name in options (`recording.NAME`), findings and truths.
        rank: Its place in the chain: faults act, and are looked for and undone, in this order.
        stage: The stage whose significance level it is tested at (`recording.levels.STAGES`); empty where no p value
            decides.
        option: Its size in a simulation, declared by `nsde_torch.options.key`; the default is that there is none of it.
        annotation: Type of the size.
        remedy: The option of a reader that takes it out, declared by `key`, by name of a state; None: a reader cannot.
        remedy_first: Whether a reader takes it out before it looks at anything.
        remedy_smooths: Whether taking it out smooths states, after which no smoother of the log can be told.
        mixes_times: Whether a row of the log depends on other rows than its own.
    """

    name: ClassVar[str]
    rank: ClassVar[int]
    stage: ClassVar[str] = ""
    option: ClassVar[Any]
    annotation: ClassVar[Any] = float
    remedy: ClassVar[Any] = None
    remedy_first: ClassVar[bool] = False
    remedy_smooths: ClassVar[bool] = False
    mixes_times: ClassVar[bool] = False

    # simulated

    def present(self, value: Any) -> bool:
        """Whether a size is more than none."""
        if isinstance(value, Mapping):
            return any(value.values())
        return any(value) if isinstance(value, Sequence) else value != self.option.default

    def check(self, value: Any, system: SystemInfo) -> None:
        """Refuse a size that this system cannot have; the range of `option` has been checked.

        Raises:
            ConfigError: names the option, what it takes and what it was given.
        """
        return

    def rows_before(self, value: Any, dt: float) -> int:
        """Rows of the past that the first row of the log needs, at a step `dt` [s] of the log."""
        return 0

    def clock(self, value: Any) -> float:
        """Physical seconds for each logged second."""
        return 1.0

    @abstractmethod
    def simulate(
        self, run: RawRun, value: Any, system: SystemInfo, *, dt: float, rng: np.random.Generator
    ) -> None:
        """Do to a run what the fault does.

        Args:
            run: As the chain before this fault left it; its arrays are replaced, not written into.
            value: The size.
            system: Names of the states.
            dt: Step of the log [s].
            rng: Source of randomness.
        """

    @abstractmethod
    def describe(self, value: Any, *, dt: float) -> dict[str, Any]:
        """The fault as it was applied, for the truth of a simulation, with units in the keys.

        Args:
            value: The size, more than none.
            dt: Step of the log [s].
        """

    # in a log

    def detect(self, log: LoggedRuns) -> Detected | None:
        """What the log shows of the fault without any dynamics, faults of lower rank undone; None: nothing."""
        return None

    def suspects(self, log: LoggedRuns) -> list[Suspect]:
        """What the log may hold, and the declared physics has to say; asked once all faults were looked for."""
        return []

    def instead_of_effects(
        self, found: Recorded, system: SystemInfo, misfits: Misfits, *, rows: int, other: float
    ) -> Recorded | None:
        """The log with this fault undone where that explains what effects do not; None where it does not.

        Args:
            found: The recording chain, undone as far as it is known.
            system: Names of the states.
            misfits: Negative log likelihood per row [nats] of the declared physics in runs, by channel.
            rows: Number of rows.
            other: The misfit of physics with effects, all channels together.
        """
        return None

    def undo(self, run: Run, system: SystemInfo, values: Mapping[str, float]) -> Run:
        """A run without the fault; the run itself where nothing can be done.

        Args:
            run: The run as it was logged.
            system: Names of the states.
            values: Sizes by name, as `detect` finds them or a user gives them.

        Raises:
            ConfigError: no such name, or no such size.
        """
        return run

    def undo_raw(self, run: RawRun, system: SystemInfo, values: Mapping[str, float]) -> None:
        """Take the fault out of a run that nothing has looked at yet (`remedy_first`); its arrays are replaced.

        Raises:
            ConfigError: no such name, or no such size.
        """
        raise NotImplementedError
