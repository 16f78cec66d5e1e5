"""Runs as steps: both ends of every interval between samples, with the input held over it.

Where effects carry memory (a lag), what they held when a recording began is unknown. The first steps of each segment,
or those before it where rows were left out, then only bring it up: they are `run_in`, and no equation is asked of them.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.columns import by_column
from nsde_torch.data import Run
from nsde_torch.data.denoise import denoised
from nsde_torch.effects.law import joined_name
from nsde_torch.errors import DataError
from nsde_torch.inference.low_pass import low_passed_states
from nsde_torch.systems import System

_Stretch = tuple[int, int, int]  # run, first row, last row + 1

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

    def __len__(self) -> int:
        return len(self.t)

    @property
    def starts(self) -> Tensor:
        """Row at which the segment of each step starts (N,)."""
        out = torch.empty(len(self), dtype=torch.long)
        for a, b in self.segments:
            out[a:b] = a
        return out

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
        runs: Its runs, all on one step.
        clock: Physical seconds per logged second.
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
    most = max(1, round(RUN_IN_S / runs[0].dt))
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
    """Columns of rates that were inferred from positions, and what is not known of them.

    Raises:
        DataError: of some of the runs only.
    """
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
    return Steps(**joined, logged_dt=runs[0].dt, dt=runs[0].dt * clock, rows=max(rows, 1))


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

    With the share of the rows in which inputs have the sign that is rarer, of all together that of the one with least.
    """

    def size(values: Tensor, share: float = 0.95) -> float:
        return max(float(np.quantile(values.abs().numpy(), share)), _LEAST) if values.numel() else 1.0

    out = {"input": size(steps.u[:, : system.nu]), "step": steps.dt}
    out |= {kind: size(steps.x0[:, k]) for kind, k in _COLUMNS.items() if k < system.nx}
    out["least input"] = size(steps.u[:, : system.nu], _SELDOM)
    each = torch.minimum((steps.u > 0).double().mean(0), (steps.u < 0).double().mean(0))[: system.nu]
    out["rarer sign"] = float(each.min()) if len(each) else 0.0
    for one in system.single_inputs():
        out[joined_name("rarer sign", one.name)] = float(each[one.column])
        out[joined_name("input", one.name)] = size(steps.u[:, one.column])
        out[joined_name("least input", one.name)] = size(steps.u[:, one.column], _SELDOM)
    for at in system.bound_coordinates():
        out[joined_name("speed", at.name)] = size(steps.x0[:, at.velocity])
        out[joined_name("slow speed", at.name)] = size(steps.x0[:, at.velocity], SLOW)
        if at.position is not None:
            out[joined_name("position", at.name)] = size(steps.x0[:, at.position])
    return out
