"""Stages of a diagnosis without a result, and going on from a diagnosis that is not finished.

A stage that could not be computed, or was left out, costs itself, and not the run. A diagnosis that is not finished
(`SoFar`) lists those that are still to come, or were stopped. Another one of the same data and the same declared model
goes on from what it had selected (`Begun`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, final

import torch

from nsde_torch.data import DataSet
from nsde_torch.diagnosis.candidates import joined
from nsde_torch.diagnosis.files import EFFECTS, RESULT
from nsde_torch.effects import effect_class
from nsde_torch.effects import files as effects_files
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.errors import CheckpointError, ConfigError, DataError, NsdeError
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import System

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Diagnosis

SELECTION, SECOND_LOOK = "the selection of effects", "a second look at each effect beside the others"
TESTS, LAWS = "tests of feedback and of what is left", "laws beyond the catalogue"
MOVING_ROWS = "a search in the rows alone in which the machine moves"
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
    """A diagnosis was stopped, and something is known."""

    def __init__(self, found: Diagnosis) -> None:
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


# ---- going on ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Begun:
    """What an earlier diagnosis had selected. Laws beyond the catalogue are none of it: they are looked for anew."""

    effects: Mapping[str, dict[str, Any]]  # effects with values, in the order in which they were selected
    nats: Mapping[str, float]  # log likelihood that each brought [nats]

    def beside(self, system: System) -> System:
        """A system with the effects."""
        for name, values in self.effects.items():
            system = joined(system, name, values)
        return system


def declared_model(spec: SysidSpec) -> dict[str, Any]:
    """What must be the same for a diagnosis to go on, for JSON."""
    return {
        "system": spec.system,
        "effects": list(spec.effects),
        "declared": None if spec.declared is None else list(spec.declared),
        "options": dict(spec.system_options),
    }


def read_begun(folder: str | Path, data: DataSet, runs: Sequence[str], spec: SysidSpec) -> Begun:
    """What the diagnosis of a folder had selected.

    Raises:
        CheckpointError: there is no diagnosis, or one that came to its end.
        ConfigError: of another declared model.
        DataError: of other data.
    """
    folder, what = Path(folder), f"`resume={folder}`"
    try:
        content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        of, had, nats = content["so_far"], content["data"], content["findings"]
    except OSError:
        raise CheckpointError(
            f"{what}: there is no diagnosis to go on with (no {folder / RESULT})."
        ) from None
    except (KeyError, ValueError, TypeError):
        raise CheckpointError(
            f"{what}: there is nothing to go on with: {folder / RESULT} is no diagnosis, or one that came to its end."
        ) from None
    declared = json.loads(json.dumps(declared_model(spec)))
    for key, before in of["declared"].items():
        if before != declared[key]:
            raise ConfigError(
                f"{what} diagnosed another declared model: its {key} was {before!r}, and is {declared[key]!r} now."
            )
    now = {"kind": data.kind, "dt_s": data.dt, "runs": list(runs), "fingerprint": data.fingerprint}
    for key, value in now.items():
        if had[key] != value:
            raise DataError(f"{what} looked at other data: {key} was {had[key]!r}, and is {value!r} now.")
    effects = effects_files.read(folder / EFFECTS, "resume")[1]
    return Begun(
        {str(effect_class(name).name): values for name, values in effects.items() if not is_law(name)},
        {f["name"]: f["evidence_nats"] for f in nats if f["kind"] == "effect"},
    )
