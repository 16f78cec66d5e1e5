"""The optimisation loop: Adam on minibatches, early stopping, checkpoints, exact resume.

What is validated and kept is a running average of the weights (Polyak and Juditsky 1992), which is less noisy than the
last iterate. Checkpoints hold tensors in safetensors and the rest as JSON in its header, so that both are of one
moment; they are written whole or not at all.
"""

import copy
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from safetensors import SafetensorError
from torch import Tensor, nn
from tqdm.auto import tqdm

from nsde_torch.errors import CheckpointError, NonFiniteError
from nsde_torch.progress import no_bar
from nsde_torch.training.options import TrainerOptions
from nsde_torch.training.task import Progress, Task
from nsde_torch.whole_files import read_tensors, write_tensors

_AVERAGE = 0.98
_LOG = logging.getLogger(__name__)


class Loop(ABC):
    """One optimisation of one model, which is changed in place: what kinds of models share.

    The `factor` of a group of the optimiser multiplies the learning rate. Where there is no terminal to draw a bar on,
    a line is said every so many steps.
    """

    differ: ClassVar[str] = "runs, seed, loss, trainer or model"  # what another training may differ in
    lower: ClassVar[str] = "trainer.lr"  # options to lower where the gradient is not finite
    weight: int = 1  # of the whole loss

    def __init__(
        self,
        model: nn.Module,
        optimiser: torch.optim.Optimizer,
        task: Task,
        options: TrainerOptions,
        *,
        said_every: int,
    ) -> None:
        self.model, self.optimiser, self.task, self.options = model, optimiser, task, options
        self.said_every = said_every
        self.patience = options.patience * options.validate_every
        self.batches = torch.Generator().manual_seed(2 * task.seed + 1)
        self.named = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
        self.parameters = [p for _, p in self.named]
        self.polishing = False
        self.progress = Progress()
        self.average = [p.detach().clone() for p in self.parameters]
        self.kept: dict[str, Tensor] = copy.deepcopy(model.state_dict())

    @abstractmethod
    def terms(self) -> dict[str, Tensor]:
        """All losses of one minibatch, weighted; their sum is what is minimised."""

    @abstractmethod
    def _clip(self) -> Tensor:
        """Shorten the gradient to the limit; its norm before."""

    @abstractmethod
    def _judge(self) -> float:
        """Validation score of the weights that the model has now; keeps what is better."""

    @abstractmethod
    def _further(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint beside weights, optimiser and batches."""

    @abstractmethod
    def _continue(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `_further` gave."""

    # ---- loop -----------------------------------------------------------------------------------------

    def run(self) -> Progress:
        """Optimise until the steps are done or the validation score stops falling; keeps the best weights.

        It resumes from the checkpoint of the task if there is one. NonFiniteError where the loss is not finite.
        """
        self.restore()
        task, progress, options = self.task, self.progress, self.options
        bar = tqdm(
            total=options.steps + options.polish,
            initial=progress.step + progress.polished,
            desc=task.name,
            unit="step",
            disable=no_bar(task.quiet),
            leave=False,
            mininterval=0.5,
        )
        with bar:
            if progress.step == 0:
                self._score({})
            for losses in self._steps():
                bar.update()
                step = progress.step
                if not self.polishing and (step % options.validate_every == 0 or step == options.steps):
                    row = self._score(losses)
                    bar.set_postfix(loss=f"{row['loss']:.4f}", validation=f"{row['validation']:.4f}")
                    task.log(step, row)
                if bar.disable and not task.quiet and not self.polishing and step % self.said_every == 0:
                    score = progress.history[-1]["validation"]
                    _LOG.info("%s: step %d of %d, validation %.4f", task.name, step, options.steps, score)
                done = progress.polished if self.polishing else step
                if done % options.checkpoint_every == 0:
                    self.save()
        if progress.polished:
            self._put(self.average)
            self.kept = copy.deepcopy(self.model.state_dict())
        self.model.load_state_dict(self.kept)
        self.save()
        return progress

    def _steps(self) -> Iterator[dict[str, Tensor]]:
        progress, options = self.progress, self.options
        while not progress.polished and progress.step < options.steps and not progress.stopped:
            losses = self._step(options.rate(progress.step))
            progress.step += 1
            self._follow(progress.step)
            yield losses
        if options.polish and not progress.polished:
            self.model.load_state_dict(self.kept)
            self.average = [p.detach().clone() for p in self.parameters]
            self.optimiser.state.clear()
        self.polishing = True
        while progress.polished < options.polish:
            losses = self._step(options.lr_end)
            progress.polished += 1
            self._follow(progress.polished)
            yield losses

    def _step(self, rate: float) -> dict[str, Tensor]:
        for group in self.optimiser.param_groups:
            group["lr"] = group["factor"] * rate
        self.optimiser.zero_grad(set_to_none=True)
        losses = self.terms()
        total = torch.stack(list(losses.values())).sum()
        (self.weight * total).backward()
        if not bool(torch.isfinite(self._clip()).all()):
            raise NonFiniteError(
                f"the gradient is not finite at step {self.progress.step + 1} (loss {float(total.detach()):.4g}). "
                f"Lower {self.lower}, or look at the data summary for outliers."
            )
        self.optimiser.step()
        return {k: v.detach() for k, v in losses.items()}

    @torch.no_grad()
    def _follow(self, steps: int) -> None:
        """Move the running average of the weights, faster during its first steps."""
        keep = min(_AVERAGE, steps / (steps + 10))
        torch._foreach_lerp_(self.average, list[Tensor](self.parameters), 1 - keep)

    @torch.no_grad()
    def _score(self, losses: dict[str, Tensor]) -> dict[str, float]:
        progress = self.progress
        current = [p.detach().clone() for p in self.parameters]
        self._put(self.average)
        row = {"step": float(progress.step), "validation": self._judge()}
        self._put(current)
        row |= {k: float(v) for k, v in losses.items()}
        if losses:
            row["loss"] = sum(float(v) for v in losses.values())
        progress.history.append(row)
        progress.stopped = progress.step - progress.best_step >= self.patience
        return row

    @torch.no_grad()
    def _put(self, values: list[Tensor]) -> None:
        for parameter, value in zip(self.parameters, values, strict=True):
            parameter.copy_(value)

    # ---- checkpoints ----------------------------------------------------------------------------------

    def save(self) -> None:
        """Write everything that the rest of the optimisation depends on."""
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"kept.{k}": v for k, v in self.kept.items()}
        tensors |= {"batches": self.batches.get_state(), **self._further()}
        for i, (parameter, average) in enumerate(zip(self.parameters, self.average, strict=True)):
            tensors[f"average.{i}"] = average
            for key, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"adam.{i}.{key}"] = value
        about = {"identity": self.task.identity, **vars(self.progress)}
        write_checkpoint(self.task.checkpoint, tensors, about)

    def restore(self) -> None:
        """Continue from a checkpoint if there is one; CheckpointError where it is damaged or of another training."""
        parts = ("batches", *self._further(), *(f"average.{i}" for i in range(len(self.parameters))))
        found = read_checkpoint(self.task, self.model.state_dict(), parts=parts, differ=self.differ)
        if found is None:
            return
        tensors, about = found
        device = self.parameters[0].device
        model, self.kept = (
            {k.removeprefix(part): v.to(device) for k, v in tensors.items() if k.startswith(part)}
            for part in ("model.", "kept.")
        )
        self.model.load_state_dict(model)
        self.batches.set_state(tensors["batches"])
        self._continue(tensors)
        fused = self.optimiser.defaults["fused"]  # else the number of the step stays where it is
        for i, parameter in enumerate(self.parameters):
            self.average[i] = tensors[f"average.{i}"].to(device)
            prefix = f"adam.{i}."
            state = {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}
            if state:
                self.optimiser.state[parameter] = {
                    k: v if k == "step" and not fused else v.to(device) for k, v in state.items()
                }
        self.progress = Progress(**about)


def write_checkpoint(path: Path, tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write `path`.safetensors; `about`, JSON-able, travels in its header, so that both are of one moment."""
    write_tensors(path.with_suffix(".safetensors"), tensors, {"about": json.dumps(about)})


def read_checkpoint(
    task: Task, expected: Mapping[str, Tensor], *, parts: Collection[str], differ: str
) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    """Read the checkpoint of a task; None if there is none, CheckpointError where it is damaged or of another training.

    It should be of a training of that identity, else `differ` says what may differ, and hold tensors as the expected
    ones of the model and further parts.
    """
    file = task.checkpoint.with_suffix(".safetensors")
    if not file.exists():
        return None
    try:
        tensors, header = read_tensors(file)
        about = json.loads(header["about"])
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise CheckpointError(f"checkpoint {file} is damaged ({error}). Remove it to start again.") from error
    kept = {k[5:] for k in tensors if k.startswith("kept.")}
    lost = set(parts) - set(tensors)
    if lost or kept != {k[6:] for k in tensors if k.startswith("model.")}:
        raise CheckpointError(f"checkpoint {file} is damaged (parts are missing). Remove it to start again.")
    shapes = {k[6:]: (v.shape, v.dtype) for k, v in tensors.items() if k.startswith("model.")}
    wanted = {k: (v.shape, v.dtype) for k, v in expected.items()}
    if shapes != wanted:
        differing = sorted(k for k in {*shapes, *wanted} if shapes.get(k) != wanted.get(k))
        raise CheckpointError(
            f"checkpoint {file} is of another model (they differ in {', '.join(differing[:5])}). Resume with the "
            "configuration of the run, or start a new one."
        )
    if about.pop("identity", "") != task.identity:
        raise CheckpointError(
            f"checkpoint {file} is of another training: {differ} differ. Resume with the configuration of the run, or "
            "start a new one in another run_dir."
        )
    return tensors, about
