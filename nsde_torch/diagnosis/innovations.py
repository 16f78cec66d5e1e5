"""How well fitted physics foretells each step of runs that it was not fitted to, and what it leaves of the forces.

    log p = sum over steps k of  -e_k^2 / 2 - log s,      e_k = (whitened residual of step k) / s

With theta, the ARMA noise model and its size s from other runs, e_k is the innovation of channel i: what was measured
over a step less what was foretold of it from the states and inputs before (Ljung, System Identification, 1999, section
3.2). Input k is known when step k begins, so that the density of a step given the past means the same whether the
input answers the past or not: where errors of long predictions under logged inputs reward physics that has learned
what a controller does about a gust, this does not. It is still bent where the controller saw more than the log holds.

What is left of forces and moments is told in the band where they act: root mean square of mean residual rates over a
quarter of a second (`sysid.explained`). Differences have intervals from resampling blocks of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.diagnosis.decisions import DECISIONS, INTERVAL_LEVEL, Decisions
from nsde_torch.evaluation.bootstrap import Blocks, Difference, make_blocks, mean_bootstrap, paired_bootstrap
from nsde_torch.inference.steps import Steps
from nsde_torch.sysid.explained import bump, per_second, smooth_rate
from nsde_torch.sysid.feedback import faded, foretelling
from nsde_torch.sysid.physics import Physics
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.series import Series
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Scored:
    """Physics on runs that it was not fitted to.

    Args:
        names, units: Of the dynamic channels, and of their rates.
        density: Log density of each step (N, channels) [nat].
        run, t: Run and time [s] of each step (N,).
        squares: Squared mean residual rates over the test function (M, channels).
        band_run, band_t: Run and time [s] of each of these (M,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    density: Array
    run: Labels
    t: Array
    squares: Array
    band_run: Labels
    band_t: Array


def scored(trained: Regression, steps: Steps, *, feedback: bool, first: int = 0) -> Scored:
    """Score physics and noise of a regression on other runs, as they are.

    Args:
        trained: At its optimum, on the runs that it was fitted to.
        steps: Of the other runs.
        feedback: Whether what kinematic residuals foretell is taken out (`identify.feedback`).
        first: Number of the first of these runs.
    """
    source = trained.origin
    assert isinstance(source, System)
    physics, rows = Physics(ParameterVector(source), steps), trained.rows
    residual = physics.residual(trained.theta)
    single = Series(steps.segments)
    series, boxed = single.boxes(trained.box), single.summed(residual, trained.box)
    white = _whitened(trained, boxed, series)
    size = np.ones(len(rows))
    if feedback:
        here = trained.single.summed(
            trained.physics.kinematic(trained.physics.residual(trained.theta), rows), trained.box
        )
        own = _whitened(trained, trained.residual, trained.series)
        b = foretelling(here, trained.series, own)
        if len(b):
            size = np.sqrt(np.square(own - (faded(here, trained.series) @ b).T).mean(1))
            there = single.summed(physics.kinematic(residual, rows), trained.box)
            white = white - (faded(there, series) @ b).T
    density = np.stack(
        [
            noise.log_density(e / s, series) - np.log(s)
            for noise, e, s in zip(trained.noises, white, size, strict=True)
        ],
        1,
    )
    owner = first + np.array(steps.runs, dtype=np.int64)
    t = steps.t.numpy()
    counts = [b - a for a, b in series.edges]
    starts = single.summed(t[:, None], trained.box)[:, 0] / trained.box
    window = bump(steps.dt)
    fits = [(a, b) for a, b in steps.segments if b - a >= len(window)]
    middle = [t[a + len(window) // 2 : b - (len(window) - 1 - len(window) // 2)] for a, b in fits]
    fitting = [o for o, (a, b) in zip(owner, steps.segments, strict=True) if b - a >= len(window)]
    return Scored(
        names=tuple(physics.names[c] for c in rows),
        units=tuple(per_second(physics.units[c]) for c in rows),
        density=density,
        run=np.repeat(owner, [n + 1 for n in counts]),
        t=np.concatenate([np.append(starts[a], starts[a:b]) for a, b in series.edges]),
        squares=np.square(smooth_rate(residual[:, rows], steps.segments, window, steps.dt)),
        band_run=np.repeat(np.array(fitting, dtype=np.int64), [len(m) for m in middle]),
        band_t=np.concatenate(middle) if middle else np.zeros(0),
    )


def joined(parts: Sequence[Scored]) -> Scored:
    """The same of several groups of runs."""
    return Scored(
        parts[0].names,
        parts[0].units,
        *(
            np.concatenate([getattr(p, key) for p in parts])
            for key in ("density", "run", "t", "squares", "band_run", "band_t")
        ),
    )


def one_step(
    before: Scored, after: Scored, system: System, *, seed: int, decisions: Decisions = DECISIONS
) -> dict[str, Any]:
    """Gain in held-out log-likelihood, as `diagnosis.json` has it.

    Args:
        before, after: Two physics on the same runs.
        system: Of both, for the names of its quantities.
        seed: Seed of the resamples.
        decisions: Blocks of time.

    Returns:
        `unit`, `steps`, `blocks`, and `nats`, `low_90`, `high_90`: of all channels, by channel (`channels`), and by
        quantity (`quantities`).
    """
    gain = after.density - before.density
    members = quantities(system, before.names)
    sums = [gain.sum(1), *gain.T, *(gain[:, at].sum(1) for at in members.values())]
    blocks = blocks_of_steps(before.run, before.t, decisions)
    cells = _totals(np.stack(sums, 1), blocks, seed)
    k = 1 + len(before.names)
    return {
        "unit": "nat",
        "steps": len(gain),
        "blocks": blocks.count,
        **cells[0],
        "channels": dict(zip(before.names, cells[1:k], strict=True)),
        "quantities": dict(zip(members, cells[k:], strict=True)),
    }


def band(before: Scored, after: Scored, *, seed: int, decisions: Decisions = DECISIONS) -> dict[str, Any]:
    """Residual rates of runs left out by channel, as `diagnosis.json` has them; nothing where none is long enough.

    Args:
        before, after: Two physics on the same runs.
        seed: Seed of the resamples.
        decisions: Blocks of time.

    Returns:
        By channel: `unit`, `before`, `after`, `ratio`, and `difference` with `low_90` and `high_90`.
    """
    if not len(before.squares):
        return {}
    blocks = blocks_of_steps(before.band_run, before.band_t, decisions)
    found = _difference(before.squares, after.squares, blocks, seed)
    first, second = (np.sqrt(s.squares.mean(0)) for s in (before, after))
    return {
        name: {
            "unit": before.units[i],
            "before": float(first[i]),
            "after": float(second[i]),
            "ratio": float(second[i] / first[i]) if first[i] > 0 else 1.0,
            "difference": float(found.value[i]),
            "low_90": finite(found.low[i]),
            "high_90": finite(found.high[i]),
        }
        for i, name in enumerate(before.names)
    }


@dataclass(frozen=True)
class Own:
    """What one effect brings on runs left out, on the channels that it moves: physics with it against physics without.

    Args:
        nats: Gain in log-likelihood on these channels.
        low, high: Its 90 % interval; None where there are too few blocks.
        channels: The same by channel: `nats`, `low_90`, `high_90`.
        residual_ratio: By channel: residual with it over residual without.
        residual: By channel: its unit, and the residual without the effect and with it (see `band`).
        larger: Whether the residual of these channels together is surely larger with it.
    """

    nats: float
    low: float | None
    high: float | None
    channels: dict[str, dict[str, float | None]]
    residual_ratio: dict[str, float]
    larger: bool
    residual: dict[str, tuple[str, float, float]] = field(default_factory=dict)

    @property
    def against(self) -> str:
        """What speaks against the effect, in words; empty if nothing does.

        The log-likelihood comes first: what is left in the band can fall where an input answers gusts and the physics
        has learned so. It decides only where the log-likelihood does not surely rise.
        """
        if self.nats <= 0:
            return f"it does not raise the log-likelihood of {self._where} on runs left out"
        if self.low is not None and self.low > 0:
            return ""
        return self.against_by_residual

    @property
    def against_by_residual(self) -> str:
        """What the residual alone says against the effect, in words; empty if nothing."""
        return f"the residual of {self._where} on runs left out is larger with it" if self.larger else ""

    @property
    def _where(self) -> str:
        return " and ".join(
            [", ".join([*self.channels][:-1]), [*self.channels][-1]][len(self.channels) < 2 :]
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        return {
            "nats": self.nats,
            "low_90": self.low,
            "high_90": self.high,
            "channels": self.channels,
            "residual_ratio": self.residual_ratio,
        }


def own(
    without: Scored, full: Scored, moved: Sequence[str], *, seed: int, decisions: Decisions = DECISIONS
) -> Own | None:
    """What an effect brings; None where it moves no channel.

    Args:
        without: Everything that was found but the effect, fitted again.
        full: Everything that was found.
        moved: Names of the channels that the effect's parameters move.
        seed: Seed of the resamples.
        decisions: Blocks of time.
    """
    at = [i for i, name in enumerate(full.names) if name in moved]
    if not at:
        return None
    gain = full.density[:, at] - without.density[:, at]
    cells = _totals(np.column_stack((gain.sum(1), gain)), blocks_of_steps(full.run, full.t, decisions), seed)
    first, second = without.squares[:, at], full.squares[:, at]
    names = [full.names[i] for i in at]
    ratio, larger, left = np.ones(len(at)), False, dict[str, tuple[str, float, float]]()
    if len(first):
        rms = [np.sqrt(s.mean(0)).tolist() for s in (first, second)]
        left = {n: (full.units[i], a, b) for n, i, a, b in zip(names, at, *rms, strict=True)}
        power = np.maximum(first.mean(0), 1e-300)
        ratio = np.sqrt(second.mean(0) / power)
        pooled = [(s / power).mean(1, keepdims=True) for s in (first, second)]
        blocks = blocks_of_steps(full.band_run, full.band_t, decisions)
        larger = bool(_difference(pooled[0], pooled[1], blocks, seed).low[0] > 0)
    return Own(
        nats=float(cells[0]["nats"] or 0.0),
        low=cells[0]["low_90"],
        high=cells[0]["high_90"],
        channels=dict(zip(names, cells[1:], strict=True)),
        residual_ratio=dict(zip(names, ratio.tolist(), strict=True)),
        larger=larger,
        residual=left,
    )


def quantities(system: System, names: Sequence[str]) -> dict[str, list[int]]:
    """Numbers of the channels of each quantity that errors are told in, of those that have any."""
    plain = [name.removesuffix(" (body)") for name in names]
    of_group = {g.name: {system.error_names[c] for c in g.channels} for g in system.error_groups}
    found = {key: [i for i, n in enumerate(plain) if n in own] for key, own in of_group.items()}
    return {key: at for key, at in found.items() if at}


def finite(value: Tensor | float) -> float | None:
    """A number for JSON; None for what is none."""
    v = float(value)
    return v if np.isfinite(v) else None


# ---- pieces -------------------------------------------------------------------------------------------


def _whitened(trained: Regression, residual: Array, series: Series) -> Array:
    """Whitened residuals (channels, N + stretches) under noise models of a regression, nothing foretold taken out."""
    pairs = zip(trained.noises, trained.rows, strict=True)
    return np.stack([noise.whiten(residual[:, [c]], series)[:, 0] for noise, c in pairs])


def blocks_of_steps(run: Labels, t: Array, decisions: Decisions) -> Blocks:
    """Blocks of time: innovations are nearly white, so that short data can be cut finer than predictions."""
    total = sum(float(np.ptp(t[run == r])) for r in np.unique(run))
    ends = decisions.step_block_shortest, decisions.step_block_longest
    return make_blocks(run, t, length=float(np.clip(total / decisions.step_blocks, *ends)))


def _totals(gain: Array, blocks: Blocks, seed: int) -> list[dict[str, float | None]]:
    """Sums over the rows (N, K) with intervals."""
    found = mean_bootstrap(
        torch.from_numpy(gain), blocks, generator=torch.Generator().manual_seed(seed), level=INTERVAL_LEVEL
    )
    n = len(gain)
    return [
        {"nats": n * float(value), "low_90": finite(n * low), "high_90": finite(n * high)}
        for value, low, high in zip(found.value, found.low, found.high, strict=True)
    ]


def _difference(first: Array, other: Array, blocks: Blocks, seed: int) -> Difference:
    return paired_bootstrap(
        torch.from_numpy(first),
        torch.from_numpy(other),
        blocks,
        generator=torch.Generator().manual_seed(seed),
        level=INTERVAL_LEVEL,
    )
