"""What a fit of one model is given and what it gives back, whatever the kind of model."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from nsde_torch.data import Run
from nsde_torch.models.model import Model, ModelSpec
from nsde_torch.training.options import LossOptions, TrainerOptions
from nsde_torch.training.progress import Progress

Parameters = dict[str, dict[str, object]]


@dataclass(frozen=True, kw_only=True)
class Task:
    """One fit of one model to some runs.

    Args:
        spec: What to build.
        runs: Runs to fit to.
        seed: Seed of weights, batches and noise.
        name: Name of the fit, for the progress bar and the checkpoint.
        loss: Weights of the losses.
        options: Settings of the optimisation.
        validation: Share of the runs' time that early stopping looks at.
        clock: Physical seconds per logged second.
        values: Initial values of declared parameters.
        device: Where tensors live.
        dtype: Precision.
        checkpoint: File (without suffix) to write to and to resume from.
        log: Called with step and losses at each validation.
        instruments: Logged columns from outside the loop (see `identify_in_loop`).
        quiet: No progress bar.
        near: A fit of the same model to these runs and others, near which this one begins.
    """

    spec: ModelSpec
    runs: Sequence[Run]
    seed: int
    name: str
    loss: LossOptions
    options: TrainerOptions
    validation: float
    clock: float
    values: Mapping[str, Any]
    device: torch.device
    dtype: torch.dtype
    checkpoint: Path
    log: Callable[[int, dict[str, float]], None]
    instruments: Sequence[str] = ()
    quiet: bool = False
    near: "Fitted | None" = None

    @property
    def identity(self) -> str:
        """What the numbers of a fit depend on, as a hash: a checkpoint of another fit is not continued."""
        facts = {
            "spec": self.spec.as_dict(),
            "loss": asdict(self.loss),
            "options": {
                k: v for k, v in asdict(self.options).items() if k not in ("checkpoint_every", "calibrate")
            },
            "seed": self.seed,
            "validation": self.validation,
            "values": dict(self.values),
            "dtype": str(self.dtype),
            "runs": [run.content_hash for run in self.runs],
            "clock": self.clock,
        }
        if self.instruments:
            facts["instruments"] = list(self.instruments)
        return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


def _none() -> Parameters:
    return {}


@dataclass
class Fitted:
    """A fitted model.

    Args:
        model: The model.
        progress: How the optimisation went.
        parameters: Makes the declared parameters with intervals: name -> `value`, `half_width_90`, `unit`.
        facts: Further plain values for `metrics.json`.
        said: What to say of the fit, beside the table of parameters; empty: the optimisation's usual line.
        begin: Plain values with which a fit to some of the runs begins (`Task.near`).
    """

    model: Model
    progress: Progress
    parameters: Callable[[], Parameters] = _none
    facts: dict[str, Any] = field(default_factory=dict)
    said: str = ""
    begin: dict[str, Any] = field(default_factory=dict)
