"""How well physics predicts each step of runs that it was not fitted to, and what it leaves of the forces.

    log p = sum over steps k of  log p(y_k | y_1, ..., y_{k-1}, u_1, ..., u_{k-1})

Densities are those of the innovations of the filter (`inference.left_out`), or of the whitened residuals of a
regression under its ARMA noise models, e_k^2 / 2 + log s (Ljung, System Identification, 1999, section 3.2). Input k is
known when step k begins, so that the density of a step given the past means the same whether the input answers the
past or not: where errors of long predictions under logged inputs reward physics that has learned what a controller
does about a gust, this does not. It is still biased where the controller saw more than the log holds.

What is left of forces and moments is reported in the band where they act: root mean square of mean residual rates over
a quarter of a second (`sysid.explained`). Differences have intervals from resampling blocks of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.diagnosis.decisions import DECISIONS, INTERVAL_LEVEL, Decisions
from nsde_torch.diagnosis.fitted import dynamic_rows
from nsde_torch.evaluation.bootstrap import Blocks, Difference, make_blocks, mean_bootstrap, paired_bootstrap
from nsde_torch.inference.left_out import Folds, LeftOut
from nsde_torch.inference.steps import Steps
from nsde_torch.sysid.explained import bump, per_second, smooth_rate
from nsde_torch.sysid.physics import Physics
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Scored:
    """Physics on runs that it was not fitted to."""

    names: tuple[str, ...]
    units: tuple[str, ...]  # names, units: of the dynamic channels, and of their rates
    density: Array  # log density of each step (N, channels) [nat]
    run: Labels
    t: Array  # run, t: run and time [s] of each step (N,)
    squares: Array  # squared mean residual rates over the test function (M, channels)
    band_run: Labels
    band_t: Array  # band_run, band_t: run and time [s] of each of these (M,)


def scored(left: LeftOut, steps: Steps, folds: Folds) -> Scored:
    """Physics on what it was not fitted to, with its mean residual rates there.

    Args:
        left: Its values without each fold, and the densities there.
        steps: Of all runs.
        folds: What is left out together.
    """
    system, window = left.vector.at_first(), bump(steps.dt)
    rows, physics = dynamic_rows(system), Physics(ParameterVector(system), steps)
    run, t = np.repeat(np.array(steps.runs), [b - a for a, b in steps.segments]), steps.t.numpy()
    fold, change = folds.of(run, t), np.zeros((len(steps), len(rows)))
    for f, theta in enumerate(left.theta):
        change[fold == f] = physics.residual(theta)[fold == f][:, rows]
    tested = [(a + int((fold[a:b] < 0).sum()), b) for a, b in steps.segments]
    begun = [np.arange(a, b - len(window) + 1) for a, b in tested]
    middle = np.concatenate(begun) + len(window) // 2
    return Scored(
        tuple(physics.names[c] for c in rows),
        tuple(per_second(physics.units[c]) for c in rows),
        left.density[:, [left.names.index(system.state_names[c]) for c in rows]],
        left.run,
        left.t,
        np.square(smooth_rate(change, tested, window, steps.dt)),
        run[middle],
        t[middle],
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
    gain, names = after.density - before.density, before.names
    plain = [name.removesuffix(" (body)") for name in names]
    of_group = {g.name: {system.error_names[c] for c in g.channels} for g in system.error_groups}
    members = {key: [n in own for n in plain] for key, own in of_group.items() if own & {*plain}}
    blocks = _blocks(before.run, before.t, decisions)
    sums = [gain.sum(1), *gain.T, *(gain[:, at].sum(1) for at in members.values())]
    whole, *cells = _totals(np.stack(sums, 1), blocks, seed)
    return {
        "unit": "nat",
        "steps": len(gain),
        "blocks": blocks.count,
        **whole,
        "channels": dict(zip(names, cells[: len(names)], strict=True)),
        "quantities": dict(zip(members, cells[len(names) :], strict=True)),
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
    found = _difference(before, before.squares, after.squares, seed, decisions)
    first, second = (np.sqrt(s.squares.mean(0)).tolist() for s in (before, after))
    return {
        name: {
            "unit": before.units[i],
            "before": first[i],
            "after": second[i],
            "ratio": second[i] / first[i] if first[i] > 0 else 1.0,
            "difference": float(found.value[i]),
            "low_90": finite(found.low[i]),
            "high_90": finite(found.high[i]),
        }
        for i, name in enumerate(before.names)
    }


@dataclass(frozen=True)
class Own:
    """What one effect brings on runs left out, on the channels that it moves."""

    nats: float  # gain in log-likelihood on these channels
    low: float | None
    high: float | None  # low, high: its 90 % interval; None where there are too few blocks
    channels: dict[str, dict[str, float | None]]  # the same by channel: `nats`, `low_90`, `high_90`
    residual_ratio: dict[str, float]  # by channel: residual with it over residual without
    larger: bool  # whether the residual of these channels together is surely larger with it
    residual: dict[str, tuple[str, float, float]] = field(default_factory=dict)
    """By channel: its unit, and the residual without the effect and with it (see `band`)."""

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
        *others, last = self.channels
        return f"{', '.join(others)} and {last}" if others else last

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
    names, gain = [full.names[i] for i in at], (full.density - without.density)[:, at]
    blocks = _blocks(full.run, full.t, decisions)
    whole, *cells = _totals(np.column_stack((gain.sum(1), gain)), blocks, seed)
    left, larger = band(without, full, seed=seed, decisions=decisions), False
    if left:
        power = without.squares[:, at].mean(0).clip(1e-300)
        pooled = [(s.squares[:, at] / power).mean(1, keepdims=True) for s in (without, full)]
        larger = bool(_difference(full, pooled[0], pooled[1], seed, decisions).low[0] > 0)
    return Own(
        nats=float(whole["nats"] or 0.0),
        low=whole["low_90"],
        high=whole["high_90"],
        channels=dict(zip(names, cells, strict=True)),
        residual_ratio={n: left[n]["ratio"] if left else 1.0 for n in names},
        larger=larger,
        residual={n: (left[n]["unit"], left[n]["before"], left[n]["after"]) for n in names if left},
    )


def finite(value: Tensor | float) -> float | None:
    """A number for JSON; None for what is none."""
    return float(value) if np.isfinite(float(value)) else None


# ---- pieces -------------------------------------------------------------------------------------------


def _blocks(run: Labels, t: Array, decisions: Decisions) -> Blocks:
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


def _difference(of: Scored, first: Array, other: Array, seed: int, decisions: Decisions) -> Difference:
    """Difference of root mean squares of what the bands of two physics have (M, K)."""
    pair, generator = (torch.from_numpy(first), torch.from_numpy(other)), torch.Generator().manual_seed(seed)
    blocks = _blocks(of.band_run, of.band_t, decisions)
    return paired_bootstrap(*pair, blocks, generator=generator, level=INTERVAL_LEVEL)
