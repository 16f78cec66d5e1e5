"""The declared physics, with and without effects, on runs that it was not fitted to.

Every run is left out in turn (at most five groups of runs); all parameters, those of the effects too, are fitted to the
others by the same regression as in the search. On what was left out three things are measured, with intervals from
resampling blocks of time (evaluation.bootstrap):

- the log-likelihood of each step given the past, and the residual force and moment in the band where they act
  (`innovations`): they mean the same whether inputs answer disturbances or not, and they judge. Each effect is left
  out in turn too, so that it is judged by what it brings itself, on the channels that it moves;
- errors of open-loop predictions from every quarter of a second, inputs replayed from the log. In a closed loop these
  inputs answer the disturbances of the very time that is predicted: physics that is right about causes may err more
  than physics that has learned the controller. They are reported, and judge nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.decisions import DECISIONS, INTERVAL_LEVEL, Decisions
from nsde_torch.diagnosis.fitted import fitted_system
from nsde_torch.diagnosis.innovations import Own, Scored, band, finite, joined, one_step, own, scored
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects import Effect, key_of
from nsde_torch.errors import DataError
from nsde_torch.evaluation.before import inputs_before
from nsde_torch.evaluation.bootstrap import make_blocks, paired_bootstrap
from nsde_torch.evaluation.metrics import horizons_of, start_grid, thinned
from nsde_torch.evaluation.scores import group_squares
from nsde_torch.inference.steps import Steps
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.sde import make_step
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System

REPLAYED = "replayed"
"""Where the inputs of open-loop predictions come from (`errors.inputs` of `diagnosis.json`)."""

_NO_PREDICTIONS: dict[str, Any] = {"horizons_s": [], "before": {}, "after": {}, "ratio": {}}


@dataclass(frozen=True)
class HeldOut:
    """How two physics do on runs left out.

    Args:
        content: As `errors` of `diagnosis.json` has it: `before`, `after`, `ratio`, `difference` by quantity and
            horizon, of open-loop predictions; `one_step` and `residual` (see `innovations`).
        whole_runs: Whether whole runs were left out; else the last part of the only one.
        runs: Names of the runs that errors were measured on.
        own: By effect: what it brings itself.
        inputs: Whether the inputs are what acted, and not restored from an average. Those know the future, and the
            density of a step given them says nothing of causes: the residual alone judges.
    """

    content: dict[str, Any]
    whole_runs: bool
    runs: tuple[str, ...]
    own: Mapping[str, Own] = field(default_factory=dict)
    inputs: bool = True

    def against(self, effect: str) -> str:
        """What runs left out say against an effect that was found, in words; empty if nothing."""
        mine = self.own.get(effect)
        if mine is None:
            return ""
        return mine.against if self.inputs else mine.against_by_residual


def split(runs: Sequence[Run], decisions: Decisions = DECISIONS) -> list[tuple[list[Run], list[Run]]]:
    """Training and test runs of each fold."""
    if len(runs) > 1:
        number = [i * min(len(runs), decisions.refit_folds) // len(runs) for i in range(len(runs))]
        folds = []
        for f in range(max(number) + 1):
            test = [r for r, k in zip(runs, number, strict=True) if k == f]
            folds.append(([r for r, k in zip(runs, number, strict=True) if k != f], test))
        return folds
    run = runs[0]
    cut = round(len(run) * (1 - decisions.refit_tail))
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
    without: Mapping[str, System] | None = None,
    moved: Mapping[str, Sequence[str]] | None = None,
    closed_loop: bool | None = None,
    inputs: bool = True,
    decisions: Decisions = DECISIONS,
) -> HeldOut:
    """Measure two physics on runs left out.

    Args:
        systems: Without and with the effects, their values near the optimum.
        spec: What models of the system are made of.
        runs: All runs.
        make: Makes the search of some runs, with the settings of the diagnosis.
        clock: Physical seconds per logged second.
        seed: Seed of the resamples.
        without: By effect: the physics with all others.
        moved: By effect: names of the channels that it moves.
        closed_loop: Whether inputs answer the state; None: not known.
        inputs: Whether the inputs are what acted, and not restored from an average.
        decisions: Folds, and blocks of time.
    """
    before, after = systems
    every = {"before": before, "after": after, **{f"- {k}": s for k, s in (without or {}).items()}}
    steps_of_all: dict[str, list[Scored]] = {key: [] for key in every}
    squares: list[list[Tensor]] = [[], []]
    owner: list[NDArray[np.int64]] = []
    times: list[NDArray[np.float64]] = []
    names: list[str] = []
    folds = split(runs, decisions)
    horizons = min((horizons_of(test, spec.dt) for _, test in folds), key=len, default=())
    counts = [max(1, round(h / spec.dt)) for h in horizons]
    for train, test in folds:
        search = make(train)
        whole = search.quick(after, warm=True)
        fitted: dict[int, Regression] = {id(after): whole}  # of systems that are the same, once
        for system in every.values():
            if id(system) not in fitted:
                fitted[id(system)] = search.beside(system, whole)
        left = _steps(make, test)
        if left is not None:
            scores = {
                k: scored(r, left, feedback=search.feedback, first=len(names)) for k, r in fitted.items()
            }
            for key, system in every.items():
                steps_of_all[key].append(scores[id(system)])
        if horizons:
            windows = Windows(test, spec.dt, counts[-1], dtype=torch.float64)
            starts = thinned(start_grid(windows))
            if len(starts):
                models = [as_model(spec, fitted_system(fitted[id(s)]), clock) for s in systems]
                one = rollout_squares(models[0], windows, starts, counts)
                squares[0].append(one)
                squares[1].append(
                    one if before is after else rollout_squares(models[1], windows, starts, counts)
                )
                run, t = _places(windows.rows(starts), test)
                owner.append(len(names) + run)
                times.append(t)
        names += [r.name for r in test]
    content = _replayed(squares, owner, times, horizons, before, seed, decisions) | _of_steps(closed_loop)
    brought: dict[str, Own] = {}
    if steps_of_all["before"]:
        of = {key: joined(parts) for key, parts in steps_of_all.items()}
        content["one_step"] = one_step(of["before"], of["after"], before, seed=seed, decisions=decisions)
        content["residual"] = band(of["before"], of["after"], seed=seed, decisions=decisions)
        for effect in without or {}:
            mine = own(
                of[f"- {effect}"], of["after"], (moved or {}).get(effect, ()), seed=seed, decisions=decisions
            )
            if mine is not None:
                brought[effect] = mine
    return HeldOut(content, len(runs) > 1, tuple(names), brought, inputs)


def cross_validated(
    log: Log, search: Search, outcome: Outcome, spec: SysidSpec, *, closed_loop: bool | None
) -> HeldOut:
    """Measure what was concluded on runs left out, each effect left out in turn too.

    Args:
        log: The log.
        search: The search in all its runs.
        outcome: What was concluded.
        spec: What models of the system are made of.
        closed_loop: Whether inputs answer the state; None: not known.
    """
    return held_out(
        (outcome.declared_system, outcome.system),
        spec,
        log.runs,
        make=lambda some: log.again(search, some),
        clock=log.recorded.clock,
        seed=log.options.seed,
        without={f.name: outcome.without(f.name) for f in outcome.found},
        moved={f.name: f.moves for f in outcome.found},
        closed_loop=closed_loop,
        inputs=not log.recorded.inputs_restored,
        decisions=log.decisions,
    )


def none_held_out(log: Log, closed_loop: bool | None) -> HeldOut:
    """What is known where nothing was measured on runs left out."""
    content = _NO_PREDICTIONS | _of_steps(closed_loop)
    inputs = not log.recorded.inputs_restored
    return HeldOut(content, len(log.runs) > 1, (), {}, inputs)


def _of_steps(closed_loop: bool | None) -> dict[str, Any]:
    """Content of what is measured step by step, before it is."""
    return {"inputs": REPLAYED, "closed_loop": closed_loop, "one_step": None, "residual": {}}


def _steps(make: Callable[[Sequence[Run]], Search], runs: Sequence[Run]) -> Steps | None:
    """Steps of runs left out; None where no stretch is long enough."""
    try:
        return make(runs).steps
    except DataError:
        return None


def _replayed(
    squares: Sequence[Sequence[Tensor]],
    owner: Sequence[NDArray[np.int64]],
    times: Sequence[NDArray[np.float64]],
    horizons: Sequence[float],
    system: System,
    seed: int,
    decisions: Decisions,
) -> dict[str, Any]:
    """Errors of open-loop predictions by quantity and horizon, as `diagnosis.json` has them.

    Args:
        squares: Squared errors of both physics by fold (S, horizons, groups).
        owner, times: Run and time of the starts of each fold (S,).
        horizons: Horizons [s].
        system: The machine.
        seed: Seed of the resamples.
        decisions: Blocks of time, and which horizons are told.
    """
    if not owner:
        return _NO_PREDICTIONS
    first, second = (torch.cat(list(s)) for s in squares)
    finished = [torch.isfinite(s).all(2) for s in (first, second)]
    both = finished[0] & finished[1]
    far = int(
        (both.float().mean(0) >= decisions.replay_finite_share).sum()
    )  # horizons at which nearly all predictions are still numbers
    if far == 0:
        return _NO_PREDICTIONS
    horizons = horizons[:far]
    rows = both[:, far - 1]
    diverged = [int((~f[:, far - 1]).sum()) for f in finished]
    first, second = first[rows, :far], second[rows, :far]
    places, clocks = np.concatenate(owner)[rows.numpy()], np.concatenate(times)[rows.numpy()]
    blocks = make_blocks(places, clocks, length=decisions.replay_block)
    generator = torch.Generator().manual_seed(seed)
    factor = torch.tensor([g.factor for g in system.error_groups], dtype=torch.float64)
    one, other = (s.double() * factor**2 for s in (first, second))
    count = len(horizons) * len(system.error_groups)
    difference = paired_bootstrap(
        one.reshape(-1, count), other.reshape(-1, count), blocks, generator=generator, level=INTERVAL_LEVEL
    )
    before, after = (s.mean(0).sqrt() for s in (one, other))
    shape = (len(horizons), len(system.error_groups))

    def table(values: Tensor) -> dict[str, dict[str, float | None]]:
        v = values.reshape(shape)
        return {
            g.name: {f"{h:g}": finite(v[i, j]) for i, h in enumerate(horizons)}
            for j, g in enumerate(system.error_groups)
        }

    return {
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
    }


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


def as_model(spec: SysidSpec, system: System, clock: float) -> IdentifiedModel:
    """The physics as a model that predicts."""
    have = spec.make_system().effect_names
    added = [key_of(type(e)) for e in system.effects if isinstance(e, Effect) and e.name not in have]
    model = IdentifiedModel(replace(spec, effects=(*spec.effects, *added)), generator=torch.Generator())
    model.system = system.with_effects()
    model.system.set_step(spec.dt)
    model.clock_scale.fill_(clock)
    return model.double().requires_grad_(False)
