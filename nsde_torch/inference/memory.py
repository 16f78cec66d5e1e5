"""Extra states of effects (lags) along measured runs: m' = memory_rate(t, x, u, m), x and u as measured.

The segments are cut into pieces that advance side by side. A piece starts where its predecessor ended in the
sweep before; sweeps are repeated until no start moves. A memory that fades takes two or three sweeps, one that
does not takes as many as a segment has pieces, and then is the sequential solution all the same. A segment starts where
its `run_in` ended; what starts without one is stationary. What effects know exactly of held inputs (`Effect.held`: a
delay, a lag) is taken from them: its mean over each step, for both ends.
"""

import torch
from torch import Tensor

from nsde_torch.inference.steps import Steps
from nsde_torch.systems import System

_PIECE = 50
_TOLERANCE = 1e-9


def memory_along(system: System, steps: Steps) -> tuple[Tensor, Tensor]:
    """Memory at both ends of every step, or its mean over the step for both, (N, nz - nx) each."""
    starts, exact, known = _held(system, steps)
    if bool(known.all()):
        return starts, exact
    edges, chained = [], []
    for a, b in steps.segments:
        firsts = list(range(a, b, _PIECE))
        edges += [(f, min(f + _PIECE, b)) for f in firsts]
        chained += [False] + [True] * (len(firsts) - 1)
    first = torch.tensor([a for a, _ in edges])
    length = torch.tensor([b - a for a, b in edges])
    follows = torch.tensor(chained)[:, None]
    count = torch.arange(int(length.max()))
    inside = count < length[:, None]
    rows = torch.where(inside, first[:, None] + count, first[:, None])

    def by_time(values: Tensor) -> tuple[Tensor, ...]:
        return values[rows.T].unbind(0)

    x0, x1, u, t = (by_time(v) for v in (steps.x0, steps.x1, steps.u, steps.t))
    middle = by_time(system.project(0.5 * (steps.x0 + steps.x1)))
    live = inside.T[..., None].unbind(0)
    h, logged, given = steps.dt, steps.logged_dt, by_time(0.5 * (starts + exact))

    def rate(t: Tensor, x: Tensor, u: Tensor, m: Tensor) -> Tensor:
        moving = system.memory_rate(t, torch.cat((x, m), 1), u)
        return moving.masked_fill(known, 0.0)

    def advance(k: int, m: Tensor) -> Tensor:
        k1 = rate(t[k], x0[k], u[k], m)
        k2 = rate(t[k] + 0.5 * logged, middle[k], u[k], m + 0.5 * h * k1)
        k3 = rate(t[k] + 0.5 * logged, middle[k], u[k], m + 0.5 * h * k2)
        k4 = rate(t[k] + logged, x1[k], u[k], m + h * k3)
        return m + (h / 6) * (k1 + 2.0 * (k2 + k3) + k4)

    start = system.augment(x0[0], u[0])[:, system.nx :]
    if steps.run_in is not None:
        ends = memory_along(system, steps.run_in)[1]
        last = ends[[b - 1 for _, b in steps.run_in.segments]]
        start = start.index_copy(0, torch.nonzero(~follows[:, 0])[:, 0], last)
    for _ in range(len(edges)):
        m, before, after = start, [], []
        for k in range(len(count)):
            m = torch.where(known, given[k], m)
            before.append(m)
            m = torch.where(known, given[k], torch.where(live[k], advance(k, m), m))
            after.append(m)
        moved = torch.where(follows, torch.cat((start[:1], m[:-1])), start)
        change, size = float((moved - start).abs().max()), float(start.abs().max())
        start = moved
        if not change > _TOLERANCE * max(1.0, size):
            break
    out = torch.stack(before, 1)[inside], torch.stack(after, 1)[inside]  # pieces are in order
    return torch.where(known, starts, out[0]), torch.where(known, exact, out[1])


def _held(system: System, steps: Steps) -> tuple[Tensor, Tensor, Tensor]:
    """Memory that effects know exactly, as `System.held_memory` has it."""
    starts, parts = [], []
    for i, (a, b) in enumerate(steps.segments):
        t, x, u, lead = steps.t[a:b], steps.x0[a:b], steps.u[a:b], 0
        if steps.run_in is not None:
            c, d = steps.run_in.segments[i]
            t, x, u = (
                torch.cat((before[c:d], own))
                for before, own in ((steps.run_in.t, t), (steps.run_in.x0, x), (steps.run_in.u, u))
            )
            lead = d - c
        before, after, known = system.held_memory(t, x, u, steps.dt)
        starts.append(before[lead:])
        parts.append(after[lead:])
    return torch.cat(starts), torch.cat(parts), known
