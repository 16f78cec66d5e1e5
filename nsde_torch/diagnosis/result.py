"""The result of a diagnosis: what was found, with values, as Python reads it."""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from nsde_torch.data import DataSet
from nsde_torch.diagnosis import content as contents
from nsde_torch.diagnosis.buys import Bought, Told, bought, told
from nsde_torch.diagnosis.cross_validation import HeldOut
from nsde_torch.diagnosis.explanation import Explanation
from nsde_torch.diagnosis.fitted import effect_of, values_of
from nsde_torch.diagnosis.not_done import NotDone, SoFar, StoppedError
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.text import lines, short_lines
from nsde_torch.diagnosis.views import rates_width
from nsde_torch.effects import effect_class, key_of
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording.chain import Recorded
from nsde_torch.recording.fault import Detected
from nsde_torch.recording.faults import remedies
from nsde_torch.sysid.loop_test import LoopTest
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    system: System  # declared system
    data: DataSet  # the data set
    runs: tuple[str, ...]  # names of its runs that were looked at
    recorded: Recorded  # recording chain, undone
    outcome: Outcome  # effects that were found, and the tests of what is left
    errors: HeldOut  # errors on runs left out
    explanation: Explanation  # what is left, and what may explain it
    options: Options  # settings
    spec: SysidSpec  # what models of the system are made of
    seconds: dict[str, float] = field(default_factory=dict)  # time that stages took
    feedback: LoopTest = field(default_factory=LoopTest)
    """What the data say of the loop that they were recorded in."""
    instrumented: Identification | None = None
    """Estimates with signals from outside the loop; None without any."""
    not_done: tuple[NotDone, ...] = ()  # stages that could not be computed or were left out
    so_far: SoFar | None = None  # that the diagnosis is not finished; None of one that is

    def finished(self) -> Diagnosis:
        """The diagnosis, for work that goes on with it.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        if self.so_far is not None:
            raise StoppedError(self)
        return self

    @property
    def system_name(self) -> str:
        """Name that makes the system, `module:Class` for one of the user's own."""
        return self.spec.system

    @property
    def verdict(self) -> str:
        """`no_effect`, `effect_found` or `unexplained`; a fault of the recording chain counts as found.

        `undecided` of a diagnosis that was stopped before what is left was tested.
        """
        if self.outcome.verdict == "no_effect" and self.faults:
            return "effect_found"
        return self.outcome.verdict

    @property
    def added(self) -> list[str]:
        """Names of everything that was found, the recording chain first."""
        return [fault.name for fault in self.faults] + [f.name for f in self.outcome.found]

    @property
    def faults(self) -> list[Detected]:
        """Faults of the recording chain that are longer than a step."""
        return [f for f in self.recorded.faults if not f.short]

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Effects that were found, with values: `{name: {parameter: value}}`, `module:Class` for one of the user's own.

        What `effects=` of `nsde_torch.train` and `nsde_torch.simulate` takes.
        """
        return {
            key_of(effect_class(f.name)): dict(values_of(effect_of(self.outcome.system, f.name)))
            for f in self.outcome.found
        }

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of everything that was found (`content.parameters`)."""
        return contents.parameters(self)

    @property
    def declared_values(self) -> dict[str, float | list[float]]:
        """Parameters of the declared physics as they are with what was found."""
        values = {k: v.tolist() for k, (v, _) in self.outcome.system.declared_parameters().items()}
        return {k: v[0] if len(v) == 1 else v for k, v in values.items()}

    @property
    def sensor_faults(self) -> dict[str, dict[str, float]]:
        """What sensors were found to do to the states: arguments of `nsde_torch.read` that undo it."""
        return {name: self.recorded.values(name) for name in remedies()}

    @property
    def buys(self) -> dict[str, Bought]:
        """By effect, those that buy most first: the error on runs left out that returns without it."""
        return bought(self.errors.own, inputs=self.errors.inputs)

    @property
    def told(self) -> Told:
        """The few effects that matter, and the others."""
        names = [f.name for f in self.outcome.found]
        return told(names, self.buys, self.outcome.decisions.wording)

    @property
    def in_short(self) -> str:
        """Names of everything that was found, effects with the evidence for them: `motor_lag (+812 nats)`."""
        brought = {f.name: f" ({f.evidence.nats:+.0f} nats)" for f in self.outcome.found}
        return ", ".join(f"{name}{brought.get(name, '')}" for name in self.added)

    @property
    def width(self) -> float:
        """Length of the means over which residuals are told [s]."""
        return rates_width(self.outcome.final.regression)

    @property
    def report(self) -> str:
        """All that was found, in words and tables, as `nsde diagnose verbose=true` prints it."""
        return "\n".join(lines(self.content()))

    def __str__(self) -> str:
        return "\n".join(short_lines(self.content()))

    def __repr__(self) -> str:
        return (
            f"<Diagnosis of {self.system_name}: {self.verdict}; {', '.join(self.added) or 'nothing added'}>"
        )

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def content(self) -> contents.Content:
        """What `diagnosis.json` holds; its keys are in docs/content/reference/diagnosis-json.md."""
        return contents.content(self)

    def save(self, folder: str | Path) -> Path:
        """Write `diagnosis.json`, `effects.yaml`, `report.html` and `plots/`.

        Args:
            folder: Where to; made where it is missing.

        Returns:
            The page `report.html`.
        """
        from nsde_torch.diagnosis.files import save

        return save(self, folder)
