"""The optimisation of an ensemble: Adam on small batches, early stopping member by member, exact resume."""

import copy
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from nsde_torch.errors import CheckpointError, NonFiniteError
from nsde_torch.models.ensemble import GaussianEnsemble
from nsde_torch.progress import no_bar
from nsde_torch.training.checkpoint import read_checkpoint, write_checkpoint
from nsde_torch.training.options import TrainerOptions
from nsde_torch.training.progress import Progress

_AVERAGE = 0.98
_BOUNDS = 0.05  # weight of the distance of the bounds; 0.01 to 0.12 validate alike
_DECAY = 1e-4  # of the weights, as a term of the gradient
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Pairs:
    """Standardised pairs."""

    inputs: Tensor  # what the networks see (N, n_in)
    changes: Tensor  # what they predict (N, n_change)


def nll(model: GaussianEnsemble, inputs: Tensor, changes: Tensor) -> Tensor:
    """Negative log-likelihood of each member (members,), nats per channel.

    Args:
        model: The ensemble.
        inputs: Standardised inputs, each member its own (members, N, n_in).
        changes: Standardised changes (members, N, n_change).
    """
    mean, v = model.standard(inputs)
    return 0.5 * (v + (changes - mean).square() * torch.exp(-v) + math.log(2 * math.pi)).mean((1, 2))


class EnsembleLoop:
    """One optimisation of one ensemble.

    Args:
        model: Changed in place.
        train: Training pairs.
        validation: Pairs that training does not see.
        steps: Largest number of gradient steps.
        options: Settings of the optimisation; `patience` is stretched as `steps` is against `options.steps`.
        seed: Seed of bootstraps and batches.
        identity: Hash of all that the numbers depend on; a checkpoint of another is refused.

    Attributes:
        best_score: Validation score of the kept weights of each member (members,).
        best_step: Step of the kept weights of each member (members,).
    """

    def __init__(
        self,
        model: GaussianEnsemble,
        train: Pairs,
        validation: Pairs,
        *,
        steps: int,
        options: TrainerOptions,
        seed: int,
        identity: str = "",
    ) -> None:
        self.model, self.train, self.validation = model, train, validation
        self.steps, self.options, self.identity = steps, options, identity
        members, count = model.spec.members, len(train.inputs)
        self.patience = max(1, round(options.patience * steps / options.steps)) * options.validate_every
        self.batches = torch.Generator().manual_seed(2 * seed + 1)
        # int32: five bootstraps of ten hours at 100 Hz are 70 MB
        self.bootstrap = torch.randint(count, (members, count), generator=self.batches, dtype=torch.int32)
        self.named = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
        self.parameters = [p for _, p in self.named]  # the first axis of each counts the members
        # the bounds are no weights: decay would draw them to 0
        decayed = [p for n, p in self.named if n.startswith("networks.")]
        others = [p for n, p in self.named if not n.startswith("networks.")]
        groups: list[dict[str, Any]] = [{"params": decayed, "weight_decay": _DECAY}, {"params": others}]
        self.optimiser = torch.optim.Adam(groups, lr=options.lr, fused=True)
        self.progress = Progress()
        self.best_score = torch.full((members,), math.inf)
        self.best_step = torch.zeros(members, dtype=torch.int64)
        self.average = [p.detach().clone() for p in self.parameters]
        self.kept = copy.deepcopy(model.state_dict())

    # ---- one step -------------------------------------------------------------------------------------

    def draw(self) -> Tensor:
        """Numbers of the pairs of a batch, each member from its own bootstrap (members, batch)."""
        members, count = self.bootstrap.shape
        at = torch.randint(count, (members, self.model.spec.batch), generator=self.batches)
        return self.bootstrap.gather(1, at).long().to(self.train.inputs.device)

    def terms(self) -> dict[str, Tensor]:
        """Terms of the loss of one batch, means over the members."""
        at = self.draw()
        return {
            "data": nll(self.model, self.train.inputs[at], self.train.changes[at]).mean(),
            "bounds": _BOUNDS * self.model.width().mean(),
        }

    def _step(self) -> dict[str, Tensor]:
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate(self.progress.step)
        self.optimiser.zero_grad(set_to_none=True)
        losses = self.terms()
        total = torch.stack(list(losses.values())).sum()
        (
            self.model.spec.members * total
        ).backward()  # each member is moved by its own loss, however many there are
        self._clip(float(total.detach()))
        self.optimiser.step()
        self.progress.step += 1
        with torch.no_grad():
            step = self.progress.step
            keep = min(_AVERAGE, step / (step + 10))
            torch._foreach_lerp_(self.average, list[Tensor](self.parameters), 1 - keep)
        return {k: v.detach() for k, v in losses.items()}

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0."""
        options = self.options
        share = min(step / max(options.decay_steps or self.steps, 1), 1.0)
        return options.lr + (options.lr_end - options.lr) * share

    def _clip(self, loss: float) -> None:
        """Shorten the gradient of each member to the limit by itself."""
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        if not bool(torch.isfinite(norm).all()):
            raise NonFiniteError(
                f"the gradient is not finite at step {self.progress.step + 1} (loss {loss:.4g}). "
                "Lower trainer.lr, or look at the data summary for outliers."
            )
        limit = self.options.clip
        if limit is not None and bool((norm > limit).any()):
            factor = limit / norm.clamp_min(limit)
            for g in gradients:
                g.mul_(factor.view(-1, *(1,) * (g.ndim - 1)))

    # ---- loop -----------------------------------------------------------------------------------------

    def run(
        self,
        *,
        title: str,
        checkpoint: Path | None = None,
        log: Callable[[int, dict[str, float]], None] | None = None,
        quiet: bool = False,
    ) -> Progress:
        """Optimise until the steps are done or no member improves; every member keeps its best weights.

        Args:
            title: Name of the progress bar.
            checkpoint: File (without suffix) to write to and to resume from if it is there.
            log: Called with step and losses at each validation.
            quiet: No progress bar.

        Raises:
            NonFiniteError: the loss is not finite.
        """
        if checkpoint is not None:
            self.restore(checkpoint)
        progress, options = self.progress, self.options
        bar = tqdm(
            total=self.steps,
            initial=progress.step,
            desc=title,
            unit="step",
            disable=no_bar(quiet),
            leave=False,
            mininterval=0.5,
        )
        with bar:
            if progress.step == 0:
                self._score({})
            while progress.step < self.steps and not progress.stopped:
                losses = self._step()
                bar.update()
                if progress.step % options.validate_every == 0 or progress.step == self.steps:
                    row = self._score(losses)
                    bar.set_postfix(loss=f"{row['loss']:.4f}", validation=f"{row['validation']:.4f}")
                    if log is not None:
                        log(progress.step, row)
                if bar.disable and not quiet and progress.step % max(1, self.steps // 4) == 0:
                    score = progress.history[-1]["validation"]
                    _LOG.info("%s: step %d of %d, validation %.4f", title, progress.step, self.steps, score)
                if checkpoint is not None and progress.step % options.checkpoint_every == 0:
                    self.save(checkpoint)
        self.model.load_state_dict(self.kept)
        if checkpoint is not None:
            self.save(checkpoint)
        return progress

    @torch.no_grad()
    def validate(self) -> Tensor:
        """Score of each member on the held-out pairs (members,)."""
        shape = (self.model.spec.members, -1, -1)
        return nll(self.model, self.validation.inputs.expand(shape), self.validation.changes.expand(shape))

    @torch.no_grad()
    def _score(self, losses: dict[str, Tensor]) -> dict[str, float]:
        progress = self.progress
        current = [p.detach().clone() for p in self.parameters]
        self._put(self.average)
        scores = self.validate().cpu()
        better = scores < self.best_score
        for name, parameter in self.named:
            self.kept[name][better] = parameter.detach()[better]
        self._put(current)
        self.best_score = torch.where(better, scores, self.best_score)
        self.best_step[better] = progress.step
        progress.best_score, progress.best_step = float(self.best_score.mean()), int(self.best_step.max())
        row = {"step": float(progress.step), "validation": float(scores.mean())}
        row |= {k: float(v) for k, v in losses.items()}
        if losses:
            row["loss"] = sum(float(v) for v in losses.values())
        progress.history.append(row)
        if not math.isfinite(progress.best_score):
            raise NonFiniteError(
                f"the validation score is not finite at step {progress.step}. Lower trainer.lr, or look at the data "
                "summary for outliers."
            )
        progress.stopped = progress.step - progress.best_step >= self.patience
        return row

    @torch.no_grad()
    def _put(self, values: list[Tensor]) -> None:
        for parameter, value in zip(self.parameters, values, strict=True):
            parameter.copy_(value)

    # ---- checkpoints ----------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write everything that the rest of the optimisation depends on."""
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"kept.{k}": v for k, v in self.kept.items()}
        tensors |= {"batches": self.batches.get_state()}
        tensors |= {"best_score": self.best_score, "best_step": self.best_step}
        for i, (parameter, average) in enumerate(zip(self.parameters, self.average, strict=True)):
            tensors[f"average.{i}"] = average
            for key, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"adam.{i}.{key}"] = value
        p = self.progress
        about: dict[str, Any] = {
            "identity": self.identity,
            "step": p.step,
            "best_step": p.best_step,
            "best_score": p.best_score,
            "history": p.history,
            "stopped": p.stopped,
        }
        write_checkpoint(path, tensors, about)

    def restore(self, path: Path) -> bool:
        """Continue from a checkpoint if there is one.

        Raises:
            CheckpointError: the checkpoint is damaged or of another training.
        """
        parts = ("batches", "best_score", "best_step", *(f"average.{i}" for i in range(len(self.parameters))))
        found = read_checkpoint(path, self.model.state_dict(), parts=parts)
        if found is None:
            return False
        tensors, about = found
        if about.pop("identity", "") != self.identity:
            raise CheckpointError(
                f"checkpoint {path.with_suffix('.safetensors')} is of another training: runs, seed, trainer or model "
                "differ. Resume with the configuration of the run, or start a new one in another run_dir."
            )
        device = self.parameters[0].device
        self.model.load_state_dict(
            {k[6:]: v.to(device) for k, v in tensors.items() if k.startswith("model.")}
        )
        self.kept = {k[5:]: v.to(device) for k, v in tensors.items() if k.startswith("kept.")}
        self.batches.set_state(tensors["batches"])
        self.best_score, self.best_step = tensors["best_score"], tensors["best_step"]
        for i, parameter in enumerate(self.parameters):
            self.average[i] = tensors[f"average.{i}"].to(device)
            prefix = f"adam.{i}."
            state = {k[len(prefix) :]: v.to(device) for k, v in tensors.items() if k.startswith(prefix)}
            if state:
                self.optimiser.state[parameter] = state
        self.progress = Progress(**about)
        return True
