"""A Gaussian ensemble fitted to pairs of consecutive states by maximum likelihood.

    loss_m = mean (v + (c - mean)^2 exp(-v) + log 2 pi) / 2 + w mean(high - low),    v the log-variance

c is the standardised change over one step. Each member has a bootstrap of the pairs, batches and best weights of its
own; only the loop is shared. There are no last steps on all pairs: without held-out pairs nothing says when a variance
gets too sure.

The weight decay is the largest of the source (Chua et al., NeurIPS 2018); measured, it costs 0.3 % of the held-out
score where pairs abound (cartpole, 100 episodes) and gains where they do not (hexacopter, two flights).
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nsde_torch.data import Windows
from nsde_torch.errors import NonFiniteError
from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
from nsde_torch.training.loop import Loop
from nsde_torch.training.task import Fitted, Task

_BOUNDS = 0.05  # weight of the distance of the bounds; 0.01 to 0.12 validate alike
_DECAY = 1e-4  # of the weights, as a term of the gradient
_BLOCK_S = 4.0
_ROWS = 65_536
_VALIDATION_PAIRS = 2048
STEPS_FACTOR = 10  # batches are a sixteenth of the other models', gradient steps a tenth as dear


@dataclass(frozen=True)
class Pairs:
    """Standardised pairs."""

    inputs: Tensor  # what the networks see (N, n_in)
    changes: Tensor  # what they predict (N, n_change)


def nll(model: GaussianEnsemble, inputs: Tensor, changes: Tensor) -> Tensor:
    """Negative log-likelihood (members,), nats per channel, of inputs (members, N, n_in) and changes, standardised."""
    mean, v = model.standard(inputs)
    return 0.5 * (v + (changes - mean).square() * torch.exp(-v) + math.log(2 * math.pi)).mean((1, 2))


class EnsembleLoop(Loop):
    """One optimisation of one ensemble; `patience` is stretched as `steps` is against `options.steps`."""

    model: GaussianEnsemble
    differ = "runs, seed, trainer or model"

    def __init__(
        self,
        model: GaussianEnsemble,
        train: Pairs,
        validation: Pairs,
        *,
        steps: int,
        task: Task,
    ) -> None:
        named = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
        # the bounds are no weights: decay would draw them to 0
        decayed = [p for n, p in named if n.startswith("networks.")]
        others = [p for n, p in named if not n.startswith("networks.")]
        groups: list[dict[str, Any]] = [
            {"params": decayed, "weight_decay": _DECAY, "factor": 1.0},
            {"params": others, "factor": 1.0},
        ]
        options = task.options
        optimiser = torch.optim.Adam(groups, lr=options.lr, fused=True)
        patience = max(1, round(options.patience * steps / options.steps))
        own = replace(options, steps=steps, patience=patience, polish=0)
        super().__init__(model, optimiser, task, own, said_every=max(1, steps // 4))
        self.train, self.validation = train, validation
        members, count = model.spec.members, len(train.inputs)
        self.weight = members  # each member is moved by its own loss, however many there are
        # int32: five bootstraps of ten hours at 100 Hz are 70 MB
        self.bootstrap = torch.randint(count, (members, count), generator=self.batches, dtype=torch.int32)
        self.best_score = torch.full((members,), math.inf)
        """Validation score of the kept weights of each member (members,)."""
        self.best_step = torch.zeros(members, dtype=torch.int64)
        """Step of the kept weights of each member (members,)."""

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

    def _clip(self) -> Tensor:
        """Shorten the gradient of each member to the limit by itself."""
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        limit = self.options.clip
        if limit is not None and bool((norm > limit).any()):
            factor = limit / norm.clamp_min(limit)
            for g in gradients:
                g.mul_(factor.view(-1, *(1,) * (g.ndim - 1)))
        return norm

    @torch.no_grad()
    def validate(self) -> Tensor:
        """Score of each member on the held-out pairs (members,)."""
        shape = (self.model.spec.members, -1, -1)
        return nll(self.model, self.validation.inputs.expand(shape), self.validation.changes.expand(shape))

    def _judge(self) -> float:
        progress, scores = self.progress, self.validate().cpu()
        better = scores < self.best_score
        for name, parameter in self.named:  # the first axis of each counts the members
            self.kept[name][better] = parameter.detach()[better]
        self.best_score = torch.where(better, scores, self.best_score)
        self.best_step[better] = progress.step
        progress.best_score, progress.best_step = float(self.best_score.mean()), int(self.best_step.max())
        if not math.isfinite(progress.best_score):
            raise NonFiniteError(
                f"the validation score is not finite at step {progress.step}. Lower trainer.lr, or look at the data "
                "summary for outliers."
            )
        return float(scores.mean())

    def _further(self) -> dict[str, Tensor]:
        return {"best_score": self.best_score, "best_step": self.best_step}

    def _continue(self, tensors: Mapping[str, Tensor]) -> None:
        self.best_score, self.best_step = tensors["best_score"], tensors["best_step"]


def fit_ensemble(task: Task) -> Fitted:
    """Fit by gradient steps on pairs of states; NonFiniteError where the optimisation leaves the finite numbers."""
    spec = task.spec
    assert isinstance(spec, EnsembleSpec)
    model = GaussianEnsemble(spec, generator=torch.Generator().manual_seed(task.seed), values=task.values)
    model = model.to(device=task.device, dtype=task.dtype)
    windows = Windows(task.runs, spec.dt, spec.horizon, dtype=task.dtype, device=task.device)
    # cut as for the other models, which thus hold out the same rows
    train, held = windows.held_out(
        task.validation, _BLOCK_S * windows.pace, torch.Generator().manual_seed(task.seed)
    )
    pairs = standardised_pairs(model, train, clock_scale=task.clock)
    validation = cut_pairs(model, held, most=_VALIDATION_PAIRS)
    steps = spec.steps or STEPS_FACTOR * task.options.steps
    loop = EnsembleLoop(model, pairs, validation, steps=steps, task=task)
    loop.run()
    unit = "nats per channel of the standardised change, mean of the members"
    facts = {
        "loss": "likelihood",
        "validation": {"score": loop.progress.best_score, "unit": unit},
        "members": {"best_step": loop.best_step.tolist(), "validation": loop.best_score.tolist()},
    }
    return Fitted(model, loop.progress, facts=facts)


@torch.no_grad()
def standardised_pairs(model: GaussianEnsemble, windows: Windows, *, clock_scale: float) -> Pairs:
    """Set the standardisation of a model from training windows; what the networks see and predict of them."""
    count, like = len(windows.shortened(1)), model.clock_scale
    rows = like.new_empty(count, model.standardise.mean.numel())
    changes = like.new_empty(count, model.chart.n_change)
    done = 0
    for x, u, after in _cut(windows, count):
        part = slice(done, done + len(x))
        rows[part] = torch.cat((model.chart.inputs(x), u), 1)
        changes[part] = model.chart.change(x, after)
        done += len(x)
    model.standardise.fit(rows)
    model.change_scale.fit(changes)
    model.clock_scale.fill_(clock_scale)
    for table, to in ((rows, model.standardise), (changes, model.change_scale)):
        table.sub_(to.mean).div_(to.scale)  # in place: ten hours of data take 0.6 GB
    return Pairs(rows, changes)


@torch.no_grad()
def cut_pairs(model: GaussianEnsemble, windows: Windows, *, most: int) -> Pairs:
    """Pairs of some windows, at most so many, evenly spaced."""
    rows, changes = [], []
    for x, u, after in _cut(windows, most):
        rows.append(model.inputs(x, u))
        changes.append(model.change_scale(model.chart.change(x, after)))
    return Pairs(torch.cat(rows).contiguous(), torch.cat(changes).contiguous())


def _cut(windows: Windows, most: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """State, input and next state of the pairs of some windows, part by part: ten hours of data fit in memory."""
    short = windows.shortened(1)
    at = torch.linspace(0, len(short) - 1, min(most, len(short)), dtype=torch.float64).round().long()
    for part in at.split(_ROWS):
        x, u, _ = short.batch(part)
        yield x[:, 0], u[:, 0], x[:, 1]
