"""The declared physics, with and without effects, on runs that it was not fitted to.

Every run is left out in turn (at most five groups of runs); all parameters, those of the effects too, are fitted to the
others: a step of Gauss and Newton from the optimum of all runs (`inference.left_out`). On what was left out three
things are measured, with intervals from resampling blocks of time (evaluation.bootstrap):

- the log-likelihood of each step given the past, and the residual force and moment in the band where they act
  (`innovations`): they mean the same whether inputs answer disturbances or not, and they judge. Each effect is left
  out in turn too, so that it is judged by what it brings itself, on the channels that it moves;
- errors of open-loop predictions from every quarter of a second, inputs replayed from the log. In a closed loop these
  inputs answer the disturbances of the very time that is predicted: physics that is right about causes may err more
  than physics that has learned the controller. They are reported, and judge nothing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.decisions import DECISIONS, INTERVAL_LEVEL, Decisions
from nsde_torch.diagnosis.fitted import nonlinear
from nsde_torch.diagnosis.innovations import Own, band, finite, one_step, own, scored
from nsde_torch.diagnosis.joint_selection import FittedPhysics
from nsde_torch.diagnosis.learned_functions import optimum_of
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects import Effect, key_of
from nsde_torch.errors import DataError
from nsde_torch.evaluation.bootstrap import make_blocks, paired_bootstrap
from nsde_torch.evaluation.metrics import horizons_of, start_grid, thinned
from nsde_torch.evaluation.open_loop import squares_by_fold
from nsde_torch.inference.left_out import Folds, LeftOut, left_out
from nsde_torch.inference.steps import Steps
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.systems import System

REPLAYED = "replayed"
"""Where the inputs of open-loop predictions come from (`errors.inputs` of `diagnosis.json`)."""

_NOTHING: dict[str, Any] = {
    **{"horizons_s": [], "before": {}, "after": {}, "ratio": {}},
    **{"inputs": REPLAYED, "closed_loop": None, "one_step": None, "residual": {}},
}

Fitted = Callable[[System, Folds], LeftOut]
"""Physics, its values near the optimum, fitted without each fold and scored on it."""


@dataclass(frozen=True)
class HeldOut:
    """How two physics do on runs left out."""

    # as `errors` of `diagnosis.json` has it: `before`, `after`, `ratio`, `difference` by quantity and horizon, of
    # open-loop predictions; `one_step` and `residual` (see `innovations`)
    content: dict[str, Any]
    whole_runs: bool  # whether whole runs were left out; else the last part of the only one
    runs: tuple[str, ...]  # names of the runs that errors were measured on
    own: Mapping[str, Own] = field(default_factory=dict)  # by effect: what it brings itself
    # whether the inputs are what acted, and not restored from an average. Those know the future, and the density of
    # a step given them says nothing of causes: the residual alone judges.
    inputs: bool = True

    def against(self, effect: str) -> str:
        """What runs left out say against an effect that was found, in words; empty if nothing."""
        mine = self.own.get(effect)
        if mine is None:
            return ""
        return mine.against if self.inputs else mine.against_by_residual


def split(runs: Sequence[Run], decisions: Decisions = DECISIONS) -> tuple[Folds, list[Run]]:
    """What is left out in turn, and the runs that this makes: all of them, or the last part of the only one."""
    count, first = len(runs), runs[0]
    number = np.arange(count) * min(count, decisions.refit_folds) // count
    if count > 1:
        return Folds(number, np.full(count, -np.inf)), list(runs)
    cut = round(len(first) * (1 - decisions.refit_tail))
    try:
        return Folds(number, first.t[cut : cut + 1]), [first.slice(cut, len(first))]
    except DataError:
        return Folds(number, first.t[-1:]), []


def by_likelihood(places: Sequence[FittedPhysics]) -> Fitted:
    """Physics where the likelihood is largest: those that were fitted, others from the last of these.

    Args:
        places: Fitted physics of the same rows.
    """
    known = {frozenset(one.system.effect_names): one.at for one in places}

    def left(system: System, folds: Folds) -> LeftOut:
        at = known.get(frozenset(system.effect_names)) or optimum_of(system, places[-1].at)
        return left_out(at, folds, still=nonlinear(at.of.vector, smooth=False))

    return left


def held_out(
    systems: Sequence[System],
    spec: SysidSpec,
    runs: Sequence[Run],
    *,
    fitted: Fitted,
    steps: Steps,
    clock: float,
    seed: int,
    without: Mapping[str, System] | None = None,
    moved: Mapping[str, Sequence[str]] | None = None,
    decisions: Decisions = DECISIONS,
) -> HeldOut:
    """Measure two physics on runs left out.

    Args:
        systems: Without and with the effects, their values near the optimum.
        spec: What models of the system are made of.
        runs: All runs.
        fitted: How physics is fitted to the others.
        steps: Their steps.
        clock: Physical seconds per logged second.
        seed: Seed of the resamples.
        without: By effect: the physics with all others.
        moved: By effect: names of the channels that it moves.
        decisions: Folds, and blocks of time.
    """
    before, after = systems
    folds, tests = split(runs, decisions)
    content, brought = dict(_NOTHING), dict[str, Own]()
    if not tests:
        return HeldOut(content, False, (), brought)
    full = fitted(after, folds)
    rest = full if before is after else fitted(before, folds)
    content |= _replayed(rest, full, spec, tests, folds, clock, seed, decisions)
    if len(full.density):
        score = partial(scored, steps=steps, folds=folds)
        one, other = score(rest), score(full)
        content["one_step"] = one_step(one, other, before, seed=seed, decisions=decisions)
        content["residual"] = band(one, other, seed=seed, decisions=decisions)
        for effect, system in (without or {}).items():
            others = one if system is before else score(fitted(system, folds))
            mine = own(others, other, (moved or {}).get(effect, ()), seed=seed, decisions=decisions)
            brought |= {} if mine is None else {effect: mine}
    return HeldOut(content, len(runs) > 1, tuple(run.name for run in tests), brought)


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
    joint = outcome.joint
    if joint is None:
        return none_held_out(log, closed_loop)
    places = [joint.declared, *(one.without for one in joint.selected.values()), joint.final]
    if outcome.optimum is not None:
        places[-1] = replace(joint.final, at=outcome.optimum)
    found = held_out(
        (outcome.declared_system, outcome.system),
        spec,
        log.runs,
        fitted=by_likelihood(places),
        steps=search.steps,
        clock=log.recorded.clock,
        seed=log.options.seed,
        without={f.name: outcome.without(f.name) for f in outcome.found},
        moved={f.name: f.moves for f in outcome.found},
        decisions=log.decisions,
    )
    content = found.content | {"closed_loop": closed_loop}
    return replace(found, content=content, inputs=not log.recorded.inputs_restored)


def none_held_out(log: Log, closed_loop: bool | None) -> HeldOut:
    """What is known where nothing was measured on runs left out."""
    content, inputs = _NOTHING | {"closed_loop": closed_loop}, not log.recorded.inputs_restored
    return HeldOut(content, len(log.runs) > 1, (), {}, inputs)


def _replayed(
    rest: LeftOut,
    full: LeftOut,
    spec: SysidSpec,
    runs: Sequence[Run],
    folds: Folds,
    clock: float,
    seed: int,
    decisions: Decisions,
) -> dict[str, Any]:
    """Errors of open-loop predictions of runs left out by quantity and horizon, as `diagnosis.json` has them."""
    of_fold = [[r for r, k in zip(runs, folds.number, strict=True) if k == f] for f in range(folds.count)]
    horizons = min((horizons_of(part, spec.dt) for part in of_fold), key=len)
    counts = [max(1, round(h / spec.dt)) for h in horizons]
    windows = Windows(runs, spec.dt, max(counts, default=1), dtype=torch.float64)
    starts = thinned(start_grid(windows))
    if not horizons or not len(starts):
        return {}
    row, lengths = windows.rows(starts), [len(run) for run in runs]
    owner, t = np.repeat(np.arange(len(runs)), lengths)[row], np.concatenate([run.t for run in runs])[row]
    squares = torch.stack(
        [
            squares_by_fold(
                as_model(spec, left.vector.at_first(), clock),
                windows,
                starts,
                counts,
                values=left.theta,
                fold=folds.number[owner],
            )
            for left in ([full] if rest is full else [rest, full])
        ]
    )
    squares = squares.expand(2, *squares.shape[1:])
    finished = squares.isfinite().all(3)
    # horizons at which nearly all predictions are still numbers
    far = int((finished.all(0).double().mean(0) >= decisions.replay_finite_share).sum())
    if far == 0:
        return {}
    rows = finished[:, :, far - 1].all(0)
    groups = full.vector.system.error_groups
    factor = torch.tensor([g.factor for g in groups], dtype=torch.float64)
    scaled = squares[:, rows, :far] * factor**2
    first, second = scaled.flatten(2)
    blocks = make_blocks(owner[rows.numpy()], t[rows.numpy()], length=decisions.replay_block)
    generator = torch.Generator().manual_seed(seed)
    found = paired_bootstrap(first, second, blocks, generator=generator, level=INTERVAL_LEVEL)
    before, after = scaled.mean(1).sqrt()

    def table(values: Tensor) -> dict[str, dict[str, float | None]]:
        by = zip(groups, values.reshape(far, -1).T, strict=True)
        return {
            g.name: {f"{h:g}": finite(v) for h, v in zip(horizons, column, strict=False)} for g, column in by
        }

    return {
        "horizons_s": list(horizons[:far]),
        "units": {g.name: g.unit for g in groups},
        "starts": len(first),
        "diverged": dict(zip(("before", "after"), (~finished[:, :, far - 1]).sum(1).tolist(), strict=True)),
        "before": table(before),
        "after": table(after),
        "ratio": table(after / before.clamp_min(1e-12)),
        "difference": {
            "value": table(found.value),
            "low_90": table(found.low),
            "high_90": table(found.high),
        },
    }


def as_model(spec: SysidSpec, system: System, clock: float) -> IdentifiedModel:
    """The physics as a model that predicts."""
    have = spec.make_system().effect_names
    added = [key_of(type(e)) for e in system.effects if isinstance(e, Effect) and e.name not in have]
    model = IdentifiedModel(replace(spec, effects=(*spec.effects, *added)), generator=torch.Generator())
    model.system = system.with_effects()
    model.system.set_step(spec.dt)
    model.clock_scale.fill_(clock)
    return model.double().requires_grad_(False)
