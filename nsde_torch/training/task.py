"""What a fit of one model is given and what it gives back, whatever the kind of model."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from nsde_torch.data import Run
from nsde_torch.models.model import Model, ModelSpec
from nsde_torch.training.options import LossOptions, TrainerOptions

Parameters = dict[str, dict[str, object]]


@dataclass(frozen=True, kw_only=True)
class Task:
    """One fit of one model to some runs."""

    spec: ModelSpec  # what to build
    runs: Sequence[Run]  # runs to fit to
    seed: int  # seed of weights, batches and noise
    name: str  # name of the fit, for the progress bar and the checkpoint
    loss: LossOptions  # weights of the losses
    options: TrainerOptions  # settings of the optimisation
    validation: float  # share of the runs' time that early stopping looks at
    clock: float  # physical seconds per logged second
    values: Mapping[str, Any]  # initial values of declared parameters
    device: torch.device  # where tensors live
    dtype: torch.dtype  # precision
    checkpoint: Path  # file (without suffix) to write to and to resume from
    log: Callable[[int, dict[str, float]], None]  # called with step and losses at each validation
    instruments: Sequence[str] = ()  # logged columns from outside the loop (see `identify_in_loop`)
    quiet: bool = False  # no progress bar
    near: "Fitted | None" = None
    """A fit of the same model to these runs and others, near which this one begins."""

    @property
    def identity(self) -> str:
        """What the numbers of a fit depend on, as a hash: a checkpoint of another fit is not continued."""
        facts = {
            "loss": asdict(self.loss),
            "options": {
                k: v for k, v in asdict(self.options).items() if k not in ("checkpoint_every", "calibrate")
            },
            "seed": self.seed,
            "validation": self.validation,
            "dtype": str(self.dtype),
        }
        return self._hash(facts)

    @cached_property
    def before_seed(self) -> str:
        """What a fit finds before any seed or setting of an optimiser matters depends on this, as a hash."""
        near = None
        if self.near is not None:
            model = self.near.model
            values = {k: v.tolist() for k, (v, _) in model.system.all_declared().items()}
            near = [self.near.begin, model.spec.as_dict(), values]
        return self._hash({"near": near})

    def _hash(self, facts: dict[str, Any]) -> str:
        """Of these facts, the model and the data."""
        facts |= {"spec": self.spec.as_dict(), "values": dict(self.values), "clock": self.clock}
        facts["runs"] = [run.content_hash for run in self.runs]
        if self.instruments:
            facts["instruments"] = list(self.instruments)
        return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


@dataclass
class Progress:
    """Where an optimisation stands."""

    step: int = 0  # gradient steps done
    best_step: int = 0  # step of the kept weights
    best_score: float = math.inf  # validation score of the kept weights
    history: list[dict[str, float]] = field(default_factory=list)  # one row per validation
    stopped: bool = False  # whether early stopping ended it
    polished: int = 0  # steps done on all windows after that


@dataclass
class Fitted:
    """A fitted model."""

    model: Model
    progress: Progress  # how the optimisation went
    parameters: Callable[[], Parameters] = dict
    """Makes the declared parameters with intervals: name -> `value`, `half_width_90`, `unit`."""
    facts: dict[str, Any] = field(default_factory=dict)  # further plain values for `metrics.json`
    said: str = ""
    """What to say of the fit, beside the table of parameters; empty: the optimisation's usual line."""
    details: str = ""  # tables of the fit that are said with `verbose`
    begin: dict[str, Any] = field(default_factory=dict)
    """Plain values with which a fit to some of the runs begins (`Task.near`)."""
