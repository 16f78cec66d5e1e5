"""The declared physics, with and without effects, on runs that it was not fitted to.

Every run is left out in turn (at most five groups of runs); all parameters, those of the effects too, are fitted to the
others: a step of Gauss and Newton from the optimum of all runs (`inference.left_out`). On what was left out three
things are measured, with intervals from resampling blocks of time (evaluation.bootstrap):

- the log-likelihood of each step given the past,

      log p = sum over steps k of  log p(y_k | y_1, ..., y_{k-1}, u_1, ..., u_{k-1})

  by the innovations of the filter, or by the whitened residuals of a regression under its ARMA noise models,
  e_k^2 / 2 + log s (Ljung, System Identification, 1999, section 3.2). It is biased where the controller saw more than
  the log holds;
- the residual force and moment in the band where they act: root mean square of mean residual rates over a quarter of a
  second (`sysid.physics`). These two judge. Each effect is left out in turn too, so that it is judged by what it
  brings itself, on the channels that it moves;
- errors of open-loop predictions from every quarter of a second, inputs replayed from the log, which in a closed loop
  answer the disturbances of the very time that is predicted. They are reported, and judge nothing
  (docs/content/theory/evidence.md).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array, Labels
from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.ceiling import optimum_of
from nsde_torch.diagnosis.decisions import DECISIONS, INTERVAL_LEVEL, Decisions
from nsde_torch.diagnosis.joint_selection import FittedPhysics
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.reading import Log
from nsde_torch.diagnosis.search import Search, dynamic_rows, nonlinear
from nsde_torch.effects import Effect, key_of
from nsde_torch.effects.by_run import ByRun
from nsde_torch.errors import DataError
from nsde_torch.evaluation.bootstrap import Blocks, Difference, make_blocks, mean_bootstrap, paired_bootstrap
from nsde_torch.evaluation.metrics import horizons_of, start_grid, thinned
from nsde_torch.evaluation.scores import squares_of, states_by_fold
from nsde_torch.inference.left_out import Folds, LeftOut, left_out
from nsde_torch.inference.steps import Steps
from nsde_torch.models.identified import IdentifiedModel, SysidSpec
from nsde_torch.sysid.physics import Physics, bump, per_second, smooth_rate
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector


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
    """Physics on what it was not fitted to, with its mean residual rates there."""
    system, window = left.vector.at_first(), bump(steps.dt, steps.pace)
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
    """Residual rates of runs left out by channel, as `diagnosis.json` has them; nothing where none is long enough."""
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
    rest: float = -np.inf
    """The gain but for the run that speaks most against it: of an effect that one run alone shows, the other runs say
    nothing (a real delay of the prbs run of DCMotor.jl: -6000 nats there)."""

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
    """What an effect brings to all others, fitted `without` it, on the channels that it moves; None without any."""
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
    each = np.array([gain[full.run == r].sum() for r in np.unique(full.run)])
    return Own(
        nats=float(whole["nats"] or 0.0),
        low=whole["low_90"],
        high=whole["high_90"],
        channels=dict(zip(names, cells, strict=True)),
        residual_ratio={n: left[n]["ratio"] if left else 1.0 for n in names},
        larger=larger,
        residual={n: (left[n]["unit"], left[n]["before"], left[n]["after"]) for n in names if left},
        rest=float(each.sum() - (each.min() if len(each) > 1 else 0.0)),
    )


def finite(value: Tensor | float) -> float | None:
    """A number for JSON; None for what is none."""
    return float(value) if np.isfinite(float(value)) else None


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
    """Difference of root mean squares of the bands of two physics (M, K)."""
    pair, generator = (torch.from_numpy(first), torch.from_numpy(other)), torch.Generator().manual_seed(seed)
    blocks = _blocks(of.band_run, of.band_t, decisions)
    return paired_bootstrap(*pair, blocks, generator=generator, level=INTERVAL_LEVEL)


# ---- folds ---------------------------------------------------------------------------------------------

_NOTHING: dict[str, Any] = {
    **{"horizons_s": [], "before": {}, "after": {}, "ratio": {}},
    **{"inputs": "replayed", "closed_loop": None, "one_step": None, "residual": {}},
}
_SHOWN_S = 1.0  # longest of the predictions that are shown over time, one after another
_SHOWN = 20  # steps of each that are kept
LARGER = "the residual on runs left out is larger with what was found"
"""Why effects are provisional that make worse what they were not fitted to."""
Fitted = Callable[[System, Folds], LeftOut]
"""Physics, its values near the optimum, fitted without each fold and scored on it."""


@dataclass(frozen=True)
class Predictions:
    """Predictions of runs left out, each from a state that was measured until the next one begins."""

    horizon: float  # [s]
    run: Labels  # number of the run (S,)
    t: Array  # times [s], of the start and of steps after it (S, k)
    measured: Array  # states (S, k, nx)
    # by the physics `before`, and with effects `after` where any was found (S, k, nx)
    predicted: dict[str, Array]
    width: Array  # what 90 % of the errors of the last of these stay below, by time since the start (k, nx)


@dataclass(frozen=True)
class HeldOut:
    """How two physics do on runs left out."""

    # as `errors` of `diagnosis.json` has it: `before`, `after`, `ratio`, `difference` by quantity and horizon, of
    # open-loop predictions; `one_step` and `residual` (see `one_step`, `band`)
    content: dict[str, Any]
    whole_runs: bool  # whether whole runs were left out; else the last part of the only one
    runs: tuple[str, ...]  # names of the runs that errors were measured on
    own: Mapping[str, Own] = field(default_factory=dict)  # by effect: what it brings itself
    # whether the inputs are what acted, and not restored from an average. Those know the future, and the density of
    # a step given them says nothing of causes: the residual alone judges.
    inputs: bool = True
    inferred: Collection[str] = ()
    """Rates that no sensor measured: what is not known of them is in their residual, times what brakes them (155 1/s
    of a ball on a beam, whose residual grew fivefold with the right effects). It judges nothing."""
    predictions: Predictions | None = None  # None where nothing could be predicted

    def smaller(self, channels: Collection[str]) -> bool:
        """Whether the residual of one of these is surely smaller with the effects; True where nothing was measured."""
        of = self._measured(channels)
        return not of or any(one["high_90"] is None or one["high_90"] < 0 for one in of)

    def larger(self, channels: Collection[str]) -> bool:
        """Whether the residual of each of these is surely larger with the effects."""
        of = self._measured(channels)
        return bool(of) and all(one["low_90"] is not None and one["low_90"] > 0 for one in of)

    def _measured(self, channels: Collection[str]) -> list[dict[str, Any]]:
        """Residuals of those of some channels that were measured."""
        each = self.content["residual"].items()
        return [one for name, one in each if name in channels and name not in self.inferred]

    def grows(self, share: float) -> list[str]:
        """Channels whose residual is surely larger with the effects, and by more than a share of what it was."""
        each = self.content["residual"].items()
        return [n for n, one in each if self.larger([n]) and one["ratio"] > 1.0 + share]

    def refutes(self, effect: str) -> float:
        """Nats by which runs left out are likelier without an effect; 0 where they are not surely so."""
        mine = self.own.get(effect)
        if not self.inputs or mine is None or mine.high is None:
            return 0.0
        return -mine.nats if max(mine.high, mine.rest) < 0 else 0.0

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
    """Physics where the likelihood is largest: those that were fitted, others from the last of these."""
    known = {frozenset(one.system.effect_names): one.at for one in places}

    def left(system: System, folds: Folds) -> LeftOut:
        at = known.get(frozenset(system.effect_names)) or optimum_of(system, places[-1].at)
        return left_out(at, folds, still=nonlinear(at.of.vector))

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
    """Measure two physics, without and with effects, on runs left out, and what each effect brings.

    `without` is by effect the physics with all others, `moved` the names of the channels that it moves; `seed` is that
    of the resamples.
    """
    before, after = systems
    folds, tests = split(runs, decisions)
    content, brought = dict(_NOTHING), dict[str, Own]()
    if not tests:
        return HeldOut(content, False, (), brought)
    full = fitted(after, folds)
    rest = full if before is after else fitted(before, folds)
    each = [(Physics(ParameterVector(one.vector.at_first()), steps), one.theta) for one in (rest, full)]
    if any(physics.is_stiff(torch.as_tensor(theta)) for physics, values in each for theta in values):
        spec = replace(spec, step="exponential")
    replayed = _Replayed(spec, tests, folds, clock)
    errors = replayed.errors(rest, full, seed, decisions)
    content |= errors
    predictions = replayed.predictions(rest, full, errors["horizons_s"]) if errors else None
    if len(full.density):
        score = partial(scored, steps=steps, folds=folds)
        one, other = score(rest), score(full)
        content["one_step"] = one_step(one, other, before, seed=seed, decisions=decisions)
        content["residual"] = band(one, other, seed=seed, decisions=decisions)
        for effect, system in (without or {}).items():
            others = one if system is before else score(fitted(system, folds))
            mine = own(others, other, (moved or {}).get(effect, ()), seed=seed, decisions=decisions)
            brought |= {} if mine is None else {effect: mine}
    names = tuple(run.name for run in tests)
    return HeldOut(content, len(runs) > 1, names, brought, predictions=predictions)


def cross_validated(
    log: Log, search: Search, outcome: Outcome, spec: SysidSpec, *, closed_loop: bool | None
) -> HeldOut:
    """Measure what was concluded on runs left out, each effect left out in turn too."""
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
        decisions=search.decisions,
    )
    content = found.content | {"closed_loop": closed_loop}
    return replace(
        found, content=content, inputs=not log.recorded.inputs_restored, inferred=(*log.runs[0].inferred,)
    )


def none_held_out(log: Log, closed_loop: bool | None) -> HeldOut:
    """What is known where nothing was measured on runs left out."""
    content, inputs = _NOTHING | {"closed_loop": closed_loop}, not log.recorded.inputs_restored
    return HeldOut(content, len(log.runs) > 1, (), {}, inputs)


@dataclass(frozen=True)
class _Replayed:
    """Open-loop predictions of runs left out, under the inputs of the log."""

    spec: SysidSpec
    runs: Sequence[Run]
    folds: Folds
    clock: float

    def states(self, left: LeftOut, windows: Windows, starts: Tensor, steps: Sequence[int]) -> Tensor:
        """Predicted states (S, steps, nx), by physics that was fitted without the run."""
        model = as_model(self.spec, left.vector.at_first(), self.clock)
        fold = self.folds.number[self.owner(windows.rows(starts))]
        return states_by_fold(model, windows, starts, steps, values=left.theta, fold=fold)

    def owner(self, row: Labels) -> Labels:
        """Numbers of the runs that rows are of."""
        return np.repeat(np.arange(len(self.runs)), [len(run) for run in self.runs])[row]

    def errors(self, rest: LeftOut, full: LeftOut, seed: int, decisions: Decisions) -> dict[str, Any]:
        """Errors by quantity and horizon, as `diagnosis.json` has them."""
        dt, folds = self.spec.dt, self.folds
        of_fold = [
            [r for r, k in zip(self.runs, folds.number, strict=True) if k == f] for f in range(folds.count)
        ]
        horizons = min((horizons_of(part, dt) for part in of_fold), key=len)
        counts = [max(1, round(h / dt)) for h in horizons]
        windows = Windows(self.runs, dt, max(counts, default=1), dtype=torch.float64)
        starts = thinned(start_grid(windows))
        if not horizons or not len(starts):
            return {}
        row, system = windows.rows(starts), full.vector.system
        owner, t = self.owner(row), np.concatenate([run.t for run in self.runs])[row]
        squares = torch.stack(
            [
                squares_of(system, self.states(left, windows, starts, counts), windows, starts, counts)
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
        groups = system.error_groups
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
                g.name: {f"{h:g}": finite(v) for h, v in zip(horizons, column, strict=False)}
                for g, column in by
            }

        return {
            "horizons_s": list(horizons[:far]),
            "units": {g.name: g.unit for g in groups},
            "starts": len(first),
            "diverged": dict(
                zip(("before", "after"), (~finished[:, :, far - 1]).sum(1).tolist(), strict=True)
            ),
            "before": table(before),
            "after": table(after),
            "ratio": table(after / before.clamp_min(1e-12)),
            "difference": {
                "value": table(found.value),
                "low_90": table(found.low),
                "high_90": table(found.high),
            },
        }

    def predictions(self, rest: LeftOut, full: LeftOut, horizons: Sequence[float]) -> Predictions | None:
        """One after another, over the longest of the horizons (s) that is not above `_SHOWN_S`."""
        dt = self.spec.dt
        last = max(1, round(max((h for h in horizons if h <= _SHOWN_S), default=horizons[0]) / dt))
        windows = Windows(self.runs, dt, last, dtype=torch.float64)
        starts = thinned(windows.starts(last * windows.dt_model))
        if not len(starts):
            return None
        steps = np.unique(np.linspace(1, last, min(last, _SHOWN)).round().astype(int))
        measured = windows.batch(starts)[0]
        out = {
            name: torch.cat((measured[:, :1], self.states(left, windows, starts, steps.tolist())), 1).numpy()
            for name, left in (("before", rest), ("after", full))
            if name == "before" or rest is not full
        }
        at, row = np.append(0, steps), windows.rows(starts)
        begun = np.concatenate([run.t for run in self.runs])[row]
        seen = measured[:, at].numpy()
        errors = np.abs(list(out.values())[-1] - seen)
        finished = np.where(np.isfinite(errors), errors, np.inf)
        width = np.quantile(finished, INTERVAL_LEVEL, axis=0, method="higher")
        times = begun[:, None] + at * windows.dt_model
        return Predictions(last * windows.dt_model, self.owner(row), times, seen, out, width)


def as_model(spec: SysidSpec, system: System, clock: float) -> IdentifiedModel:
    """The physics as a model that predicts."""
    have = spec.make_system().effect_names
    new = (e for e in system.effects if isinstance(e, Effect) and e.name not in have)
    # what differences between runs change may not be there yet
    added = [key_of(type(e)) for e in new if not isinstance(e, ByRun)]
    model = IdentifiedModel(replace(spec, effects=(*spec.effects, *added)), generator=torch.Generator())
    model.system = system.with_effects()
    model.system.set_step(spec.dt)
    model.clock_scale.fill_(clock)
    return model.double().requires_grad_(False)
