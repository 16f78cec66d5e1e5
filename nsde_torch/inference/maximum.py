"""Noise levels of largest likelihood, by Fisher scoring with the filter linearised about states already found.

    g = d log p / d phi,    H = sum_k z_k' z_k + 1/2 tr(S^-1 dS S^-1 dS),    z = L^-1 de / d phi

Derivatives are differences: the filter runs with each level moved, all side by side. A weak prior holds levels that the
data do not show where they started.
"""

import torch
from torch import Tensor

from nsde_torch.inference.filtering import Linearisation, Pass, Start, filtered
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.state_space import StateSpace

_SMALL = 1e-3  # of a logarithm
_PRIOR = 0.02  # weight of the first guess: that of a hundredth of a nat for a factor of e
_DOWN, _UP = 8.0, 6.0  # how far logarithms may go from there
_LONGEST_STEP = 3.0
_TURNS, _LATER_TURNS = 4, 2
_GAIN = 0.5  # nats for which another turn is taken
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e4
_ENTRIES = (
    4_000_000  # of the innovations' covariances that are kept at once; chunks beyond are left out, evenly
)


@torch.no_grad()
def likeliest(
    space: StateSpace, levels: Levels, first: Levels, about: Linearisation, start: Start, *, turn: int
) -> Levels:
    """Levels of larger likelihood than the given ones, or these.

    Args:
        space: The machine at the values in use, and the log.
        levels: Where to begin.
        first: The first guess, which the prior holds to.
        about: What the filter is linearised about.
        start: Where each chunk starts.
        turn: How often this was asked before: few chunks do for the first levels, and more are looked at each time.
    """
    phi, prior = levels.vector(), first.vector()
    some = _some(space, (len(phi) + 1) // 2 ** min(turn, 2))
    near, live = about.of(some), space.chunks.counted[:, some]

    def tried(many: Tensor) -> Pass:
        return filtered(space, levels.like(many), near, start, live)

    def penalty(values: Tensor) -> Tensor:
        return 0.5 * _PRIOR * (values - prior).square().sum(-1)

    eye, damping = torch.eye(len(phi), dtype=phi.dtype), _FIRST_DAMPING
    for _ in range(_TURNS if turn == 0 else _LATER_TURNS):
        here = tried(torch.cat((phi[None], phi + _SMALL * eye)))
        nats = here.likelihood
        gradient = (nats[1:] - nats[0]) / _SMALL - _PRIOR * (phi - prior)
        information = _information(here, live) + _PRIOR * eye
        best, better, gained = nats[0] - penalty(phi), phi, 0.0
        while damping <= _MOST_DAMPING:
            damped = information + damping * torch.diag(torch.diagonal(information))
            step = torch.linalg.solve(damped, gradient).clamp(-_LONGEST_STEP, _LONGEST_STEP)
            if float(gradient @ step) < _GAIN:  # a whole step brings half of that
                break
            trial = torch.minimum(torch.maximum(phi + step, prior - _DOWN), prior + _UP)
            got = tried(trial[None]).likelihood[0] - penalty(trial)
            if got > best:
                better, gained = trial, float(got - best)
                break
            damping *= 10.0
        phi, damping = better, max(damping / 10.0, 1e-4)
        if not gained > _GAIN:
            break
    return levels.like(phi)


@torch.no_grad()
def level_columns(space: StateSpace, levels: Levels, about: Linearisation, start: Start, at: Pass) -> Tensor:
    """What the levels do to the whitened innovations (T, C, m, p): nuisances beside theta, above all under feedback."""
    phi, live = levels.vector(), space.chunks.counted
    entries = space.chunks.size * space.chunks.count * len(space.observed) * (space.n + len(space.observed))
    many, out = max(1, _ENTRIES // entries), []
    moved = phi + _SMALL * torch.eye(len(phi), dtype=phi.dtype)
    for part in moved.split(many):
        there = filtered(space, levels.like(part), about, start, live)
        out.append((at.whitening @ ((at.errors - there.errors) / _SMALL)[..., None])[..., 0])
    return torch.cat(out, 2).transpose(2, 3)


def _some(space: StateSpace, batch: int) -> Tensor:
    """Numbers of the chunks that are looked at."""
    most = max(4, _ENTRIES // (max(batch, 1) * space.chunks.size * len(space.observed) * space.n))
    return torch.linspace(0, space.chunks.count - 1, min(space.chunks.count, most)).round().long()


def _information(here: Pass, live: Tensor) -> Tensor:
    """Fisher information (p, p) from a pass with unmoved levels and those with one moved each."""
    base, counted = here.whitening[:, :, :1], live[..., None, None]
    z = (base @ ((here.errors[:, :, 1:] - here.errors[:, :, :1]) / _SMALL)[..., None])[..., 0]
    z = torch.where(counted, z, 0.0).transpose(2, 3).reshape(-1, z.shape[2])
    # L^-1 dL = -(dL^-1) L, whose symmetric part is that of S
    eye = torch.eye(base.shape[-1], dtype=base.dtype).expand_as(base)
    drift = (here.whitening[:, :, 1:] - base) / _SMALL @ torch.linalg.solve_triangular(base, eye, upper=False)
    both = torch.where(counted[..., None], drift + drift.transpose(-1, -2), 0.0)
    spread = both.movedim(2, -1).reshape(-1, both.shape[2])
    return z.T @ z + 0.5 * spread.T @ spread
