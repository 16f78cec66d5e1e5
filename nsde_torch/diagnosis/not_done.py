"""Stages of a diagnosis that could not be computed, or were left out: each costs itself, and not the run.

A diagnosis that is not finished (`SoFar`) lists those that are still to come, or were stopped.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeVar, final

import torch

from nsde_torch.errors import ConfigError, DataError, NsdeError

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Diagnosis

SELECTION, SECOND_LOOK = "the selection of effects", "a second look at each effect beside the others"
TESTS, LAWS = "tests of feedback and of what is left", "laws beyond the catalogue"
OTHER_ROWS = "the search in other rows and over longer boxes"
ESTIMATES, ERRORS = "estimates in the loop", "errors on runs left out"
CEILING, EXPLANATION = "what functions could still explain", "an explanation of what is left"
NOT_YET = "not done yet"
STOPPED = "the diagnosis was stopped before its end"
NO_TIME = "there was no time left for it"

T = TypeVar("T")
D = TypeVar("D")

# numpy's LinAlgError is a ValueError, and it answers some empty arrays with an IndexError
NUMERICAL = (ValueError, ArithmeticError, IndexError, torch.linalg.LinAlgError)
"""What computations raise on numbers that do not suffice."""


@dataclass(frozen=True)
class NotDone:
    """A stage without a result."""

    stage: str  # what it looks for, in words
    why: str  # why there is no result


@dataclass(frozen=True)
class SoFar:
    """That a diagnosis is not finished."""

    stopped_during: str | None = None  # what was being done when it was stopped; None while it goes on
    left_s: float | None = None  # roughly how long it will yet take [s]; None: not known, or stopped
    after_min: float | None = None
    """The limit of time that ended it [min]; None: it goes on, or was interrupted."""

    def as_dict(self) -> dict[str, str | float | None]:
        """Plain containers, for JSON."""
        left = None if self.left_s is None else round(self.left_s)
        return {
            "stopped_during": self.stopped_during,
            "stopped_after_min": self.after_min,
            "roughly_left_s": left,
        }


@final
class StoppedError(KeyboardInterrupt):
    """A diagnosis was stopped, and something is known.

    Args:
        found: The diagnosis so far.
    """

    def __init__(self, found: "Diagnosis") -> None:
        super().__init__("the diagnosis was stopped")
        self.found = found


@dataclass
class OptionalStages:
    """Optional stages of one diagnosis."""

    not_done: list[NotDone] = field(default_factory=list)  # those without a result
    too_long: Callable[[str], bool] = lambda stage: False
    """Whether a stage would not end in the time that is left."""

    def attempt(self, stage: str, do: Callable[[], T], otherwise: D) -> T | D:
        """What a stage gives, or something else where its numbers fail or the time does not suffice.

        Args:
            stage: What it looks for, in words.
            do: The stage.
            otherwise: What counts without it.

        Raises:
            ConfigError: an option is wrong, which no other stage mends.
        """
        if self.too_long(stage):
            self.leave_out(stage, NO_TIME)
            return otherwise
        try:
            return do()
        except ConfigError:
            raise
        except NUMERICAL as error:
            self.leave_out(stage, f"it could not be computed ({reason(error)})")
            return otherwise

    def leave_out(self, stage: str, why: str) -> None:
        """Note a stage without a result, once."""
        left = NotDone(stage, why)
        if left not in self.not_done:
            self.not_done.append(left)


def needed(stage: str, do: Callable[[], T]) -> T:
    """What a stage gives without which there is no diagnosis.

    Args:
        stage: What it looks for, in words.
        do: The stage.

    Raises:
        DataError: its numbers fail.
    """
    try:
        return do()
    except NsdeError:
        raise
    except NUMERICAL as error:
        raise DataError(
            f"{stage} could not be computed from these data ({reason(error)}). Look at the columns with nsde inspect; "
            "record longer runs in which every state moves."
        ) from error


def reason(error: Exception) -> str:
    """Why a computation failed: the package's own messages as they are, those of others with their kind."""
    said = str(error).rstrip(".")
    return said if isinstance(error, NsdeError) else f"{type(error).__name__}: {said}"
