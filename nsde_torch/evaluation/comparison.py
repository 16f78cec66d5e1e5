"""Models against each other and against baselines, from the same starts of the same runs.

`compare` returns what `evaluation.json` holds; numbers are in the units of `units`, times in seconds, and a value that
is not defined is null:

    system, seed, particles, starts, start_every_s (null: at interventions), horizons_s
    units           errors, spread, crps and differences: unit by group; nll: of a channel in the units of the state
    data            kind, fingerprint, dt_s, clock_scale, inputs ("as logged", or "interventional": they do not depend
                    on the state, see `nsde_torch.data.interventions`), and `runs`: name, content_hash, duration_s,
                    starts, and trained_on_by (names of models)
    models[]        name, folder, kind, dt_s, stochastic, starts, diverged
                    held_out        false if the model was trained on any of the runs
                    trained_on      run -> true or false; trained_on_match: run -> whole, part, by name, same name or ""
                    evaluated_at_s  horizon -> time of the nearest step of the model
                    errors          group -> horizon -> root mean square of the norm of the mean prediction's error
                    coverage        level -> group -> horizon -> share of measurements inside the central interval
                    coverage_channels, crps, spread, nll: channel or group -> horizon (see `evaluation.scores`)
                    calibration     nominal: levels; share: group -> share inside at each level, over all horizons
                    one_step        channel -> what is left of single steps (see `evaluation.one_step`), or null
                    by_run          run -> starts, errors, coverage_90
                    sensor_std      state -> noise of the sensors of these runs that was assumed, where it was
    baselines       hold, constant_velocity: errors as above, from all starts, at the times of the first model
    differences     first, level, replicates, unit and blocks (what was resampled, see `evaluation.bootstrap`), and
                    against: model or baseline -> held_out (both were), starts (finite in both), errors: group ->
                    horizon -> first, other, difference (other - first), low, high, verdict ("better": the other is;
                    "worse", "no difference", "too few blocks"); null where the steps of the two do not meet
    notes[]         text, red

A model's own figures leave out the starts at which it diverged; a difference is taken where both are finite.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import DataSet, Run
from nsde_torch.data.interventions import interventional
from nsde_torch.evaluation import bootstrap
from nsde_torch.evaluation.bootstrap import make_blocks, paired_bootstrap
from nsde_torch.evaluation.common_grid import (
    Candidate,
    Grid,
    Note,
    check,
    common_grids,
    common_horizons,
    note,
)
from nsde_torch.evaluation.metrics import start_every, summary
from nsde_torch.evaluation.one_step import one_step
from nsde_torch.evaluation.report import listed
from nsde_torch.evaluation.scores import LEVELS, PARTICLES, Scores, baseline_squares, rms_by_group, score
from nsde_torch.evaluation.seen import BY_NAME, NAMESAKE, PART, WHOLE, trained_on
from nsde_torch.shown import data_frame, preformatted
from nsde_torch.whole_files import json_text

RESULT = "evaluation.json"
_LEVEL = 0.95


@dataclass(frozen=True)
class Comparison:
    """Scores of some models."""

    content: dict[str, Any]  # what `evaluation.json` holds
    candidates: Sequence[Candidate]  # the models
    grids: Sequence[Grid]  # where each was scored
    scores: Sequence[Scores]  # scores of each, start by start

    @property
    def errors(self) -> dict[str, dict[str, float]]:
        """Errors of the first model: group -> horizon in seconds, as text -> root mean square, in `units`."""
        errors: dict[str, dict[str, float]] = self.content["models"][0]["errors"]
        return errors

    @property
    def report(self) -> str:
        """The scores in tables, as `nsde evaluate` prints them."""
        from nsde_torch.evaluation.comparison_text import lines

        return "\n".join(text for text, _ in lines(self.content))

    def __str__(self) -> str:
        return self.report

    def __repr__(self) -> str:
        names = ", ".join(c.name for c in self.candidates)
        return f"<Comparison of {names} on {self.content['system']}: {self.content['starts']} starts>"

    def _repr_html_(self) -> str:
        return preformatted(self.report)

    def to_frame(self) -> Any:
        """A `pandas.DataFrame`: `model`, `group`, `horizon` [s], `error` (rms), `unit`, `coverage_90`."""
        units = self.content["units"]["errors"]
        rows = [
            (m["name"], g, float(h), error, units[g], m["coverage"] and m["coverage"]["0.9"][g][h])
            for m in self.content["models"]
            for g, errors in m["errors"].items()
            for h, error in errors.items()
        ]
        return data_frame(rows, ("model", "group", "horizon", "error", "unit", "coverage_90"))

    def save(self, folder: str | Path) -> list[Path]:
        """Write `evaluation.json` and the figures in `plots/` into a folder, made where it is missing; the files."""
        from nsde_torch.evaluation.comparison_figures import write_figures

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / RESULT
        file.write_text(json_text(self.content), encoding="utf-8")
        return [file, *write_figures(folder / "plots", self)]


def compare(
    candidates: Sequence[Candidate],
    data: DataSet,
    runs: Sequence[Run],
    *,
    seed: int,
    particles: int = PARTICLES,
    horizons: Sequence[float] | None = None,
    replicates: int = bootstrap.REPLICATES,
    compile: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Score models on runs, and the differences of each to the first.

    Args:
        data: Data set of the runs; its inputs may be more than a model reads.
        seed: Seed of the particles (of every model) and of the bootstrap.
        horizons: Horizons [s]; None for those of 0.1, 0.25, 0.5, 1 and 2 s that fit the runs and every model's step.

    Returns:
        The scores; `.content` is described above.

    Raises:
        ConfigError: models of different systems, names given twice, or a step or horizon that does not fit.
        DataError: runs that are too short, or lack a column.
    """
    check(candidates, data)
    wanted, notes = common_horizons(candidates, runs, horizons)
    grids, more = common_grids(candidates, data, runs, wanted)
    notes += more
    keys = [f"{h:g}" for h in wanted]
    scores, models = [], []
    index, t = grids[0].located()
    for n, (candidate, grid) in enumerate(zip(candidates, grids, strict=True)):
        say(f"scoring {candidate.name} ({n + 1} of {len(candidates)}) from {len(grid.starts)} starts")
        made = score(
            candidate.model,
            grid.windows,
            grid.starts,
            grid.steps,
            seed=seed,
            particles=particles,
            dt=grid.dt,
            compile=compile,
            measurement_std=candidate.measurement_std,
        )
        scores.append(made)
        matches = {run.name: candidate.seen.match(run) for run in grid.runs}
        models.append(_model_entry(candidate, grid, made, matches, index, keys))
        notes += _remarks(candidate, made, matches)
    system = candidates[0].model.system
    units = {g.name: g.unit for g in system.error_groups}
    still = baseline_squares(system, grids[0].windows, grids[0].starts, grids[0].steps)
    contents = {
        "system": candidates[0].model.spec.system,
        "seed": seed,
        "particles": particles,
        "starts": len(index),
        "start_every_s": None if interventional(runs) else start_every(runs[0].pace, data.dt),
        "horizons_s": wanted,
        "units": {
            **dict.fromkeys(("errors", "spread", "crps", "differences"), units),
            "coverage": "1",
            "nll": "nat per channel, of a density in the units of the state",
            "sensor_std": dict(zip(system.state_names, system.state_units, strict=True)),
        },
        "data": {
            "kind": data.kind,
            "fingerprint": data.fingerprint,
            "dt_s": data.dt,
            "clock_scale": data.clock_scale,
            "inputs": "interventional" if interventional(runs) else "as logged",
            "runs": [
                {
                    "name": run.name,
                    "content_hash": run.content_hash,
                    "duration_s": run.duration,
                    "starts": int((index == k).sum()),
                    "trained_on_by": [m["name"] for m in models if m["trained_on"][run.name]],
                }
                for k, run in enumerate(runs)
            ],
        },
        "models": models,
        "baselines": {name: rms_by_group(system, squares, keys) for name, squares in still.items()},
        "differences": _differences(models, grids, scores, still, (index, t), keys, seed, replicates),
        "notes": notes,
    }
    return Comparison(contents, candidates, grids, scores)


def _model_entry(
    candidate: Candidate,
    grid: Grid,
    scores: Scores,
    matches: Mapping[str, str],
    index: NDArray[np.int64],
    keys: list[str],
) -> dict[str, Any]:
    stochastic = scores.stochastic
    figures = summary(scores, keys)
    own_run = index[scores.kept.numpy()]
    by_run = {}
    for k, run in enumerate(grid.runs):
        rows = torch.from_numpy(np.flatnonzero(own_run == k))
        part = summary(scores.at(rows), keys)
        by_run[run.name] = {
            "starts": len(rows),
            "errors": part["errors"],
            "coverage_90": part["coverage"]["0.9"] if stochastic else None,
        }
    coverage = figures["coverage"]
    share = {
        g: [float(np.mean(list(coverage[f"{level:g}"][g].values()))) for level in LEVELS]
        for g in coverage["0.9"]
    }
    entry = {
        "name": candidate.name,
        "folder": candidate.folder,
        "kind": candidate.model.spec.kind,
        "dt_s": candidate.model.spec.dt,
        "stochastic": stochastic,
        "starts": len(scores.kept),
        "diverged": scores.diverged,
        "held_out": not any(trained_on(match) for match in matches.values()),
        "trained_on": {name: trained_on(match) for name, match in matches.items()},
        "trained_on_match": dict(matches),
        "evaluated_at_s": dict(zip(keys, grid.times, strict=True)),
        "errors": figures["errors"],
        "coverage": coverage if stochastic else None,
        "coverage_channels": figures["coverage_channels"] if stochastic else None,
        "crps": figures["crps"],
        "spread": figures["spread"],
        "nll": figures["nll"],
        "calibration": {"nominal": list(LEVELS), "share": share} if stochastic else None,
        "by_run": by_run,
        "one_step": one_step(candidate.model, grid.runs),
    }
    if candidate.measurement_std is not None:
        std = candidate.measurement_std.tolist()
        entry["sensor_std"] = dict(zip(candidate.model.system.state_names, std, strict=True))
    return entry


def _remarks(candidate: Candidate, scores: Scores, matches: Mapping[str, str]) -> list[Note]:
    """What a reader must know of a model before believing its figures."""
    name = candidate.name
    ways = {
        WHOLE: "was trained on {}: this is no test",
        PART: "was trained on rows of {}: this is no test",
        BY_NAME: "was trained on runs named {} (it did not record what they hold), taken for these: this is no test",
    }
    remarks = []
    for match, text in ways.items():
        runs = [run for run, found in matches.items() if found == match]
        if runs:
            remarks.append(note(f"{name} {text.format(listed(runs))}", red=True))
    if candidate.seen.hashes is None:
        old = f"{name} was written by an older version, which did not record what its training runs hold: they are "
        remarks.append(note(old + "recognised by name alone"))
    if namesakes := [run for run, found in matches.items() if found == NAMESAKE]:
        text = f"{name} was trained on other runs of the name {listed(namesakes)}; make sure that they are others"
        remarks.append(note(text))
    if scores.diverged:
        left = "" if scores.diverged == scores.starts else "; its figures leave these out, which flatters it"
        text = f"{name} diverged from {scores.diverged} of {scores.starts} starts{left}"
        remarks.append(note(text, red=True))
    elif not scores.stochastic:
        text = f"{name} is deterministic: no intervals and no likelihood; its CRPS is the absolute error"
        remarks.append(note(text))
    return remarks


def _differences(
    models: Sequence[Mapping[str, Any]],
    grids: Sequence[Grid],
    scores: Sequence[Scores],
    still: Mapping[str, Tensor],
    places: tuple[NDArray[np.int64], NDArray[np.float64]],
    keys: list[str],
    seed: int,
    replicates: int,
) -> dict[str, Any]:
    """Each further model and each baseline against the first model."""
    index, t = places
    length = max(bootstrap.BLOCK_S * grids[0].windows.pace, 2.0 * grids[0].times[-1])
    blocks = make_blocks(index, t, length=length)
    every = torch.arange(len(index))
    others = [
        (model["name"], made.kept, made.squares, grid.times, model["held_out"])
        for model, made, grid in zip(models[1:], scores[1:], grids[1:], strict=True)
    ]
    others += [(name, every, squares, grids[0].times, True) for name, squares in still.items()]
    first, against = scores[0], {}
    for name, kept, squares, times, held_out in others:
        both = torch.from_numpy(np.intersect1d(first.kept.numpy(), kept.numpy()))
        errors: dict[str, dict[str, Any]] = {}
        if len(both):
            mine, theirs = (
                e[torch.searchsorted(rows, both)].flatten(1).double()
                for rows, e in ((first.kept, first.squares), (kept, squares))
            )
            own = make_blocks(index[both.numpy()], t[both.numpy()], length=length)
            generator = torch.Generator().manual_seed(seed)
            made = paired_bootstrap(
                mine, theirs, own, generator=generator, replicates=replicates, level=_LEVEL
            )
            meet = [abs(a - b) <= 0.01 * a for a, b in zip(grids[0].times, times, strict=True)]
            roots = (mine.mean(0).sqrt(), theirs.mean(0).sqrt())
            table = torch.stack([*roots, made.value, made.low, made.high], -1).view(len(keys), -1, 5)
            for g, of_group in zip(first.system.error_groups, table.unbind(1), strict=True):
                rows = [[value * g.factor for value in row] for row in of_group.tolist()]
                found = zip(keys, rows, meet, strict=True)
                errors[g.name] = {h: _difference(*row) if there else None for h, row, there in found}
        against[name] = {
            "held_out": bool(models[0]["held_out"] and held_out),
            "starts": len(both),
            "errors": errors,
        }
    how = {"level": _LEVEL, "replicates": replicates, "unit": blocks.unit, "blocks": blocks.count}
    return {"first": models[0]["name"], **how, "against": against}


def _difference(first: float, other: float, value: float, low: float, high: float) -> dict[str, Any]:
    ends = (low, high) if low == low else (None, None)
    found = {"first": first, "other": other, "difference": value, "low": ends[0], "high": ends[1]}
    return {**found, "verdict": bootstrap.verdict(low, high)}
