"""A Gaussian ensemble fitted to pairs of consecutive states by maximum likelihood.

    loss_m = mean (v + (c - mean)^2 exp(-v) + log 2 pi) / 2 + w mean(high - low),    v the log-variance

c is the standardised change over one step. Each member has a bootstrap of the pairs, batches and best weights of its
own, so members are as independent as if they were fitted one after the other; only the loop is shared. Pairs are of
measured states. As in the other fits, what is validated and kept is a running average of the weights (Polyak and
Juditsky 1992). There are no last steps on all pairs: without held-out pairs nothing says when a variance gets too sure.

The weight decay is the largest of the source (Chua et al., NeurIPS 2018); measured, it costs 0.3 % of the held-out
score where pairs abound (cartpole, 100 episodes) and gains where they do not (hexacopter, two flights).
"""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from nsde_torch.data import Windows
from nsde_torch.models.ensemble import EnsembleSpec, GaussianEnsemble
from nsde_torch.training.ensemble_loop import EnsembleLoop, Pairs
from nsde_torch.training.task import Fitted, Task

_BLOCK_S = 4.0
_ROWS = 65_536
_VALIDATION_PAIRS = 2048
STEPS_FACTOR = 10  # batches are a sixteenth of the other models', gradient steps a tenth as dear


def fit_ensemble(task: Task) -> Fitted:
    """Fit by gradient steps on pairs of consecutive states.

    Raises:
        NonFiniteError: the optimisation left the finite numbers.
    """
    spec = task.spec
    assert isinstance(spec, EnsembleSpec)
    model = GaussianEnsemble(spec, generator=torch.Generator().manual_seed(task.seed), values=task.values)
    model = model.to(device=task.device, dtype=task.dtype)
    windows = Windows(task.runs, spec.dt, spec.horizon, dtype=task.dtype, device=task.device)
    # cut as for the other models, which thus hold out the same rows
    train, held = windows.held_out(task.validation, _BLOCK_S, torch.Generator().manual_seed(task.seed))
    pairs = standardised_pairs(model, train, clock_scale=task.clock)
    validation = cut_pairs(model, held, most=_VALIDATION_PAIRS)
    loop = EnsembleLoop(
        model,
        pairs,
        validation,
        steps=spec.steps or STEPS_FACTOR * task.options.steps,
        options=task.options,
        seed=task.seed,
        identity=task.identity,
    )
    loop.run(title=task.name, checkpoint=task.checkpoint, log=task.log, quiet=task.quiet)
    return Fitted(model, loop.progress, facts=_facts(loop))


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


def _facts(loop: EnsembleLoop) -> dict[str, Any]:
    return {
        "loss": "likelihood",
        "validation": {
            "score": loop.progress.best_score,
            "unit": "nats per channel of the standardised change, mean of the members",
        },
        "members": {"best_step": loop.best_step.tolist(), "validation": loop.best_score.tolist()},
    }
