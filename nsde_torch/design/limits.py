"""What an experiment may do: lowest and highest values of inputs and states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System

MARGIN = 0.05  # part of a range that states keep from its ends: noise, and what the members do not know


@dataclass(frozen=True)
class ExperimentLimits:
    """Lowest and highest values."""

    inputs: tuple[str, ...]  # names of the inputs
    low: Array  # of the inputs (nu,)
    high: Array
    states: tuple[str, ...]  # names of the states
    floor: Array  # of the states (nx,), infinite where there are none
    ceiling: Array
    given: tuple[str, ...] = ()  # names that the user gave limits of
    open_loop: bool = True  # whether the experiment gives the inputs, and not a controller

    def use(self, states: Array) -> Array:
        """Share of each state's range that runs take (..., nx): 1 at a limit, above beyond it; nan where not finite."""
        with np.errstate(invalid="ignore"):
            middle, half = 0.5 * (self.floor + self.ceiling), 0.5 * (self.ceiling - self.floor)
            share = np.abs(states - middle) / np.maximum(half, 1e-12)
        share = np.where(np.isfinite(half), share, 0.0)
        finite = np.asarray(np.isfinite(states).all((-1, -2)))
        return np.where(finite[..., None], share.max(-2), np.nan)

    def widened(self, factor: float) -> "ExperimentLimits":
        """Ranges so many times as wide about their middles, of the inputs too."""
        out = []
        for low, high in ((self.low, self.high), (self.floor, self.ceiling)):
            with np.errstate(invalid="ignore"):
                middle, half = 0.5 * (low + high), 0.5 * factor * (high - low)
            fine = np.isfinite(half)
            out += [np.where(fine, middle - half, low), np.where(fine, middle + half, high)]
        return replace(self, low=out[0], high=out[1], floor=out[2], ceiling=out[3])

    def content(self, units: Mapping[str, str]) -> dict[str, Any]:
        rows = [*zip(self.inputs, self.low, self.high, strict=True)] if self.open_loop else []
        rows += [r for r in zip(self.states, self.floor, self.ceiling, strict=True) if np.isfinite(r[1])]
        return {
            name: {
                "low": float(low),
                "high": float(high),
                "unit": units[name],
                "from": "given" if name in self.given else "the runs",
            }
            for name, low, high in rows
        }


def limits_of(system: System, runs: Sequence[Run], given: Mapping[str, Any]) -> ExperimentLimits:
    """Limits as they are given, two rising numbers by name of an input or state, else the range of the runs."""
    q = system.quaternion
    turned = set() if q is None else set(range(q.start, q.stop))
    u = np.concatenate([run.u[:, : system.nu] for run in runs])
    x = np.concatenate([run.x for run in runs])
    low, high, floor, ceiling = u.min(0), u.max(0), x.min(0), x.max(0)
    for i in turned:
        floor[i], ceiling[i] = -np.inf, np.inf
    inputs, states = list(system.input_names), list(system.state_names)
    for name, pair in given.items():
        rising = isinstance(pair, list | tuple) and len(pair) == 2 and float(pair[0]) < float(pair[1])
        if not rising:
            raise ConfigError(f"`limits.{name}` must be [lowest, highest]; got {pair!r}.")
        if name in inputs:
            low[inputs.index(name)], high[inputs.index(name)] = map(float, pair)
        elif name in states and states.index(name) not in turned:
            floor[states.index(name)], ceiling[states.index(name)] = map(float, pair)
        else:
            known = [*inputs, *(n for i, n in enumerate(states) if i not in turned)]
            raise ConfigError(f"`limits` names {name!r}; {system.name!r} has: {', '.join(known)}.")
    for name, a, b in zip(inputs, low, high, strict=True):
        if q is None and not a < b:
            raise ConfigError(
                f"the runs held {name} at {a:g}, so they say no limits of it: give limits.{name}=[lowest,highest]."
            )
    return ExperimentLimits(tuple(inputs), low, high, tuple(states), floor, ceiling, tuple(given), q is None)
