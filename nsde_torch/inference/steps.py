"""Runs as steps, both ends of every interval between samples with the input held over it, and steps as chunks.

Where effects carry memory (a lag), what they held when a recording began is unknown. The first steps of each segment,
or those before it where rows were left out, then only bring it up: they are `run_in`, and no equation is asked of them.

States that were smoothed before they were logged are restored up to a frequency f_r (`Run.low_pass`),

    x_L = P x,    P a low pass at f_r:      x_L(k+1) - x_L(k) = P [step(x, u) - x](k)

What lies above f_r is removed from the states, and not from the inputs. So what a step does, and what parameters do to
a step, goes through P as well (it commutes with differences in time; of the state itself what lies above f_r is small
beside what the inputs do). And x_L is no new measurement in each row: it is one in every 1 / (f_r dt) rows. Taken at
f_r and not at twice that, what moves between half of f_r and f_r is folded back, which makes the increments of x_L
nearly white, as they are of a state itself.
"""

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, final

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.columns import by_column
from nsde_torch.data import Run
from nsde_torch.data.denoise import denoised
from nsde_torch.effects.base import PACE
from nsde_torch.effects.by_run import RUN
from nsde_torch.effects.law import joined_name
from nsde_torch.errors import DataError
from nsde_torch.systems import System

_Stretch = tuple[int, int, int]  # run, first row, last row + 1

_SOME = 100
MOST = 300_000  # steps that are looked at; of longer data, stretches spread evenly
_STRETCH = 5_000
RUN_IN_S, RUN_IN_SHARE = 0.4, 0.1
"""Time in which memory comes up, eight time constants of a motor [s]; of short segments, a share of their rows."""
RUN_IN_STEPS, RUN_IN_PART = 30, 0.05
"""The same of slow logs, in steps and a share: of a reactor at 10 Hz an unsettled lag of 0.93 s was one of 0.75 s."""


@dataclass(frozen=True)
class Steps:
    """Steps of some runs, segment after segment (float64)."""

    t: Tensor  # logged time of the start of each step (N,) [s]
    x0: Tensor
    x1: Tensor  # x0, x1: states at both ends (N, nx), without white sensor noise if they were smoothed
    seen0: Tensor
    seen1: Tensor  # seen0, seen1: the same as measured
    u: Tensor  # inputs and exogenous channels held over the step (N, nu + n)
    logged_dt: float  # length of a step [s] on the clock of the log
    dt: float  # the same in physical seconds
    segments: tuple[tuple[int, int], ...]  # ranges (first, last + 1) of steps without a gap
    runs: tuple[int, ...]  # number of the run of each segment
    run_in: "Steps | None" = None
    """The steps before each segment, for memory alone; None where no effect carries any."""
    # columns of rates that were inferred from positions, and what is not known of them (standard deviation):
    # `seen0`, `seen1` are then differences of the position over `rows` rows
    inferred: tuple[tuple[int, float], ...] = ()
    rows: int = 1  # rows of these differences
    pace: float = 1.0  # that of the runs

    def __len__(self) -> int:
        return len(self.t)

    @property
    def starts(self) -> Tensor:
        """Row at which the segment of each step starts (N,)."""
        out = torch.empty(len(self), dtype=torch.long)
        for a, b in self.segments:
            out[a:b] = a
        return out

    def some(self) -> tuple[Tensor, Tensor, Tensor]:
        """Times (N,), states (N, nx) and inputs (N, nu + n) of at most a hundred steps, evenly from all of them."""
        rows = torch.linspace(0, len(self) - 1, min(len(self), _SOME)).long()
        return self.t[rows], self.x0[rows], self.u[rows]

    def of(self, stretches: Sequence[int]) -> "tuple[Steps, Tensor]":
        """Those of some segments, by number, and the numbers of these steps."""
        rows = torch.cat([torch.arange(*self.segments[i]) for i in stretches])
        ends = np.cumsum([0, *(b - a for a, b in (self.segments[i] for i in stretches))]).tolist()
        parts = {key: getattr(self, key)[rows] for key in ("t", "x0", "x1", "seen0", "seen1", "u")}
        runs = tuple(self.runs[i] for i in stretches)
        run_in = None if self.run_in is None else self.run_in.of(stretches)[0]
        return replace(self, **parts, segments=tuple(pairwise(ends)), runs=runs, run_in=run_in), rows


def steps_of(
    system: System,
    runs: Sequence[Run],
    *,
    clock: float,
    smooth: bool = False,
    shortest: int = 1,
    run_in: bool | None = None,
    denoise: bool = False,
    differences: int = 1,
    low_passed: bool = False,
) -> Steps:
    """Cut runs into steps.

    Args:
        smooth: Whether white sensor noise is taken out of the states and of their changes.
        shortest: Segments of fewer steps are left out.
        denoise: Whether it is taken out of the states alone, at which physics is evaluated.
        differences: Rows over which positions are differenced where their rates were inferred; 0 takes these as
            inferred.
        run_in: Whether to keep the first steps of each segment for memory alone; None: where an effect has any.
        low_passed: Whether states that were smoothed come without what stands above the band that was restored.

    Raises:
        DataError: no run, no segment that is long enough, or nothing moves.
    """
    if not runs:
        raise DataError("no run to identify the physics from.")
    if not any((run.x != run.x[0]).any() for run in runs):
        raise DataError(
            f"nothing moves: {', '.join(system.state_names)} never change. If these columns are no measurements, write "
            "what the sensors measured. Record runs in which the machine moves."
        )
    seen = [
        low_passed_states(system, run, clock) if low_passed and run.low_pass else np.asarray(run.x)
        for run in runs
    ]
    clean = list(denoised(runs)[0]) if smooth or denoise else seen
    unknown = inferred_columns(system, runs) if differences else {}
    if unknown:
        clean = [np.array(x) for x in clean]
        for x, run in zip(clean, runs, strict=True):  # what a filter knows is no noisy measurement
            x[:, list(unknown)] = run.x[:, list(unknown)]
        seen = [_differenced(system, run, runs[0].dt * clock, differences) for run in runs]
    states = list(zip(clean if smooth else seen, clean, strict=True))
    lead = differences if unknown else 0  # rows before a difference
    stretches = [(n, a + lead, b) for n, a, b in _stretches(runs) if b - 1 - a - lead >= shortest]
    if not stretches:
        raise _too_short(shortest, (b - 1 - a - lead for _, a, b in _stretches(runs)), runs[0].dt)
    if not (system.nz > system.nx if run_in is None else run_in):
        return _joined(system, runs, states, stretches, clock, unknown, differences)
    most = max(1, round(RUN_IN_S * runs[0].pace / runs[0].dt))
    begun = [_run_in(runs[n], a, b, lead, most) for n, a, b in stretches]
    whole = zip(stretches, begun, strict=True)
    pairs = [(s, first, start) for s, (first, start) in whole if s[2] - 1 - start >= shortest]
    if not pairs:
        counts = (b - 1 - start for (_, _, b), (_, start) in zip(stretches, begun, strict=True))
        raise _too_short(shortest, counts, runs[0].dt)
    before = [(n, first, start + 1) for (n, _, _), first, start in pairs]
    counted = [(n, start, b) for (n, _, b), _, start in pairs]
    own, run_in_steps = (
        _joined(system, runs, states, some, clock, unknown, differences) for some in (counted, before)
    )
    return replace(own, run_in=run_in_steps)


def _too_short(shortest: int, lengths: Iterable[int], dt: float) -> DataError:
    longest = max(lengths, default=0)
    return DataError(
        f"no stretch of {shortest} steps without a gap: the longest has {longest} ({longest * dt:.2g} s). Record runs "
        f"of {shortest * dt:.2g} s or more, or log faster."
    )


def _run_in(run: Run, a: int, b: int, lead: int, most: int) -> tuple[int, int]:
    """First row of the rows that bring memory up to a stretch (a, b), and the row from which its equations count.

    Rows before the stretch do so where there are any without a gap; else its own first ones do.
    """
    whole = [start + lead for start, end in run.unbroken if start + lead <= a < end]
    first = max(*whole, a - most) if whole else a
    if a - first >= most:
        return first, a
    own = min(most - (a - first), int(RUN_IN_SHARE * (b - 1 - a)))
    own = max(own, min(RUN_IN_STEPS - (a - first), int(RUN_IN_PART * (b - 1 - a))))
    return first, a + max(own, 1 if first == a else 0)


def inferred_columns(system: System, runs: Sequence[Run]) -> dict[int, float]:
    """Columns of rates that were inferred from positions, and what is not known of them; DataError: in some runs."""
    names = {name for run in runs for name in run.inferred}
    lacking = [run.name for run in runs if set(run.inferred) != names]
    if lacking:
        raise DataError(
            f"{', '.join(sorted(names))} were inferred in other runs than {lacking[0]!r}: read all runs in one way."
        )
    return {system.state_names.index(n): max(run.inferred[n] for run in runs) for n in sorted(names)}


def _differenced(system: System, run: Run, dt: float, rows: int) -> Array:
    """States (n, nx) with differences of positions over some rows before for rates that were inferred."""
    x, names = np.array(run.x), list(system.state_names)
    for position, rate, _ in system.position_derivatives:
        if rate in run.inferred:
            q = x[:, names.index(position)]
            x[rows:, names.index(rate)] = (q[rows:] - q[:-rows]) / (rows * dt)
    return x


def _joined(
    system: System,
    runs: Sequence[Run],
    states: Sequence[tuple[Array, Array]],
    stretches: Sequence[_Stretch],
    clock: float,
    inferred: Mapping[int, float],
    rows: int,
) -> Steps:
    names = ("t", "x0", "x1", "seen0", "seen1", "u")
    parts: dict[str, list[Array]] = {key: [] for key in names}
    segments, owners, at = [], [], 0
    for number, a, b in stretches:
        run, (seen, x) = runs[number], states[number]
        parts["t"].append(run.t[a : b - 1])
        parts["u"].append(run.u[a : b - 1])
        for name, values in (("x", x), ("seen", seen)):
            parts[f"{name}0"].append(values[a : b - 1])
            parts[f"{name}1"].append(values[a + 1 : b])
        segments.append((at, at + b - 1 - a))
        owners.append(number)
        at += b - 1 - a
    joined: dict[str, Any] = {key: torch.from_numpy(np.concatenate(rows)) for key, rows in parts.items()}
    joined |= {key: by_column(joined[key]) for key in names if key != "t"}
    joined |= {key: system.project(joined[key]) for key in names if key not in ("t", "u")}
    joined |= {"segments": tuple(segments), "runs": tuple(owners), "inferred": tuple(inferred.items())}
    first = runs[0]
    return Steps(**joined, logged_dt=first.dt, dt=first.dt * clock, rows=max(rows, 1), pace=first.pace)


def _stretches(runs: Sequence[Run]) -> Iterator[_Stretch]:
    """Run and rows of every stretch to look at: the segments, or of very long data some parts of them."""
    whole = [(number, a, b) for number, run in enumerate(runs) for a, b in run.segments]
    total = sum(b - a for _, a, b in whole)
    if total <= MOST:
        yield from whole
        return
    cut = [(n, c, min(c + _STRETCH, b)) for n, a, b in whole for c in range(a, b, _STRETCH)]
    cut = [(n, a, b) for n, a, b in cut if b - a >= 2]
    for i in np.linspace(0, len(cut) - 1, max(1, MOST // _STRETCH)).round().astype(int):
        yield cut[i]


# ---- sizes of data, which the shapes of effects are measured by (see `Effect.relative`) ----------------------

_COLUMNS = {"position": 0, "speed": 1, "rate": 3}
"""Of effects of the user's own that are no laws of a coordinate."""
_LEAST = 1e-6
_SELDOM = 0.02  # share of the rows whose inputs are smaller than the least
SLOW = 0.02  # share of the rows that are slower than a slow speed


def data_sizes(system: System, steps: Steps) -> dict[str, float]:
    """95 % quantiles of absolute values of the inputs and of the states that effects see, and the step [s].

    With the share of the rows in which inputs have the sign that is rarer, of all together that of the one with least,
    and the number of runs where these have numbers.
    """

    def size(values: Tensor, share: float = 0.95, least: float = _LEAST) -> float:
        return (float(np.quantile(values.abs().numpy(), share)) if values.numel() else 1.0) or least

    out = {"input": size(steps.u[:, : system.nu]), "step": steps.dt, PACE: steps.pace}
    out |= {kind: size(steps.x0[:, k]) for kind, k in _COLUMNS.items() if k < system.nx}
    out["least input"] = size(steps.u[:, : system.nu], _SELDOM, 0.0)
    each = torch.minimum((steps.u > 0).double().mean(0), (steps.u < 0).double().mean(0))[: system.nu]
    out["rarer sign"] = float(each.min()) if len(each) else 0.0
    for one in system.single_inputs():
        out[joined_name("rarer sign", one.name)] = float(each[one.column])
        out[joined_name("input", one.name)] = size(steps.u[:, one.column])
        out[joined_name("least input", one.name)] = size(steps.u[:, one.column], _SELDOM, 0.0)
    if RUN in system.exogenous:
        out[RUN] = 1.0 + float(steps.u[:, system.nu + system.exogenous.index(RUN)].max())
    for at in system.bound_coordinates():
        out[joined_name("speed", at.name)] = size(steps.x0[:, at.velocity])
        out[joined_name("slow speed", at.name)] = size(steps.x0[:, at.velocity], SLOW)
        if at.position is not None:
            out[joined_name("position", at.name)] = size(steps.x0[:, at.position])
    return out


# ---- states that were smoothed, and restored up to a frequency ---------------------------------------


_INSIDE = 0.85  # of the band that was restored: its end gives way to noise
_FADES = 0.15  # of the frequency of a low pass, over which it fades
_AROUND = 20.0  # periods of that frequency by which a stretch is prolonged


def band_of(runs: Sequence[Run]) -> dict[str, float]:
    """Frequencies up to which states hold what was measured [Hz], of those with louder noise above."""
    names = {name for run in runs for name in run.low_pass}
    return {name: _INSIDE * min(run.low_pass[name] for run in runs if name in run.low_pass) for name in names}


def rows_apart(runs: Sequence[Run], band: Mapping[str, float], dt: float) -> dict[str, int]:
    """Rows from one measurement to the next, of states that are not measured anew in each row.

    That is so of those with a `band` [Hz], and of those whose noise is correlated from row to row (`Run.apart`).
    """
    out = {name: max(1, round(1.0 / (hz * dt))) for name, hz in band.items()}
    for run in runs:
        out |= {name: max(rows, out.get(name, 1)) for name, rows in run.apart.items()}
    return out


def low_passed_states(system: System, run: Run, clock: float) -> Array:
    """States (n, nx) of a run without what stands above the bands of those that were smoothed."""
    x = torch.from_numpy(np.array(run.x))
    for name, hz in band_of([run]).items():
        j = system.state_names.index(name)
        for a, b in run.unbroken or run.segments:
            x[a:b, j] = low_passed(x[a:b, j : j + 1], hz, run.dt * clock, level=True)[:, 0]
    return np.asarray(system.project(x).numpy())


def low_passed(values: Tensor, hz: float, dt: float, *, level: bool = False) -> Tensor:
    """Values (n, ...) of one stretch below a frequency [Hz].

    With `level` they go on beyond the ends as a line through these, as states do; else as they come, mirrored.
    """
    if not values.numel():  # of no parameter that is free
        return values
    n, some = len(values), max(1, int(1.0 / (hz * dt)))
    around = min(n - 1, int(_AROUND / (hz * dt)))
    before, behind = values[1 : around + 1].flip(0), values[n - 1 - around : n - 1].flip(0)
    line = torch.zeros_like(values[:1])
    if level:
        # about the mean of some rows at each end, so that neither values nor slopes jump there
        before = 2.0 * values[:some].mean(0) - before
        behind = 2.0 * values[-some:].mean(0) - behind
    longer = torch.cat((before, values, behind))
    if level:
        share = torch.linspace(0.0, 1.0, len(longer), dtype=values.dtype).view(-1, *(1,) * (values.dim() - 1))
        line = longer[:some].mean(0) + share * (longer[-some:].mean(0) - longer[:some].mean(0))
        longer = longer - line
    size = next_fast_len(len(longer), real=True)  # a prime takes five times as long
    f = torch.fft.rfftfreq(size, dt, dtype=torch.float64)
    keep = 0.5 * (1.0 + torch.cos(torch.pi * ((f - hz) / (_FADES * hz) + 1.0).clamp(0.0, 1.0)))
    spectrum = torch.fft.rfft(longer, size, dim=0) * keep.to(values.dtype).view(
        -1, *(1,) * (values.dim() - 1)
    )
    out = torch.fft.irfft(spectrum, size, dim=0)[: len(longer)] + line
    return out[around : around + n]


# ---- memory along steps ------------------------------------------------------------------------------


_PARTS = 20  # of a step, for how what is held over it changes there
_PIECE = 50
_TOLERANCE = 1e-9


def memory_along(system: System, steps: Steps) -> tuple[Tensor, Tensor]:
    """Memory at both ends of every step, or its mean over the step for both, (N, nz - nx) each.

    m' = memory_rate(t, x, u, m), x and u as measured. The segments are cut into pieces that advance side by side. A
    piece starts where its predecessor ended in the sweep before; sweeps are repeated until no start moves. A memory
    that fades takes two or three sweeps, one that does not takes as many as a segment has pieces, and then is the
    sequential solution all the same. A segment starts where its `run_in` ended; what starts without one is stationary.
    What effects know exactly of held inputs (`Effect.held`: a delay, a lag) is taken from them: its mean over each
    step, for both ends.
    """
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


def memory_moves(system: System, steps: Steps) -> tuple[Tensor]:
    """By how much memory changes over each step (N, nz - nx): what settles within the step follows it.

    Of what is known of held inputs as its mean over a step, that of the straight line nearest to `_PARTS` of it: a
    delay may jump within a step.
    """
    before, after = memory_along(system, steps)
    moves = after - before
    held = (moves == 0.0).all(0)
    if bool(held.any()):
        values = _held(system, steps, _PARTS)[0].view(len(moves), _PARTS, -1)
        weights = 12.0 / _PARTS * ((torch.arange(_PARTS, dtype=moves.dtype) + 0.5) / _PARTS - 0.5)
        moves[:, held] = torch.einsum("p,npk->nk", weights, values)[:, held]
    return (moves,)


def _held(system: System, steps: Steps, parts: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Memory that effects know exactly, as `System.held_memory` has it, over each of some parts of the steps."""
    starts, ends = [], []
    for i, (a, b) in enumerate(steps.segments):
        t, x, u, lead = steps.t[a:b], steps.x0[a:b], steps.u[a:b], 0
        if steps.run_in is not None:
            c, d = steps.run_in.segments[i]
            t, x, u = (
                torch.cat((before[c:d], own))
                for before, own in ((steps.run_in.t, t), (steps.run_in.x0, x), (steps.run_in.u, u))
            )
            lead = d - c
        t, x, u = (part.repeat_interleave(parts, 0) for part in (t, x, u))
        before, after, known = system.held_memory(t, x, u, steps.dt / parts)
        starts.append(before[lead * parts :])
        ends.append(after[lead * parts :])
    return torch.cat(starts), torch.cat(ends), known


def _running_products(step: Tensor) -> Tensor:
    """Of each matrix (N, k, k), the product of those before it, from the identity; in as many passes as N has bits."""
    out, reach = torch.cat((torch.eye(step.shape[-1]).to(step)[None], step[:-1])), 1
    while reach < len(out):
        out, reach = torch.cat((out[:reach], out[reach:] @ out[:-reach])), 2 * reach
    return out


def memory_as_measured(
    system: System,
    steps: Steps,
    memory: tuple[Tensor, Tensor],
    own: Sequence[int],
    residual: Callable[..., Tensor],
) -> tuple[Tensor, Tensor]:
    """Memory at both ends of every step; some columns of it start, in each segment, where least is left.

    Of an oven whose wall was 15 K colder than the air as each run began, residuals were larger with what it stores
    than without, and its time 7 % short.

    Args:
        memory: As `memory_along` has it.
        own: Those columns; a filter estimates them.
        residual: Of both, what is left of each step (N, channels).
    """
    own = list(own)
    size, before = memory[0][:, own].std(0) + 1e-12, residual(*memory)

    def rates(there: Tensor) -> Tensor:
        return system.memory_rate(steps.t, torch.cat((steps.x0, there), 1), steps.u)[:, own]

    still, slopes = rates(memory[0]), []
    for j, column in enumerate(own):
        moved = memory[0].clone()
        moved[:, column] += size[j]
        slopes.append((rates(moved) - still) / size[j])
    # of what starts elsewhere, to the next row
    step = torch.linalg.matrix_exp(steps.dt * torch.stack(slopes, 2))
    away = torch.cat([_running_products(step[a:b]) for a, b in steps.segments])
    ends, responses = (away, step @ away), []
    for j in range(len(own)):
        displaced = [part.clone() for part in memory]
        for part, there in zip(displaced, ends, strict=True):
            part[:, own] += size[j] * there[:, :, j]
        responses.append(residual(*displaced) - before)
    weight = before.square().mean(0).clamp_min(1e-300).rsqrt()
    columns, left = torch.stack(responses, 2) * weight[:, None], before * weight
    out = [part.clone() for part in memory]
    for a, b in steps.segments:
        rows = columns[a:b].flatten(0, 1)
        # what runs away has no start: of a load below a hexacopter whose thrust was fitted as a pull
        if not bool(torch.isfinite(rows).all()):
            continue
        beside = torch.cat((rows, torch.eye(len(own)).to(rows)))
        wanted = torch.cat((-left[a:b].flatten(), rows.new_zeros(len(own))))
        nearer = torch.linalg.lstsq(beside, wanted[:, None], driver="gelsd").solution[:, 0] * size
        for part, there in zip(out, ends, strict=True):
            part[a:b, own] += there[a:b] @ nearer
    return out[0], out[1]


# ---- chunks ------------------------------------------------------------------------------------------


# what is not counted of a chunk, and what is, where that is as many rows as below
_BURN_S, _LENGTH_S = 0.5, 2.0
_BURN, _LENGTH = (30, 300), (60, 600)  # fewest and most rows
_BLOCK_S = 0.5  # of a cluster of the robust covariance, at least
_FEWEST_BLOCKS = 20


@final
class Chunks:
    """The rows of some steps as chunks that overlap, (rows of a chunk, chunks, columns).

    Each chunk begins `burn` rows before those that it counts, where its filter starts from the measured row: what a
    filter knew long ago it has forgotten. Chunks advance side by side, so that a pass over a log of any length takes as
    many steps as one chunk is long.

    Args:
        late: Rows after the start of a stretch that are not counted either: there, a state that no sensor measures is
            known from what came later.
        every: Rows from one measurement of the slowest sensor to the next.

    Attributes:
        y: Measured states (T, C, nx).
        u: Inputs held from each row on (T, C, nu).
        t: Logged time of each row (T, C) [s].
        counted: Whether the innovation of a row is part of the likelihood (T, C).
        beyond: Whether a row lies beyond the end of its stretch, which is shorter than a chunk (T, C).
        stretch: Number of the stretch of each chunk (C,).
        row: Number of the step that starts at each row (T, C); of a last row, that of the one before.
        since: Rows since the start of the stretch (T, C).
        parts: Ranges of rows of a chunk that are one block of time each.
    """

    def __init__(self, steps: Steps, *, late: int = 0, every: int = 1) -> None:
        h = steps.dt
        # with states that no sensor measures, or not in each row, a filter remembers for longer
        slower = 2.0 if late or every > 1 else 1.0
        burn, length = (
            int(slower * np.clip(round(seconds * steps.pace / h), *rows))
            for seconds, rows in ((_BURN_S, _BURN), (_LENGTH_S, _LENGTH))
        )
        longest = max(b - a + 1 for a, b in steps.segments)
        size = min(burn + length, longest)
        first, counted, last, owners, stretch = [], [], [], [], []
        for number, ((a, b), owner) in enumerate(zip(steps.segments, steps.runs, strict=True)):
            done, end = a + 1, b + 1  # rows of a stretch: one more than its steps
            while done < end:
                start = max(a, min(done - burn, end - size))
                own = np.arange(start, start + size)
                counted.append((own >= max(done, a + 1 + late)) & (own < end))
                first.append(start)
                last.append(b)
                owners.append(owner)
                stretch.append(number)
                done = start + size
        begun, end_of = np.array(first), np.array(last)
        rows = begun[None, :] + np.arange(size)[:, None]
        ended = rows >= end_of[None, :]
        step = np.where(ended, end_of[None, :] - 1, rows)
        self.row = torch.from_numpy(step)
        self.since = torch.from_numpy(rows - np.array([steps.segments[s][0] for s in stretch]))
        self.y = torch.where(torch.from_numpy(ended)[..., None], steps.seen1[self.row], steps.seen0[self.row])
        self.u, self.t = steps.u[self.row], steps.t[self.row]
        self.counted = torch.from_numpy(np.array(counted).T.copy())
        self.beyond = torch.from_numpy(rows > end_of[None, :])
        total = int(self.counted.sum()) * h
        shortest = max(_BLOCK_S * steps.pace, 0.01 * total)
        block = max(1, round(min(shortest, total / _FEWEST_BLOCKS) / h))
        pieces = max(1, round(size / block))
        self.parts = [(size * p // pieces, size * (p + 1) // pieces) for p in range(pieces)]
        self.size, self.count = size, len(first)
        self._owners, self.stretch = torch.tensor(owners), torch.tensor(stretch)

    @property
    def follows(self) -> Tensor:
        """Whether the chunk before each holds its first row (C,): not of the first of a stretch."""
        row = self.row[0].diff(prepend=self.row[0, :1])
        return self.stretch.diff(prepend=self.stretch[:1] - 1).eq(0) & (row >= 0) & (row < self.size)

    def in_turn(self, values: Tensor) -> Tensor:
        """Values (T, C, k) at the first row of each chunk, from the one before it (C, k); of the first its own."""
        before = (torch.arange(self.count) - 1).clamp_min(0)
        return values[torch.where(self.follows, self.row[0] - self.row[0, before], 0), before]

    def some(self, which: Tensor) -> "Chunks":
        """Some of the chunks, by number."""
        out = copy.copy(self)
        rows = (self.row, self.since, self.y, self.u, self.t, self.counted, self.beyond)
        out.row, out.since, out.y, out.u, out.t, out.counted, out.beyond = (part[:, which] for part in rows)
        out._owners, out.stretch = self._owners[which], self.stretch[which]
        out.count = len(which)
        return out

    def cut(self, values: Tensor) -> Tensor:
        """Values of steps (N, k) at the rows of the chunks (T, C, k)."""
        return values[self.row]

    def blocks(self, values: Tensor) -> Array:
        """Those blocks of (parts, C, ...) in which any row counts (B, ...)."""
        live = torch.stack([self.counted[a:b].any(0) for a, b in self.parts])
        return np.asarray(values[live].numpy())

    def places(self) -> tuple[Labels, Labels]:
        """Number of the run of each block, and of the step that it begins with (B,), in the order of `blocks`."""
        count = len(self.parts)
        begun = self.row[[a for a, _ in self.parts]]  # of a block with the last row alone: the last step
        owners, firsts = self.blocks(self._owners.expand(count, -1)), self.blocks(begun)
        return owners.astype(np.int64), firsts.astype(np.int64)
