"""Noise levels of largest likelihood, by Fisher scoring with the filter linearised about states already found.

    g = d log p / d phi,    H = sum_k z_k' z_k + 1/2 tr(S^-1 dS S^-1 dS),    z = L^-1 de / d phi

Slopes are exact. H is made from a few chunks, which takes as long as ten filters,
and takes on what slopes change by along each step (Broyden, Fletcher, Goldfarb and Shanno): the log is not as the model
expects it to be. A weak prior holds levels that the data do not show where they started.

The gradient (`score`) takes one pass backwards over the rows. With the gain G, v = S^-1 e, w = 1 where the row counts,
and the adjoints a and A of the mean and covariance that a row's update leaves (all of what later rows say), those of
what was predicted for the row are

    a- = (I - G H)' a + w H' v
    A- = (I - G H)' A (I - G H) + sym[(I - G H)' a v' H] + w/2 H' (v v' - S^-1) H

and those of the row before F' a- and F' A- F. The noise of the sensors is reached by G' A G - sym[G' a v'] +
w/2 (v v' - S^-1), that of a step by A-, its transition by a- m' + 2 A- F P.

The slopes of the innovations (`level_slopes`) are those of one recursion forwards. With the closed loop
B = F (I - G H), m and P predicted for a row, and a prime before a name for the slope in one level,

    'P -> B 'P B^T + F G 'R G^T F^T + 'F P F^T + F P 'F^T + 'Q,      'm -> B ('m + 'P H^T v) - F G 'R v + 'F m
"""

from dataclasses import replace
from math import log

import torch
from torch import Tensor

from nsde_torch.inference import kernels
from nsde_torch.inference.filtering import Linearisation, Pass, filtered
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.sensitivity import bounded_step
from nsde_torch.inference.state_space import StateSpace
from nsde_torch.time_limit import check_time

_PRIOR = 0.02  # weight of the first guess: that of a hundredth of a nat for a factor of e
# simulations without noise: with 8, noise levels of the declared physics stop far above those beside any effect, which
# then passes for evidence of it (test_named.py)
_DOWN, _UP = 20.0, 6.0  # how far logarithms may go from there
LONGEST_S = 1.0
"""That a disturbance lasts, and a noise model remembers [s]: what lasts longer is structure.

Without it a steady force is learned as a gust without end, and not named (bench_friction_drive.py,
test_a_steady_push_is_no_gust_that_never_ends).
"""
SHORTEST = 1.0
"""That a disturbance lasts [steps]: what lasts less is the white one, from which there is no way back.

Without it the disturbance of the yaw of the published flights ended as white noise beside one effect and not beside
another, which seemed to cost 500 nats, and no lag of the motors was named.
"""
# with 3, levels that would rather vanish jump there, and half of all steps are in vain: twice the passes (of a
# hexacopter's flights 397 for 213)
_LONGEST_STEP = 1.0
_TURNS = 12
_GAIN = 0.5  # nats for which another turn is taken
# without it the levels of a cart's lag end 47 nats below (tests/inference/test_fit.py)
_HOLDS = 0.1  # share of the nats that a step promises, from which its information is used again
_VANISHES = 0.1  # nats that a level has to bring by vanishing, to go down
_CURVED = 0.01  # of the curvature expected, below which a step shows none
_DAMPING, _MOST_DAMPING = 0.1, 1e4  # less than the first makes steps hardly longer
_INFORMING = 500  # rows that the information is made from
_ENTRIES = 16_000_000  # numbers of a pass with its covariances that are kept at once; longer logs go in parts


@torch.no_grad()
def likeliest(
    space: StateSpace,
    levels: Levels,
    first: Levels,
    about: Linearisation,
    known: Tensor | None = None,
    *,
    least: float = 0.0,
    rows: int | None = None,
) -> tuple[Levels, Tensor, Pass | None]:
    """Levels of larger likelihood than the given ones, or these; their information, and the pass there if at hand.

    Args:
        space: The machine at the values in use, and the log.
        levels: Where to begin.
        first: The first guess, which the prior holds to.
        known: The information of levels close by, which decides whether to begin at all.
        least: Nats that a step has to promise.
        rows: How many rows are enough, evenly from all of the log; None takes all of them.
    """
    phi, prior = levels.vector(), first.vector()
    low, high = prior - _DOWN, prior + _UP
    # of a simulation without noise nothing is missing (tests/diagnosis/test_named.py)
    low[: len(space.least_sensor)].clamp_(min=space.least_sensor)
    high = torch.maximum(high, low)
    longest = LONGEST_S * space.steps.pace
    high[-space.nd :].clamp_max_(log(longest))
    low[-space.nd :].clamp_min_(log(min(SHORTEST * space.h, 0.1 * longest)))
    phi = torch.minimum(torch.maximum(phi, low), high)
    at_once = _most(space)
    some = evenly(space.chunks.count, space.chunks.count if rows is None else _chunks_of(space, rows))
    near = about if len(some) == space.chunks.count else about.of(some)
    live = space.chunks.counted[:, some]
    share = float(space.chunks.counted.sum() / live.sum().clamp_min(1))
    few = evenly(len(some), _chunks_of(space, _INFORMING))
    inflated = float(live.sum() / live[:, few].sum().clamp_min(1)) * share
    split = torch.arange(len(some)).split(at_once)
    parts = [(near.of(part), live[:, part]) for part in split] if len(split) > 1 else [(near, live)]

    def passed(values: Tensor, part: tuple[Linearisation, Tensor], covariances: int = space.nd) -> Pass:
        return filtered(space, levels.like(values), part[0], part[1], covariances=covariances)

    def tried(values: Tensor) -> tuple[Pass | None, float]:
        """What is to be large, and the pass where it is a single one."""
        here = passed(values, parts[0]) if len(parts) == 1 else None
        each = [here] if here else (passed(values, part, covariances=0) for part in parts)
        total = share * sum(one.total for one in each)
        return here, total - 0.5 * _PRIOR * float((values - prior).square().sum())

    def slope(values: Tensor, here: Pass | None) -> Tensor:
        pulled = torch.zeros_like(values)
        for part in parts:
            one = here or passed(values, part)
            pulled += score(space, levels.like(values), part[0], one, part[1]).sum(0)
        return share * pulled - _PRIOR * (values - prior)

    def information(values: Tensor, here: Pass | None) -> Tensor:
        about_few, live_few = near.of(few), live[:, few]
        one = passed(values, (about_few, live_few)) if here is None else here.of(few)
        found = _information(space, levels.like(values), about_few, one, live_few)
        return inflated * found + _PRIOR * torch.eye(len(values), dtype=values.dtype)

    sizes = torch.arange(len(phi)) < len(phi) - space.nd  # the others are times

    def step(gradient: Tensor, known: Tensor, damping: float) -> tuple[Tensor, float]:
        """The best one inside the bounds that goes no level too far, and the nats that it promises.

        Scoring is of variances, v -> v (1 + 2 step), which for a single one ends at its optimum at once; of logarithms
        it takes half a nat off at most each time, and goes e^50 too far up.
        """
        if not bool(torch.isfinite(gradient).all() and torch.isfinite(known).all()):
            return torch.zeros_like(phi), 0.0  # the filter has diverged
        ends = [(low - phi).clamp_min(-_LONGEST_STEP), (high - phi).clamp_max(_LONGEST_STEP)]
        # what little a level would bring by vanishing keeps it: from nothing there is no way back, and of the published
        # flights levels that fell there beside a first theta stayed, 2,700 nats below
        ends[0] = torch.where(sizes & (-0.5 * gradient < _VANISHES), 0.0, ends[0])
        down, up = (torch.where(sizes, 0.5 * torch.expm1(2.0 * end), end).numpy() for end in ends)
        # as a whole, it was as short as the flattest level wants it: of NanoBench, with white noise near nothing on
        # the moments, all others moved by a tenth of what they should, and levels ended 9,000 nats below
        found = torch.from_numpy(bounded_step(known.numpy(), gradient.numpy(), damping, down, up))
        promised = float(gradient @ found - 0.5 * found @ known @ found)
        return torch.where(sizes, 0.5 * torch.log1p(2.0 * found), found), promised

    here, best = tried(phi)
    damping, fresh, before, enough = _DAMPING, False, None, 0.5 * max(_GAIN, least)
    for _ in range(_TURNS):
        check_time()
        gradient = slope(phi, here)
        if known is not None and before is not None:
            known = _curved(known, phi - before[0], before[1] - gradient)
        before = phi, gradient
        promised = 0.0 if known is None else step(gradient, known, 0.0)[1]
        # information from elsewhere that promises little does not end the iteration either, as below
        if known is None or (not fresh and promised < enough):
            known, fresh, damping = information(phi, here), True, _DAMPING
            promised = step(gradient, known, 0.0)[1]
        if promised < enough:
            break
        gained = 0.0
        while damping <= _MOST_DAMPING:
            moved, nats = step(gradient, known, damping)
            if nats < enough:
                break
            there, value = tried(phi + moved)
            if value > best:
                phi, here, gained, best = phi + moved, there, value - best, value
                break
            damping *= 10.0
        damping = max(damping / 10.0, _DAMPING)
        if fresh and not gained:
            break
        # what promised far more than it brought is of another place, and a step that brings little may lead to the
        # other side of a hill: levels stopped 6 to 275 nats below, which whatever was tried next brought, a sinusoid
        # that is not there too
        if not gained > max(_GAIN, _HOLDS * promised):
            known = None
        fresh = False
    if known is None:
        known = information(phi, here)
    whole = None if rows is not None or here is None else replace(here, covariance=None)
    return levels.like(phi), known, whole


@torch.no_grad()
def level_columns(space: StateSpace, levels: Levels, about: Linearisation) -> Tensor:
    """What the levels do to the whitened innovations (T, C, m, p): nuisances beside theta, above all under feedback."""
    out = about.seen.new_empty(*about.seen.shape, len(space.observed) + 3 * space.nd)
    for some in torch.arange(space.chunks.count).split(_most(space)):
        check_time()
        near = about.of(some)
        here = filtered(space, levels, near, space.chunks.counted[:, some], covariances=space.nd)
        out[:, some] = -level_slopes(space, levels, near, here)[0]
    return out


def _curved(known: Tensor, moved: Tensor, bent: Tensor) -> Tensor:
    """An information (p, p) that has the curvature of a step (p,): what the slope fell by along it (p,)."""
    expected = known @ moved
    if not float(moved @ bent) > _CURVED * float(moved @ expected):
        return known
    gained = torch.outer(bent, bent) / (moved @ bent)
    return known + gained - torch.outer(expected, expected) / (moved @ expected)


def _most(space: StateSpace) -> int:
    """How many chunks are worked on at once."""
    return max(1, _ENTRIES // (space.chunks.size * space.n * (len(space.observed) + space.nd)))


def evenly(count: int, most: int) -> Tensor:
    """Numbers of at most so many chunks, evenly over the log."""
    return torch.linspace(0, count - 1, min(count, max(1, most))).round().long()


def _chunks_of(space: StateSpace, rows: int) -> int:
    """About how many chunks count so many rows."""
    return max(1, round(rows * space.chunks.count / float(space.chunks.counted.sum())))


def _information(space: StateSpace, levels: Levels, about: Linearisation, at: Pass, live: Tensor) -> Tensor:
    """Fisher information (p, p) of the levels from a pass."""
    z, turned = level_slopes(space, levels, about, at, spreads=True)
    assert turned is not None
    z = z[live].reshape(-1, z.shape[-1])
    spread = turned[live].transpose(0, 1).flatten(1)
    return z.T @ z + 0.5 * spread @ spread.T


# ---- what levels do to a pass ------------------------------------------------------------------------


@torch.no_grad()
def score(space: StateSpace, levels: Levels, about: Linearisation, at: Pass, live: Tensor) -> Tensor:
    """Gradient of the log likelihood of a pass with covariances, by chunk (C, m + 3 d), of the `live` rows (T, C)."""
    h, keep = space.h, levels.keep(space.h)
    count, m, d = at.errors.shape[1], len(space.observed), space.nd
    sensors, struck, gusts, begun, kept = (at.errors.new_empty(count, k) for k in (m, d, d, d, d))
    read, filled = _of_pass(space, levels, about, at), (sensors, struck, gusts, begun, kept)
    kernels.in_parts(kernels.adjoints, *at.errors.shape[:2], *read, live, *filled)
    gust = torch.exp(2.0 * levels.gust)
    slopes = (
        2.0 * torch.exp(2.0 * levels.sensor) * sensors,
        2.0 * torch.exp(2.0 * levels.white) / h * struck,
        2.0 * gust * (gusts * (1.0 - keep.square()) + begun),
        _in_time_constant(levels, h) * (kept - 2.0 * keep * gust * gusts),
    )
    return torch.cat(slopes, -1)


@torch.no_grad()
def level_slopes(
    space: StateSpace, levels: Levels, about: Linearisation, at: Pass, *, spreads: bool = False
) -> tuple[Tensor, Tensor | None]:
    """Slopes of the whitened innovations (T, C, m, p) in each level, and of their whitened covariances (T, C, p, m, m).

    The latter with `spreads` alone; the pass has its covariances.
    """
    rows, count, m = at.errors.shape
    p = m + 3 * space.nd
    z = at.errors.new_empty(rows, count, m, p)
    turned = at.errors.new_empty((rows, count, p, m, m) if spreads else (0,) * 5)
    white, gust, sensor = (torch.exp(2.0 * size) for size in (levels.white, levels.gust, levels.sensor))
    noise = (_in_time_constant(levels, space.h), white / space.h, gust, sensor)
    read = _of_pass(space, levels, about, at)
    kernels.in_parts(kernels.slopes_in_levels, rows, count, *read, *noise, z, turned)
    return z, turned if spreads else None


def _of_pass(space: StateSpace, levels: Levels, about: Linearisation, at: Pass) -> list[Tensor | list[int]]:
    """What both kernels take of a pass."""
    assert at.covariance is not None
    found = (at.whitening, at.gain, at.white, at.delta, at.covariance[..., -space.nd :])
    return [about.slopes, levels.keep(space.h), space.observed, *found]


def _in_time_constant(levels: Levels, h: float) -> Tensor:
    """Slope of the decay of a disturbance over a step in the logarithm of its time constant (d,)."""
    return levels.keep(h) * h / torch.exp(levels.lasts)
