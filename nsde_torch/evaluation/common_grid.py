"""Models to compare, and the starts and horizons that all of them can be scored at.

Starts are those of the grid of the runs (`start_every`) from which the longest window of every model fits in its
stretch. A horizon that is no whole number of a model's steps is scored at the nearest step, against the truth there.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.data import DataSet, Run, Windows
from nsde_torch.data.interventions import interventional, longest_stretch
from nsde_torch.errors import ConfigError, DataError, NonFiniteError
from nsde_torch.evaluation.metrics import all_horizons, horizons_of, start_grid, thinned, windows_of
from nsde_torch.evaluation.report import lookahead
from nsde_torch.evaluation.scores import BASELINES
from nsde_torch.evaluation.seen import SeenRuns
from nsde_torch.models.model import Model
from nsde_torch.recording.smoothing import smoothing_width

INTERVENTIONS = (
    "these starts are interventions: the inputs were set from outside, whatever the state was, so that errors and "
    "intervals tell what an input does"
)
READ = "predictions read from the logged inputs, which a controller chose, what disturbed the machine"
_CLOCK_TOLERANCE = 0.01  # what two measurements of one clock may differ by
_STEP_TOLERANCE = 0.01
_SMOOTHING_TOLERANCE = 0.1

Note = dict[str, Any]


def note(text: str, *, red: bool = False) -> Note:
    """A remark on an evaluation; red if figures are misleading without it."""
    return {"text": text, "red": red}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A model to evaluate."""

    name: str  # name in tables and figures
    model: Model
    seen: SeenRuns  # runs that it was trained on
    folder: str = ""  # its run directory
    measurement_std: Tensor | None = None
    """Noise of the sensors of the runs if it is not that of its training data (nx,)."""
    reach: float = 0.0  # reach of its input filter on each side [s]
    smoothing: float = 0.0  # width of the average that had smoothed the inputs of its training data [s]


@dataclass(frozen=True)
class Grid:
    """Where a model is scored."""

    runs: Sequence[Run]  # the runs with the input columns that the model reads
    windows: Windows  # windows of the model's step in them
    starts: Tensor  # window numbers of the common starts (B,)
    steps: Sequence[int]  # step of the model nearest to each horizon
    dt: float  # step on the clock of the training data [s]

    @property
    def times(self) -> list[float]:
        """Logged times of the steps [s]."""
        return [round(k * self.windows.dt_model, 12) for k in self.steps]

    def located(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Number of the run (B,) and logged time (B,) [s] of each start."""
        places = self.windows.locate(self.starts)
        numbers = {run.name: k for k, run in enumerate(self.runs)}
        index = np.array([numbers[name] for name, _ in places], dtype=np.int64)
        t = np.array([self.runs[k].t[s] for k, (_, s) in zip(index, places, strict=True)])
        return index, t


def check(candidates: Sequence[Candidate], data: DataSet) -> None:
    """Refuse models that cannot be compared on these data.

    A ConfigError names different systems, names given twice, or a step that does not divide; a DataError a column that
    is missing.
    """
    if not candidates:
        raise ConfigError("no model to evaluate.")
    names = [c.name for c in candidates]
    for name in names:
        if names.count(name) > 1 or name in BASELINES:
            raise ConfigError(
                f"{name!r} is the name of two models, or that of a baseline; name each with names=[...]."
            )
    first = candidates[0]
    for c in candidates:
        own, other = first.model, c.model
        if own.spec.system != other.spec.system or own.system.state_names != other.system.state_names:
            raise ConfigError(
                f"only models of one system can be compared: {first.name!r} is of {own.spec.system}, {c.name!r} of "
                f"{other.spec.system}. Evaluate them one by one."
            )
        needed = (*other.system.input_names, *other.system.exogenous)
        if other.system.state_names != data.state_names or not set(needed) <= set(data.input_names):
            raise DataError(
                f"{c.name!r} needs the columns {', '.join((*other.system.state_names, *needed))}; the data have "
                f"{', '.join((*data.state_names, *data.input_names))}."
            )
        ratio = other.spec.dt / data.dt
        if round(ratio) < 1 or abs(ratio / round(ratio) - 1) > _STEP_TOLERANCE:
            raise ConfigError(
                f"{c.name!r} has a step of {other.spec.dt:g} s, which is no whole multiple of the data's "
                f"{data.dt:g} s; read files with data.dt={other.spec.dt:g}."
            )


def common_horizons(
    candidates: Sequence[Candidate], runs: Sequence[Run], given: Sequence[float] | None
) -> tuple[list[float], list[Note]]:
    """Horizons [s] that every model and some stretch of the runs has, and what to say of them.

    A ConfigError where one that is given is below the step of a model, a DataError where it, or any, does not fit in
    the runs.
    """
    coarsest = max(candidates, key=lambda c: c.model.spec.dt)
    dt = coarsest.model.spec.dt
    longest = longest_stretch(runs)
    notes = []
    if given is None:
        wanted = list(horizons_of(runs, dt))
        if not wanted:
            raise DataError(
                f"the runs ({', '.join(run.name for run in runs[:5])}) are too short for the shortest horizon; "
                "evaluate on longer ones."
            )
        short = [f"{h:g}" for h in all_horizons(runs[0].pace, dt) if h < 0.99 * dt]
        if short:
            notes.append(note(f"{', '.join(short)} s left out: below the step of {coarsest.name}, {dt:g} s"))
    else:
        wanted = sorted({float(h) for h in given})
        if not wanted:
            raise ConfigError("`horizons` is empty; give times in seconds, or leave it out.")
        if wanted[0] < 0.99 * dt:
            raise ConfigError(
                f"`horizons` must not be below the step of {coarsest.name!r}, {dt:g} s; got {wanted[0]:g} s."
            )
        if wanted[-1] > longest + 1e-6:
            raise DataError(
                f"`horizons` must fit in the runs, whose longest stretch without a gap is {longest:.4g} s; got "
                f"{wanted[-1]:g} s."
            )
    for step in dict.fromkeys(c.model.spec.dt for c in candidates):
        between = [h for h in wanted if abs(max(1, round(h / step)) * step / h - 1) > _STEP_TOLERANCE]
        if between:
            nearest = ", ".join(f"{h:g} s at {max(1, round(h / step)) * step:g} s" for h in between)
            *first, last = [c.name for c in candidates if c.model.spec.dt == step]
            who = f"{', '.join(first)} and {last} have" if first else f"{last} has"
            notes.append(note(f"{who} a step of {step:g} s, scored at the nearest one: {nearest}"))
    return wanted, notes


def common_grids(
    candidates: Sequence[Candidate], data: DataSet, runs: Sequence[Run], horizons: Sequence[float]
) -> tuple[list[Grid], list[Note]]:
    """The grid of every model, with the same starts, and what to say of their clocks and inputs."""
    whole = []
    for c in candidates:
        steps = [max(1, round(h / c.model.spec.dt)) for h in horizons]
        own = _with_columns(runs, c, data)
        windows = windows_of(c.model, own, steps[-1])
        whole.append(Grid(own, windows, start_grid(windows), steps, c.model.spec.dt))
    rows = [grid.windows.rows(grid.starts) for grid in whole]
    common = reduce(np.intersect1d, rows)
    if len(common) == 0:
        raise DataError(f"no stretch of {horizons[-1]:g} s without a gap; evaluate on longer runs.")
    smoothing = smoothing_width(data.runs, candidates[0].model.system.nu)
    grids, notes, ahead = [], [], []
    readers = [c.name for c in candidates if c.model.capabilities.knows_feedback]
    if interventional(runs):
        notes.append(note(INTERVENTIONS))
    elif readers:
        notes.append(note(f"{', '.join(readers)}: {READ}"))
    for c, grid, at in zip(candidates, whole, rows, strict=True):
        dt, remark = _own_step(c, data, grid.windows, grid.starts[:1])
        notes += remark
        kept = thinned(grid.starts[torch.from_numpy(np.isin(at, common))])
        grids.append(replace(grid, starts=kept, dt=dt))
        notes += _of_smoothing(c, smoothing)
        ahead.append((c.name, lookahead(smoothing, c.reach)))
    return grids, notes + _said_once(ahead)


def _of_smoothing(c: Candidate, smoothing: float) -> list[Note]:
    """Whether the inputs of the runs were smoothed as those of a model's training data."""
    if abs(smoothing - c.smoothing) <= _SMOOTHING_TOLERANCE * c.smoothing:
        return []
    widths = (c.smoothing, smoothing)
    before, here = (f"smoothed over {w:.2g} s" if w else "without a smoothing" for w in widths)
    text = f"{c.name} was trained on inputs {before}, and these are inputs {here}"
    still = "; its filter, learned to undo the former, is applied all the same" if c.reach else ""
    return [note(text + still)]


def _said_once(ahead: Sequence[tuple[str, str]]) -> list[Note]:
    """What the inputs see of the future: once if it is the same for all models."""
    words: dict[str, list[str]] = {}
    for name, text in ahead:
        words.setdefault(text, []).append(name)
    who = {text: "" if len(words) == 1 else f"{', '.join(names)}: " for text, names in words.items()}
    return [note(before + text) for text, before in who.items() if text]


def _with_columns(runs: Sequence[Run], candidate: Candidate, data: DataSet) -> list[Run]:
    """The runs with the inputs that a model reads, in its order."""
    system = candidate.model.system
    needed = (*system.input_names, *system.exogenous)
    if needed == data.input_names:
        return list(runs)
    columns = [data.input_names.index(n) for n in needed]
    return [replace(run, u=run.u[:, columns]) for run in runs]


def _own_step(
    candidate: Candidate, data: DataSet, windows: Windows, start: Tensor
) -> tuple[float, list[Note]]:
    """Step on the clock of the training data [s]: `spec.dt`, unless the clocks of the two differ."""
    name, dt, own = candidate.name, candidate.model.spec.dt, float(candidate.model.clock_scale)
    ratio = data.clock_scale / own
    if abs(ratio - 1) <= _CLOCK_TOLERANCE:
        return dt, []
    here = f"a logged second holds {data.clock_scale:.4g} s in these data"
    clocks = f"{here} and {own:.4g} s in the training data of {name}"
    if _takes(candidate.model, windows, start, dt * ratio):
        return dt * ratio, [note(f"{clocks}, which therefore takes steps of {dt * ratio:.4g} s")]
    return dt, [note(f"{clocks}, which knows no step but its own: it lives in the other clock", red=True)]


@torch.no_grad()
def _takes(model: Model, windows: Windows, start: Tensor, dt: float) -> bool:
    """Whether a model can take steps of another length than its own: one that predicts the next state cannot."""
    x, u, t0 = windows.batch(start)
    generator = torch.Generator().manual_seed(0)
    try:
        with suppress(NonFiniteError):
            model.sample(x[:, 0], u[:, :1], dt=dt, particles=2, generator=generator, t0=t0.to(x.dtype))
    except ConfigError:
        return False
    return True
