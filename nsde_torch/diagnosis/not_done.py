"""Stages of a diagnosis that could not be computed, or were left out: each costs itself, and not the run."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TypeVar

import torch

from nsde_torch.errors import ConfigError, NsdeError

T = TypeVar("T")
D = TypeVar("D")


@dataclass(frozen=True)
class NotDone:
    """A stage without a result.

    Args:
        stage: What it looks for, in words.
        why: Why there is no result.
    """

    stage: str
    why: str

    def as_dict(self) -> dict[str, str]:
        """Plain containers, for JSON."""
        return asdict(self)


@dataclass
class OptionalStages:
    """Optional stages of one diagnosis.

    Args:
        not_done: Those without a result.
    """

    not_done: list[NotDone] = field(default_factory=list)

    def attempt(self, stage: str, do: Callable[[], T], otherwise: D) -> T | D:
        """What a stage gives, or something else where its numbers fail.

        Args:
            stage: What it looks for, in words.
            do: The stage.
            otherwise: What counts without it.

        Raises:
            ConfigError: an option is wrong, which no other stage mends.
        """
        try:
            return do()
        except ConfigError:
            raise
        except (ValueError, ArithmeticError, torch.linalg.LinAlgError) as error:  # numpy's is a ValueError
            self.leave_out(stage, f"it could not be computed ({reason(error)})")
            return otherwise

    def leave_out(self, stage: str, why: str) -> None:
        """Note a stage without a result, once."""
        left = NotDone(stage, why)
        if left not in self.not_done:
            self.not_done.append(left)


def reason(error: Exception) -> str:
    """Why a computation failed: the package's own messages as they are, those of others with their kind."""
    said = str(error).rstrip(".")
    return said if isinstance(error, NsdeError) else f"{type(error).__name__}: {said}"
