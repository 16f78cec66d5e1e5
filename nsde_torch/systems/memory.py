"""Memory of the effects at the start of a prediction, from the inputs before it.

    m(t0 - K h) stationary under u_before[:, 0];   then m' = memory_rate(x0, u_before[:, k], m) over K steps of h

The state is held at x0 all the while, which is assumed: memory of inputs (lags, delays) does not read it, and that of
other effects is right only as far as the state stays where it is. Effects of `whole_steps` are exact for inputs that
are held over each step, however long it is. Others are followed by Runge and Kutta's method in shorter steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from math import ceil
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from nsde_torch.columns import join_columns, split_columns
from nsde_torch.effects.base import Effect, Port
from nsde_torch.errors import ShapeError

if TYPE_CHECKING:
    from nsde_torch.systems.base import System

MEMORY_S = 0.5
"""Time before a start that inputs are taken from [s]: ten time constants of motors; four fifths of one of 0.3 s."""

_FINE_S = 0.005


def remembered(system: System, x: Tensor, u: Tensor, u_before: Tensor | None, dt: float) -> Tensor:
    """See `System.remembered`."""
    if u_before is None or system.nz == system.nx:
        return system.augment(x, u)
    if u_before.ndim != 3 or u_before.shape[::2] != (len(x), u.shape[-1]) or not u_before.shape[1]:
        raise ShapeError(
            f"`u_before` must be (batch={len(x)}, steps, nu={u.shape[-1]}) with at least one step; got "
            f"{tuple(u_before.shape)}."
        )
    memory = split_columns(system.augment(x, u_before[:, 0]), system.nx, system.nz - system.nx)[1]
    parts = 1 if system.whole_steps else ceil(dt / _FINE_S)
    h, before = dt / parts, system.step
    system.set_step(h)
    try:
        for held in u_before.unbind(1):
            for _ in range(parts):
                memory = _advanced(system, x, memory, held, h)
    finally:
        system.set_step(before)
    return join_columns((x, memory))


def _advanced(system: System, x: Tensor, memory: Tensor, u: Tensor, h: float) -> Tensor:
    """Memory after a step (Euler's where that is exact, else Runge and Kutta's of fourth order)."""
    start = join_columns((x, memory))

    def rate(m: Tensor) -> Tensor:
        return system.memory_rate(0.0, system.inner(start, join_columns((x, m))), u)

    k1 = rate(memory)
    if system.whole_steps:
        return memory + h * k1
    k2 = rate(memory + 0.5 * h * k1)
    k3 = rate(memory + 0.5 * h * k2)
    k4 = rate(memory + h * k3)
    return memory + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)


def stationary(
    effects: Sequence[Effect],
    order: Sequence[int],
    seen: Callable[[int, Tensor], Tensor],
    x: Tensor,
    command: Tensor,
) -> list[Tensor]:
    """Memory of each effect that has one where it rests (N, its columns); arguments as of `held_memory`.

    `order` is the order in which effects are worked out, those on the input first.
    """
    starts: dict[int, Tensor] = {}
    for k in order:
        effect = effects[k]
        if effect.n_memory or effect.port is Port.INPUT:
            own = seen(k, command)
            starts[k] = effect.memory_start(x, own)
            if effect.port is Port.INPUT:
                command = command + effect(0.0, x, own, starts[k])
    return [starts[k] for k in sorted(starts)]


def held_within(system: System, z: Tensor, y: Tensor) -> Tensor:
    """See `System.inner`."""
    columns = system.held_columns
    if not columns:
        return y
    if len(columns) == system.nz - system.nx:
        parts = (system.nx, len(columns))
        return join_columns((split_columns(y, *parts)[0], split_columns(z, *parts)[1]))
    keep = torch.zeros(system.nz, dtype=torch.bool, device=z.device)
    keep[list(columns)] = True
    return torch.where(keep, z, y)


def held_columns(effects: Sequence[Effect], parts: Sequence[int]) -> tuple[int, ...]:
    """See `System.held_columns`; `parts` are the columns of the state and of each effect's memory."""
    ends = list(accumulate(parts))
    return tuple(
        column
        for effect, start, stop in zip(effects, ends[:-1], ends[1:], strict=True)
        if effect.step and effect.whole_steps
        for column in range(start, stop)
    )


def held_memory(
    effects: Sequence[Effect],
    on_input: Sequence[int],
    seen: Callable[[int, Tensor], Tensor],
    *,
    t: Tensor,
    x: Tensor,
    command: Tensor,
    dt: float,
) -> tuple[Tensor, Tensor]:
    """See `System.held_memory`; `seen` is what an effect reads as its input, from its place and the command so far."""
    ends = list(accumulate((effect.n_memory for effect in effects), initial=0))
    memory = x.new_zeros(len(x), ends[-1])
    known = torch.zeros(ends[-1], dtype=torch.bool)
    for k in on_input:
        effect, own, columns = effects[k], seen(k, command), slice(ends[k], ends[k + 1])
        if effect.n_memory:
            held = effect.held(own, dt)
            if held is None:
                break
            memory[:, columns], known[columns] = held, True
        command = command + effect(t, x, own, memory[:, columns])
    for k, effect in enumerate(effects):
        followed = effect.followed(x, dt) if k not in on_input else None
        if followed is not None:
            memory[:, ends[k] : ends[k + 1]], known[ends[k] : ends[k + 1]] = followed, True
    return memory, known
