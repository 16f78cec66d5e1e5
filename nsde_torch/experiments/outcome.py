"""What an experiment concludes: pictures, what is claimed, what was measured, and whether it holds."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Check:
    """One claim held against a measurement.

    Args:
        claim: What should be.
        measured: What is, in words.
        passed: Whether the claim holds; None where it was not measured.
    """

    claim: str
    measured: str
    passed: bool | None

    @property
    def word(self) -> str:
        """pass, fail or not measured."""
        return "not measured" if self.passed is None else "pass" if self.passed else "fail"


@dataclass
class ExperimentOutcome:
    """What an experiment concludes.

    Args:
        title: Title of the picture.
        source: What the supplement says, in other words.
        checks: Claims and measurements.
        figures: matplotlib figures by name.
        values: Numbers behind the checks, JSON-able; units in the keys.
        notes: What a reader should know beside.
    """

    title: str
    source: str
    checks: list[Check] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every claim that was measured holds."""
        return all(check.passed is not False for check in self.checks)
