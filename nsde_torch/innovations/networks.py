"""Networks fitted to innovations.

    min  sum_k |P (r_k - g(y_k))|^2 / (2 M) + decay,        P whitening filters of the noise of r

r is what is left of the change over a step (`residuals`), g the networks' part of it, of features y_k that were
foreseen before the step. All steps are one batch: the networks are small, and a filter needs neighbours. They start
where they say nothing. Blocks of time are left out in turn, all folds advance together, and the number of steps is that
with the smallest innovations on what was left out; then one fit to everything takes as many. A group of channels whose
blocks are not better by two standard errors keeps no network: where nothing is missing, nothing is learned.

In a closed loop the state knows the inputs of the past, so a network of the state would stand in for a lag that the
physics lacks, and be right only as long as the same pilot flies. What the past of the inputs explains linearly is
therefore taken out of innovations and networks alike (Frisch and Waugh, Econometrica 1 (1933)).
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from nsde_torch.innovations.whitening import Whitening
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.series import Series

SURE = 2.0
"""Standard errors by which blocks of time left out have to be better for a network."""
_RATE_END = 0.1  # of the first learning rate
_RANK = 1e-4  # of the largest singular value

Predict = Callable[[nn.Module], Tensor]


@dataclass(frozen=True)
class NetworkSettings:
    """How networks are fitted.

    Args:
        steps: Largest number of gradient steps.
        rate: Adam's first learning rate; it falls to a tenth over `steps`.
        every: Steps between looks at what was left out.
        patience: Looks without a better score before it ends.
        folds: Parts that are left out in turn.
        block: Rows of a block of time.
        penalty: Added to the mean of half the squared innovations.
    """

    steps: int
    rate: float
    every: int
    patience: int
    folds: int
    block: int
    penalty: Callable[[nn.Module], Tensor]


@dataclass(frozen=True)
class Learned:
    """What networks learned.

    Args:
        steps: Gradient steps of the fit that was kept.
        tried: Steps that the folds took.
        kept: Whether each group keeps its network.
        before, after: Mean squared innovation on what was left out, without and with the networks.
        gain: Log likelihood won on what was left out by each group of channels [nats].
        error: Its standard error over blocks of time.
        spread: Standard error of the networks' change over a step, by channel (root mean square over the rows).
        history: Step and mean squared innovation on what was left out.
    """

    steps: int
    tried: int
    kept: tuple[bool, ...]
    before: float
    after: float
    gain: tuple[float, ...]
    error: tuple[float, ...]
    spread: tuple[float, ...]
    history: tuple[tuple[int, float], ...]


def fit_networks(
    module: nn.Module,
    predict: Predict,
    change: Tensor,
    noises: Sequence[Noise],
    series: Series,
    groups: Sequence[Sequence[int]],
    settings: NetworkSettings,
    *,
    nuisance: Tensor,
    keep: Sequence[bool],
    generator: torch.Generator,
    on_step: Callable[[int], None] = lambda _: None,
) -> Learned:
    """Fit networks to changes over steps.

    Args:
        module: The networks, which say nothing at first; changed in place.
        predict: Their change over each step (channels, N).
        change: What they are to explain (channels, N).
        noises: Noise model of each channel.
        series: Stretches of the rows.
        groups: Channels that each network moves.
        settings: How.
        nuisance: Columns (N, p) whose linear part in the innovations is nobody's: the past of the inputs.
        keep: Whether a group keeps its network whatever the blocks say.
        generator: Chooses the blocks of the folds.
        on_step: Called with the number of rounds of gradient steps done.
    """
    whiten = _Purged(Whitening(noises, series), nuisance, len(change))
    target = whiten(change)
    block = torch.from_numpy(series.blocks(settings.block))
    blocks = int(block.max()) + 1
    folds = min(settings.folds, blocks)
    fold = (torch.randperm(blocks, generator=generator) % folds)[block] if folds > 1 else block
    base = 0.5 * target.square()
    members = [_Member(copy.deepcopy(module), settings) for _ in range(folds if folds > 1 else 0)]
    step, best_step, best_score = 0, 0, float(base.sum())
    looks: list[tuple[int, float, Tensor]] = [(0, best_score, torch.zeros(blocks, len(groups)))]
    while members and step < settings.steps:
        for _ in range(min(settings.every, settings.steps - step)):
            _advance(members, target, whiten, predict, [fold != k for k in range(folds)])
            step += 1
            on_step(step)
        with torch.no_grad():
            white = target - whiten(torch.stack([predict(member.module) for member in members]))
            left = 0.5 * white.square().gather(0, fold.expand_as(base)[None])[0]
        won = torch.zeros(len(base), blocks).index_add(1, block, base - left)
        looks.append((step, float(left.sum()), torch.stack([won[list(g)].sum(0) for g in groups], 1)))
        if looks[-1][1] < best_score:
            best_score, best_step = looks[-1][1], step
        if step - best_step >= settings.patience * settings.every:
            break
    gains = torch.stack([gain for *_, gain in looks])  # (looks, blocks, groups)
    best = gains.sum(1).argmax(0)
    at_best = torch.stack([gains[int(k), :, g] for g, k in enumerate(best)], 1)
    gain = at_best.sum(0)
    error = at_best.std(0) * blocks**0.5 if members else torch.full_like(gain, torch.inf)
    kept = [g for g in range(len(groups)) if keep[g] or float(gain[g]) > SURE * float(error[g])]
    if members:
        chosen = looks[int(gains[:, :, kept].sum((1, 2)).argmax())][0] if kept else 0
    else:  # nothing can be left out
        chosen = settings.steps if kept else 0
    whole = _Member(module, settings)
    everything = torch.ones(len(series), dtype=torch.bool)
    for k in range(chosen):
        _advance([whole], target, whiten, predict, [everything])
        on_step(step + k + 1)
    spread = torch.zeros(len(change))
    live = [c for g in kept for c in groups[g]]
    if members and live:
        with torch.no_grad():
            said = torch.stack([predict(member.module)[live] for member in members])
        # the jackknife over folds: what the networks would say of other data
        spread[live] = ((folds - 1) * said.var(0, correction=0)).mean(1).sqrt()
    return Learned(
        spread=tuple(spread.tolist()),
        steps=chosen,
        tried=step,
        kept=tuple(g in kept for g in range(len(groups))),
        before=float(2.0 * base.mean()),
        after=2.0 * next(score for at, score, _ in looks if at == (chosen if members else 0)) / base.numel(),
        gain=tuple(gain.tolist()),
        error=tuple(error.tolist()),
        history=tuple((at, 2.0 * score / base.numel()) for at, score, _ in looks),
    )


class _Purged:
    """Whitened rows without what nuisance columns explain of them, channel by channel."""

    def __init__(self, whiten: Whitening, nuisance: Tensor, channels: int) -> None:
        self._whiten = whiten
        self._basis = torch.zeros(channels, len(nuisance), 0)
        if not nuisance.shape[1]:
            return
        # (channels, N, p): the same columns through the filter of each channel
        rows = whiten(nuisance.T[:, None].expand(-1, channels, -1)).permute(1, 2, 0)
        size = rows.norm(dim=1, keepdim=True).clamp_min(1e-12)
        u, value, _ = torch.linalg.svd(rows / size, full_matrices=False)
        self._basis = u * (value > _RANK * value[:, :1])[:, None, :]

    def __call__(self, rows: Tensor) -> Tensor:
        """Whitened rows (..., channels, N) of rows (..., channels, N)."""
        white = self._whiten(rows)
        if not self._basis.shape[2]:
            return white
        flat = white.reshape(-1, *white.shape[-2:]).transpose(0, 1)  # all members read the basis once
        part = (flat @ self._basis) @ self._basis.transpose(1, 2)
        return white - part.transpose(0, 1).reshape(white.shape)


class _Member:
    """Networks under optimisation."""

    def __init__(self, module: nn.Module, settings: NetworkSettings) -> None:
        self.module, self.penalty = module, lambda: settings.penalty(module)
        parameters = [p for p in module.parameters() if p.requires_grad]
        self._optimiser = torch.optim.Adam(parameters, lr=settings.rate, foreach=True)
        self._schedule = torch.optim.lr_scheduler.LinearLR(
            self._optimiser, 1.0, _RATE_END, total_iters=settings.steps
        )

    def reset(self) -> None:
        """Before a backward pass."""
        self._optimiser.zero_grad(set_to_none=True)

    def step(self) -> None:
        """After it."""
        self._optimiser.step()
        self._schedule.step()


def _advance(
    members: Sequence[_Member], target: Tensor, whiten: _Purged, predict: Predict, rows: Sequence[Tensor]
) -> None:
    """One gradient step of all members, each on its own rows."""
    for member in members:
        member.reset()
    white = target - whiten(torch.stack([predict(member.module) for member in members]))
    losses = [
        0.5 * own[:, seen].square().mean() + member.penalty()
        for own, seen, member in zip(white, rows, members, strict=True)
    ]
    torch.stack(losses).sum().backward()
    for member in members:
        member.step()
