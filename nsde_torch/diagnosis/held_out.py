"""Errors of the declared physics, with and without effects, on runs that it was not fitted to.

Every run is left out in turn (at most five groups of runs); all parameters, those of the effects too, are fitted to the
others by the same regression as in the search, and open-loop predictions start from every quarter of a second of what
was left out. The difference has an interval from resampling blocks of starts (learning.bootstrap).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.effects import Effect, key_of
from nsde_torch.errors import DataError
from nsde_torch.learning.before import inputs_before
from nsde_torch.learning.bootstrap import make_blocks, paired_bootstrap
from nsde_torch.learning.metrics import horizons_of, start_grid, thinned
from nsde_torch.learning.scores import group_squares
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.sde import make_step
from nsde_torch.systems import System

_FOLDS = 5
_TAIL = 0.3  # of a single run, left out
_BLOCK_S = 4.0
_STAYS = 0.9


@dataclass(frozen=True)
class HeldOut:
    """Errors on runs left out.

    Args:
        content: As `diagnosis.json` has it: `before`, `after`, `ratio`, `difference` by quantity and horizon.
        whole_runs: Whether whole runs were left out; else the last part of the only one.
        runs: Names of the runs that errors were measured on.
    """

    content: dict[str, Any]
    whole_runs: bool
    runs: tuple[str, ...]

    @property
    def worse(self) -> list[str]:
        """Quantities that are surely predicted worse, at more than half of the horizons, with the effects."""
        low = self.content.get("difference", {}).get("low_90", {})
        return [
            name
            for name, of_horizon in low.items()
            if 2 * sum(v is not None and v > 0 for v in of_horizon.values()) > len(of_horizon)
        ]


def split(runs: Sequence[Run]) -> list[tuple[list[Run], list[Run]]]:
    """Training and test runs of each fold."""
    if len(runs) > 1:
        number = [i * min(len(runs), _FOLDS) // len(runs) for i in range(len(runs))]
        folds = []
        for f in range(max(number) + 1):
            test = [r for r, k in zip(runs, number, strict=True) if k == f]
            folds.append(([r for r, k in zip(runs, number, strict=True) if k != f], test))
        return folds
    run = runs[0]
    cut = round(len(run) * (1 - _TAIL))
    try:
        return [([run.slice(0, cut)], [run.slice(cut, len(run))])]
    except DataError:
        return []


def held_out(
    systems: Sequence[System],
    spec: SysidSpec,
    runs: Sequence[Run],
    *,
    make: Callable[[Sequence[Run]], Search],
    clock: float,
    seed: int,
) -> HeldOut:
    """Errors of two physics on runs left out.

    Args:
        systems: Without and with the effects.
        spec: What models of the system are made of.
        runs: All runs.
        make: Makes the search of some runs, with the settings of the diagnosis.
        clock: Physical seconds per logged second.
        seed: Seed of the resamples.
    """
    squares: list[list[Tensor]] = [[], []]
    owner: list[NDArray[np.int64]] = []
    times: list[NDArray[np.float64]] = []
    names: list[str] = []
    folds = split(runs)
    horizons = min((horizons_of(test, spec.dt) for _, test in folds), key=len, default=())
    for train, test in folds:
        if not horizons:
            break
        steps = [max(1, round(h / spec.dt)) for h in horizons]
        windows = Windows(test, spec.dt, steps[-1], dtype=torch.float64)
        starts = thinned(start_grid(windows))
        if not len(starts):
            continue
        search = make(train)
        for k, system in enumerate(systems):
            model = as_model(spec, fitted_system(search.quick(system, warm=True)), clock)
            squares[k].append(rollout_squares(model, windows, starts, steps))
        run, t = _places(windows.rows(starts), test)
        owner.append(len(names) + run)
        times.append(t)
        names += [r.name for r in test]
    if not names:
        return HeldOut({"horizons_s": [], "before": {}, "after": {}, "ratio": {}}, len(runs) > 1, ())
    first, second = (torch.cat(s) for s in squares)
    finite = [torch.isfinite(s).all(2) for s in (first, second)]
    both = finite[0] & finite[1]
    far = int(
        (both.float().mean(0) >= _STAYS).sum()
    )  # horizons at which nearly all predictions are still numbers
    if far == 0:
        return HeldOut(
            {"horizons_s": [], "before": {}, "after": {}, "ratio": {}}, len(runs) > 1, tuple(names)
        )
    horizons = horizons[:far]
    rows = both[:, far - 1]
    diverged = [int((~f[:, far - 1]).sum()) for f in finite]
    first, second = first[rows, :far], second[rows, :far]
    places, clocks = np.concatenate(owner)[rows.numpy()], np.concatenate(times)[rows.numpy()]
    blocks = make_blocks(places, clocks, length=_BLOCK_S)
    generator = torch.Generator().manual_seed(seed)
    system = systems[0]
    factor = torch.tensor([g.factor for g in system.error_groups], dtype=torch.float64)
    one, other = (s.double() * factor**2 for s in (first, second))
    count = len(horizons) * len(system.error_groups)
    difference = paired_bootstrap(
        one.reshape(-1, count), other.reshape(-1, count), blocks, generator=generator, level=0.9
    )
    before, after = (s.mean(0).sqrt() for s in (one, other))
    shape = (len(horizons), len(system.error_groups))

    def table(values: Tensor) -> dict[str, dict[str, float | None]]:
        v = values.reshape(shape)
        return {
            g.name: {f"{h:g}": _number(v[i, j]) for i, h in enumerate(horizons)}
            for j, g in enumerate(system.error_groups)
        }

    return HeldOut(
        {
            "horizons_s": list(horizons),
            "units": {g.name: g.unit for g in system.error_groups},
            "starts": len(first),
            "diverged": {"before": diverged[0], "after": diverged[1]},
            "before": table(before),
            "after": table(after),
            "ratio": table(after / before.clamp_min(1e-12)),
            "difference": {
                "value": table(difference.value),
                "low_90": table(difference.low),
                "high_90": table(difference.high),
            },
        },
        len(runs) > 1,
        tuple(names),
    )


@torch.no_grad()
def rollout_squares(model: IdentifiedModel, windows: Windows, starts: Tensor, steps: Sequence[int]) -> Tensor:
    """Squared errors (S, horizons, groups) of predictions by Runge and Kutta; not finite where one diverged.

    A prediction that leaves the finite numbers does so alone, and does not stop the others.
    """
    system = model.system
    x, u, t0 = windows.batch(starts)
    dt = windows.dt_model
    z = model.remembered(x[:, 0], u[:, 0], inputs_before(system, windows, starts), dt=dt)
    solver = make_step("rk4")
    model.set_step(dt)
    out = []
    for k in range(max(steps)):
        z = system.project(solver.advance(model, t0[:, None] + k * dt, z, u[:, k], dt, None))
        if k + 1 in steps:
            error = system.error(z[:, : system.nx], x[:, k + 1])
            out.append(group_squares(system, error))
    return torch.stack([out[sorted(set(steps)).index(k)] for k in steps], 1)


def _places(rows: NDArray[np.int64], runs: Sequence[Run]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Run and time [s] of rows that are counted through all runs."""
    first = np.cumsum([0, *(len(run) for run in runs)])
    run = np.searchsorted(first, rows, side="right") - 1
    t = np.array([runs[r].t[row - first[r]] for r, row in zip(run, rows, strict=True)])
    return run.astype(np.int64), t


def _number(value: Tensor) -> float | None:
    v = float(value)
    return v if np.isfinite(v) else None


def as_model(spec: SysidSpec, system: System, clock: float) -> IdentifiedModel:
    """The physics as a model that predicts."""
    have = spec.make_system().effect_names
    added = [key_of(type(e)) for e in system.effects if isinstance(e, Effect) and e.name not in have]
    model = IdentifiedModel(replace(spec, effects=(*spec.effects, *added)), generator=torch.Generator())
    model.system = system.with_effects()
    model.system.set_step(spec.dt)
    model.clock_scale.fill_(clock)
    return model.double().requires_grad_(False)
