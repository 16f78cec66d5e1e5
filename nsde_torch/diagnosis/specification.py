"""Specification tests: what the residual still depends on, of everything that was measured (`regressors`).

For a channel with whitened residual w and a group of functions Z of one variable (cut free of what the parameters
can do), the scores s_b = Z_b' w_b of B blocks of time have mean 0 if nothing is missing (`p_values`). Each variable is
tested in all runs and in the one run that stands out (`one_run`), as something that repeats (`periodicity`), and all
channels at their largest moment (`moments`) and line of the spectrum (`spectrum`).

What is strong hides twice: the noise model has learned it, and it scatters over blocks itself. Where a model without
it is much likelier (`noise_models`), it is tested under that one too, with the scatter from leaving blocks out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.evidence import folds
from nsde_torch.diagnosis.moments import bumps, largest_moment
from nsde_torch.diagnosis.noise_models import NoiseModels
from nsde_torch.diagnosis.one_run import Alone, alone
from nsde_torch.diagnosis.p_values import chance, independent, nats_of
from nsde_torch.diagnosis.periodicity import COUNTS, best_repeat
from nsde_torch.diagnosis.regressors import (
    BEFORE,
    SMOOTH,
    Regressors,
    own_space,
    projected,
    whitened_functions,
)
from nsde_torch.diagnosis.spectrum import WHOLE, Line, lines, waves_of
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.time_limit import check_time

Array = NDArray[np.float64]
Labels = NDArray[np.int64]


def dependences(regression: Regression, variables: Regressors, *, overview: bool = False) -> list[Dependence]:
    """Every channel against every variable, the surest first.

    Args:
        regression: At its optimum.
        variables: What it may depend on.
        overview: Whether single variables, inputs before, time and run are enough, without products of variables and
            what differs over time or between runs: what effects that were found had left to explain.
    """
    of_white = regression.whitened_rows(regression.blocks)
    decisions, budgets = variables.decisions, variables.budgets
    fold = folds(regression, decisions)
    out: list[Dependence] = []
    spans, moments = bumps(regression)
    places, limits = _places(regression.vector.system, variables), regression.carry_limits()
    of_channel = [
        NoiseModels(regression, i, float(limits[c]), decisions=decisions, budgets=budgets)
        for i, c in enumerate(regression.rows)
    ]
    of_functions: list[list[Dependence]] = [[] for _ in regression.rows]
    for name in variables.functions:
        if overview and not _is_overview(name, variables):
            continue
        made = variables.functions[name]()
        for i, models in enumerate(of_channel):
            check_time()
            of_functions[i] += _of_variable(regression, i, name, made, variables, models, (fold, of_white))
    for i, channel in enumerate(regression.rows):
        white, own = regression.white[i], of_channel[i].own
        out += of_functions[i]
        for name in places:
            again = best_repeat(regression, i, variables.columns[name], own)
            if again is not None:
                price = float(np.log(len(COUNTS)))
                out.append(
                    Dependence(
                        channel=regression.physics.names[channel],
                        variable=name,
                        p=min(
                            1.0,
                            len(COUNTS) * chance(again.columns, white, fold, of_white, decisions=decisions),
                        ),
                        share=2.0 * max(again.nats - 1.0 - price, 0.0) / len(white),
                        odd=0.5,
                        gain=again.nats - price,
                        functions=2,
                    )
                )
        found = largest_moment(regression, i, spans, moments, decisions)
        if found is not None:
            out.append(found)
    # inputs that were restored swing at the nulls of the average
    for line in (
        lines(regression, fewest=WHOLE, decisions=decisions, budgets=budgets)[:1] if variables.inputs else []
    ):
        out.append(_sinusoid(regression, line, of_channel[line.row]))
    return sorted(own_of_runs(out), key=lambda d: d.p)


def _is_overview(name: str, variables: Regressors) -> bool:
    return name in (*variables.columns, "time", "run") or name.endswith(BEFORE)


def own_of_runs(tests: Sequence[Dependence]) -> list[Dependence]:
    """The tests, without chance for what one run alone has where something in all runs explains the channel better.

    What depends on another variable in every run looks like a matter of the run that shows it most.
    """
    best: dict[str, float] = {}
    for d in tests:
        if d.everywhere:
            best[d.channel] = max(best.get(d.channel, -np.inf), d.excess)
    return [
        replace(d, p=1.0)
        if d.run is not None and d.moment is None and d.excess <= best.get(d.channel, -np.inf)
        else d
        for d in tests
    ]


def _of_variable(
    regression: Regression,
    i: int,
    name: str,
    made: tuple[Array, NDArray[np.bool_]],
    variables: Regressors,
    models: NoiseModels,
    labels: tuple[Labels, Labels],
) -> list[Dependence]:
    """A channel against one group of functions: in all runs, and of a plain variable in one run alone.

    Args:
        regression: At its optimum.
        i: Number of the channel among its rows.
        name: Of the group.
        made: Its functions per unit of time (M, q), and which of them are odd (q,).
        variables: What the residual may depend on.
        models: Noise models of the channel.
        labels: Folds and blocks of whitened rows.
    """
    functions, odd = made
    there, own = regression, models.own
    whitened = whitened_functions(there, i, functions)
    z, kept = independent(whitened - own @ (own.T @ whitened))
    if not z.shape[1]:
        return []
    left, noise = regression.white[i], None
    p, gain = chance(z, left, *labels, decisions=variables.decisions), nats_of(z, left)
    other = models.without(functions, whitened)
    if other is not None:
        noise, there = other.noise, regression.under(i, other.noise)
        own = own_space(there, i)
        whitened = whitened_functions(there, i, functions)
        z, kept = independent(whitened - own @ (own.T @ whitened))
        # under another noise model the parameters would be elsewhere
        left = there.white[i] - own @ (own.T @ there.white[i])
        p = min(1.0, 2.0 * min(p, chance(z, left, *labels, strong=True, decisions=variables.decisions)))
        gain = other.likelihood - models.base.likelihood
    channel = regression.physics.names[regression.rows[i]]
    out = [_dependence(channel, name, z, odd[kept], left, p=p, gain=gain, noise=noise)]
    if name in variables.columns:
        group = _Group(functions, odd, own, whitened)
        alone = _in_one_run(there, i, group, (out[0], nats_of(z, left)), models, variables)
        out += [] if alone is None else [alone]
    return out


@dataclass(frozen=True)
class _Group:
    """Functions of one variable."""

    functions: Array  # per unit of time (M, q)
    odd: NDArray[np.bool_]  # which of them are odd (q,)
    own: Array  # what the parameters can do, whitened (N, r) (`own_space`)
    whitened: Array  # the functions, whitened (N, q)


def _dependence(
    channel: str,
    variable: str,
    z: Array,
    odd: NDArray[np.bool_],
    left: Array,
    *,
    p: float,
    gain: float,
    run: int | None = None,
    noise: Noise | None = None,
) -> Dependence:
    """A test of orthonormal columns (N, q) on what is left (N,)."""
    squares, q = np.square(z.T @ left), z.shape[1]
    explained = float(squares.sum())
    share, of_odd = max(explained - q, 0.0) / max(float(left @ left), 1e-300), float(squares[odd].sum())
    return Dependence(
        channel, variable, p, share, of_odd / max(explained, 1e-300), gain, functions=q, run=run, noise=noise
    )


def _in_one_run(
    regression: Regression,
    i: int,
    group: "_Group",
    in_all: tuple[Dependence, float],
    models: NoiseModels,
    variables: Regressors,
) -> Dependence | None:
    """The same variable in the run that stands out.

    Args:
        regression: Under the noise model of the test of all runs.
        i: Number of the channel among its rows.
        group: The functions.
        in_all: The test of all runs, and the nats that it explains under that model.
        models: Noise models of the channel.
        variables: What the residual may depend on.
    """
    functions, odd = group.functions[:, :SMOOTH], group.odd[:SMOOTH]
    everywhere, explained = in_all
    found = _alone(regression, i, group.whitened, group.own, variables)
    if found is None:
        return None
    p, there, noise = found.p, regression, everywhere.noise
    gain = everywhere.gain * nats_of(found.columns, regression.white[i]) / max(explained, 1e-300)
    if p < variables.budgets.closer_chance:
        other = models.without(functions * (regression.owners == found.run)[:, None])
        if other is not None:
            noise, there = other.noise, regression.under(i, other.noise)
            whitened = whitened_functions(there, i, group.functions)
            again = _alone(there, i, whitened, own_space(there, i), variables)
            if again is not None and again.run == found.run:
                found, p = again, min(1.0, 2.0 * min(p, again.p))
            gain = other.likelihood - models.base.likelihood
    z, kept, left = found.columns, found.kept, there.white[i]
    return _dependence(
        everywhere.channel,
        everywhere.variable,
        z,
        odd[kept],
        left,
        p=p,
        gain=gain,
        run=found.run,
        noise=noise,
    )


def _alone(
    regression: Regression, i: int, whitened: Array, own: Array, variables: Regressors
) -> Alone | None:
    constant = whitened_functions(regression, i, np.ones((len(regression.series), 1)))[:, 0]
    owners = regression.whitened_rows(regression.owners)
    return alone(
        *(whitened[:, :SMOOTH], whitened, constant, regression.white[i], own, owners, regression.dt),
        decisions=variables.decisions,
        budgets=variables.budgets,
    )


def _sinusoid(regression: Regression, line: Line, models: NoiseModels) -> Dependence:
    """A line of the spectrum as a sine and a cosine of its own in each stretch."""
    waves = waves_of(regression, line.frequency)
    other = models.without(waves)
    z = independent(projected(regression, line.row, waves, models.own))[0]
    gain = nats_of(z, regression.white[line.row])
    left = regression.residual[:, regression.rows[line.row]]
    explained = left @ waves @ np.linalg.lstsq(waves, left, rcond=1e-9)[0]
    return Dependence(
        channel=regression.physics.names[regression.rows[line.row]],
        variable="time",
        p=line.p,
        share=float(explained) / max(float(left @ left), 1e-300),
        odd=0.0,
        gain=gain if other is None else other.likelihood - models.base.likelihood,
        functions=waves.shape[1],
        sinusoid=line.frequency,
    )


def _places(system: System, variables: Regressors) -> list[str]:
    """Variables along which something may repeat: positions, and angles."""
    named = {position for position, _, _ in system.position_derivatives}
    angles = {n for n, unit in zip(system.feature_names, system.feature_units, strict=True) if unit == "rad"}
    return [name for name in variables.columns if name in named | angles]
