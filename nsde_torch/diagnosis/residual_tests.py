"""Specification tests: what the residual still depends on, of everything that was measured (`regressors`).

For a channel with whitened residual w and a group of functions Z of one variable (cut free of what the parameters
can do), the scores s_b = Z_b' w_b of B blocks of time have mean 0 if nothing is missing (`evidence`). Each variable is
tested in all runs and in the one run that stands out, as something that repeats (`periodicity`), and all channels at
their line of the spectrum and at their largest moment: of bumps all over every stretch, of which M make the chance of
the largest M times that of one (Bonferroni).

**One run.** What broke, or was left on, in one recording: the functions of the variable times the indicator of a run,
free of what the parameters can do, of the same functions in all runs, and of what is constant in a run, so that nothing
is left for them of what is there in every run or of a place that one run alone goes to. With g_r the squares that q of
them explain in run r, and g those that all n > q of all R runs explain, nothing special in a run gives

    g_r ~ chi2(q),        (g_r / q) / s ~ F(q, n - q + m),        s = (g - g_r + m) / (n - q + m),

the second whatever the noise model has missed in every run (its size s of 1 counts as m differences between
runs: Smyth, Statistical Applications in Genetics and Molecular Biology 3 (2004)), and coefficients within their
scatter over the blocks of time of the run. The largest of the three chances counts, times the number of runs. With
two runs nobody knows which of them is the odd one.

**Noise models.** What is strong hides twice: the noise model has learned it, and it scatters over blocks itself. An
autoregression that was fitted to a residual has learned what the physics lacks: a strong smooth force passes for noise
that lasts, and a test under that model does not see it. So each group of functions is given the likelihood that it has
with a noise model of its own,

    L(Z) = max over a, b and the noise model   of   -N log std - orders,         r = J a + Z b + noise

by turns: a and b by generalised least squares under a model, the model from what they leave. With functions one turn
is enough, from the sensor's noise alone, which has learned nothing, or from the model that is there. Where a model
without a dependence is much likelier, it is tested under that one too, with the scatter from leaving blocks out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtrc, fdtrc, ndtr

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions
from nsde_torch.diagnosis.evidence import (
    bonferroni,
    chance,
    enough,
    folds,
    independent,
    jackknife,
    nats_of,
    orthonormal,
)
from nsde_torch.diagnosis.periodicity import COUNTS, WHOLE, Line, best_repeat, lines, waves_of
from nsde_torch.diagnosis.regressors import (
    BEFORE,
    SMOOTH,
    Regressors,
    own_space,
    projected,
    regressors,
    whitened_functions,
)
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.sysid.noise import Noise, Series, estimate, first_guess
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.time_limit import check_time


@dataclass(frozen=True)
class Dependence:
    """How one channel depends on one variable."""

    channel: str  # name of the channel
    variable: str  # name of the variable ("time", "run" and "x * y" too)
    p: float  # chance of this without any dependence, not corrected for the number of tests
    share: float  # share of the whitened variance that the functions explain, corrected for their number
    odd: float  # share of that by odd functions, the rest by even ones
    gain: float  # log-likelihood that the functions would bring [nats]
    functions: int  # number of functions
    run: int | None = None  # number of the run, of a test of one run alone or of a single moment
    moment: float | None = None  # time of a single moment [s]
    sinusoid: float | None = None  # frequency of a sinusoid that no phase holds together [Hz]
    noise: Noise | None = None  # ARMA noise model without the functions; None: that of the regression

    @property
    def excess(self) -> float:
        """Nats beyond what as many functions bring in noise, half a nat each."""
        return self.gain - 0.5 * self.functions

    @property
    def everywhere(self) -> bool:
        """Whether it is one of functions that are the same in all runs."""
        return self.run is None and self.sinusoid is None


def variables_of(search: Search, base: Base) -> Regressors:
    """What the residuals of physics may depend on."""
    return regressors(
        base.regression,
        inputs=search.inputs,
        moved=search.moved,
        decisions=search.decisions,
        budgets=search.budgets,
    )


def beyond_chance(
    tests: Sequence[Dependence], allowed: Mapping[str, float], *, alpha: float
) -> list[Dependence]:
    """Tests that find something after correction for their number, what explains most first.

    Args:
        tests: All tests.
        allowed: Likelihood ratio that feedback may hide, by channel (`feedback_bias`).
        alpha: Significance level of the stage.
    """
    found = (
        d
        for d in tests
        if bonferroni(d.p, len(tests)) < alpha and d.excess > 0.5 * allowed.get(d.channel, 0.0)
    )
    return sorted(found, key=lambda d: -d.excess)


def overview(regression: Regression, variables: Regressors) -> list[Dependence]:
    """Every channel against each single variable, inputs before, time and run in all runs, the surest first.

    What effects that were found had to explain. It decides nothing, and takes a third of the time of all tests.
    """
    labels = folds(regression, variables.decisions), regression.whitened_rows(regression.blocks)
    names = (*variables.columns, *(n for n in variables.functions if _is_other(n)))
    made = {name: variables.functions[name]() for name in names}
    out = []
    for i, models in enumerate(_noise_models(regression, variables)):
        for name in names:
            check_time()
            out += _of_variable(regression, i, name, made[name], variables, models, labels, alone=False)
    return sorted(out, key=lambda d: d.p)


def _is_other(name: str) -> bool:
    return name in ("time", "run") or name.endswith(BEFORE)


def dependences(regression: Regression, variables: Regressors) -> list[Dependence]:
    """Every channel against every variable, the surest first.

    Args:
        regression: At its optimum.
        variables: What it may depend on.
    """
    of_white = regression.whitened_rows(regression.blocks)
    decisions, budgets = variables.decisions, variables.budgets
    fold = folds(regression, decisions)
    out: list[Dependence] = []
    spans, moments = bumps(regression)
    places, of_channel = _places(regression.vector.system, variables), _noise_models(regression, variables)
    of_functions: list[list[Dependence]] = [[] for _ in regression.rows]
    for name in variables.functions:
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


def _noise_models(regression: Regression, variables: Regressors) -> list[NoiseModels]:
    """Of each channel of a regression."""
    limits, decisions, budgets = regression.carry_limits(), variables.decisions, variables.budgets
    return [
        NoiseModels(regression, i, float(limits[c]), decisions=decisions, budgets=budgets)
        for i, c in enumerate(regression.rows)
    ]


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
    *,
    alone: bool = True,
) -> list[Dependence]:
    """A channel against one group of functions: in all runs, and if asked for, of a plain variable in one run alone.

    `made` are the functions per unit of time (M, q), and which of them are odd (q,); `labels` folds and blocks of
    whitened rows.
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
    if alone and name in variables.columns:
        group = _Group(functions, odd, own, whitened)
        in_run = _in_one_run(there, i, group, (out[0], nats_of(z, left)), models, variables)
        out += [] if in_run is None else [in_run]
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
    group: _Group,
    in_all: tuple[Dependence, float],
    models: NoiseModels,
    variables: Regressors,
) -> Dependence | None:
    """The same variable in the run that stands out.

    `regression` is under the noise model of the test of all runs; `in_all` that test, and the nats that it explains.
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
    """Variables along which something may repeat: positions of joints, and angles; not a place in free space."""
    named = set() if system.quaternion is not None else {p for p, _, _ in system.position_derivatives}
    angles = {n for n, unit in zip(system.feature_names, system.feature_units, strict=True) if unit == "rad"}
    return [name for name in variables.columns if name in named | angles]


# ---- one run -------------------------------------------------------------------------------------------

_NEW = 1e-3  # of the square of a function: less is nothing that the others do not do


@dataclass(frozen=True)
class Alone:
    """What functions of a variable explain in one run."""

    run: int  # number of the run
    p: float  # chance of it where the run is like all others, times the number of runs
    columns: Array  # orthonormal columns (N, q), free of what the parameters can do
    kept: NDArray[np.int64]  # which functions they came from (q,)


def alone(
    whitened: Array,
    everywhere: Array,
    constant: Array,
    white: Array,
    own: Array,
    owners: Labels,
    dt: float,
    *,
    decisions: Decisions = DECISIONS,
    budgets: Budgets = BUDGETS,
) -> Alone | None:
    """The run in which functions explain most beyond what they explain in all runs; None where no run can be odd.

    Args:
        whitened: Functions, whitened (N, q).
        everywhere: What a place that every run may go to explains: functions in all runs, whitened (N, k).
        constant: The constant 1, whitened (N,).
        white: Whitened residual (N,).
        own: Orthonormal columns of what the parameters can do (N, r).
        owners: Number of the run of each row (N,).
        dt: Time between rows [s].
        decisions: Fewest runs, blocks of time, and m.
        budgets: From which chance on a closer look pays.
    """
    runs = np.unique(owners)
    if len(runs) < decisions.fewest_runs:
        return None
    rows = [owners == run for run in runs]
    whole = np.column_stack((own, everywhere, white, whitened))
    for inside in rows:  # free of what is constant in a run
        level = constant[inside] / max(float(np.linalg.norm(constant[inside])), 1e-300)
        whole[inside] -= np.outer(level, level @ whole[inside])
    nuisances = own.shape[1] + everywhere.shape[1]
    nothing, left, free = orthonormal(whole[:, :nuisances]), whole[:, nuisances], whole[:, nuisances + 1 :]
    left = left - nothing @ (nothing.T @ left)
    shadow = np.concatenate([nothing[inside].T @ free[inside] for inside in rows], 1)
    gram = block_diag(*(free[inside].T @ free[inside] for inside in rows)) - shadow.T @ shadow
    pull = np.concatenate([free[inside].T @ left[inside] for inside in rows])
    size, count = np.sqrt(np.maximum(np.diag(gram), 1e-300)), free.shape[1]
    gram, pull = gram / size / size[:, None], pull / size
    own_part = [slice(k * count, (k + 1) * count) for k in range(len(runs))]
    found = [_explained(gram[part, part], pull[part]) for part in own_part]
    most = int(np.argmax([ratio for ratio, _ in found]))
    (ratio, q), (in_all, n) = found[most], _explained(gram, pull)
    if not 0 < q < n:
        return None
    inside = rows[most]
    freedom = n - q + decisions.odd_run_prior
    rest = (max(in_all - ratio, 0.0) + decisions.odd_run_prior) / freedom
    ratio /= max(float(np.square(left[inside]).mean()), 1.0)
    p = len(runs) * max(float(chdtrc(q, ratio)), float(fdtrc(q, freedom, ratio / q / rest)))
    if p < budgets.closer_chance:
        own_rows = free[inside] - nothing[inside] @ shadow[:, own_part[most]]
        p = max(p, len(runs) * _by_blocks(own_rows, left[inside], dt, decisions))
    columns = -own @ (own[inside].T @ whitened[inside])
    columns[inside] += whitened[inside]
    z, kept = independent(columns)
    return Alone(int(runs[most]), min(1.0, p), z, kept) if z.shape[1] else None


def _explained(gram: Array, pull: Array) -> tuple[float, int]:
    """Squares that columns of length 1 with these products (q, q), (q,) explain, and how many directions they have."""
    values, vectors = np.linalg.eigh(gram)
    live = values > _NEW
    return float(np.square(vectors[:, live].T @ pull / np.sqrt(values[live])).sum()), int(live.sum())


def _by_blocks(z: Array, left: Array, dt: float, decisions: Decisions) -> float:
    """Chance of the coefficients of functions in a run (n, q) from leaving out blocks of time; 1 if it is too short."""
    columns, _ = independent(z)
    length = max(len(left) // decisions.odd_run_blocks, round(decisions.odd_run_shortest / dt), 1)
    block = np.arange(len(left)) // length
    if not columns.shape[1] or not enough(int(block[-1]) + 1, columns.shape[1], decisions):
        return 1.0
    return jackknife(columns, left, block, decisions)


# ---- noise models --------------------------------------------------------------------------------------

_SETTLED = 0.5  # nats: turns between parameters and noise model that bring less have converged


@dataclass(frozen=True)
class FittedNoise:
    """A noise model and its likelihood."""

    noise: Noise  # the ARMA noise model that is left
    likelihood: float  # log likelihood, less one for each parameter of the noise model


@final
class _Start:
    """A noise model, slopes (N, k) and the residual (N,) in its whitened rows, and their products."""

    def __init__(self, noise: Noise, slopes: Array, white: Array) -> None:
        self.noise, self.slopes, self.white = noise, slopes, white
        self.gram, self.pull = slopes.T @ slopes, slopes.T @ white


@final
class NoiseModels:
    """ARMA noise models of one channel with something taken out.

    Args:
        regression: At its optimum.
        channel: Number of the channel among its rows.
        limit: Largest c of the channel (`Regression.carry_limits`).
        decisions: How much likelier a model must be.
        budgets: How many turns are made.

    Attributes:
        base: The noise model with nothing taken out but what the parameters can do.
        own: Orthonormal columns (N, r) of what the parameters can do to the whitened residual.
    """

    def __init__(
        self,
        regression: Regression,
        channel: int,
        limit: float,
        *,
        decisions: Decisions = DECISIONS,
        budgets: Budgets = BUDGETS,
    ) -> None:
        self._regression, self._limit = regression, limit
        self.own = own_space(regression, channel)
        self._decisions, self._budgets = decisions, budgets
        at = regression.rows[channel]
        self._times = regression.times(at)
        self._residual, self._slopes = regression.residual[:, at], regression.jacobian[:, at]
        self._there = there = regression.noises[channel]
        self.base = max(self._own(there), self._settled(there), key=lambda own: own.likelihood)
        rough = first_guess(self._residual, regression.series, limit, times=self._times)
        self._starts = [_Start(noise, *self._whitened(noise)) for noise in (rough, self.base.noise)]

    def without(self, functions: Array, whitened: Array | None = None) -> FittedNoise | None:
        """The noise model that is left without some functions; None where it is not much likelier.

        Args:
            functions: Per unit of time (M, q).
            whitened: The same in rows that the regression whitens (N, q); None works them out.
        """
        columns, best = functions * self._regression.dt, self.base
        for start in self._starts:
            own = whitened if start.noise is self._there else None
            if own is None:
                own = self._regression.whitened(start.noise, columns)
            best = max(best, self._left(start, columns, own), key=lambda found: found.likelihood)
        more = best.likelihood - self.base.likelihood
        return best if more > 0.5 * columns.shape[1] + self._decisions.noise_blind_nats else None

    def _settled(self, noise: Noise) -> FittedNoise:
        """The noise model of the residual, from a first one by turns."""
        best, nothing = FittedNoise(noise, -np.inf), self._slopes[:, :0]
        for turn in range(self._budgets.noise_turns):
            slopes, white = self._whitened(best.noise)
            start = _Start(best.noise, slopes, white)
            this = self._left(start, nothing, slopes[:, :0], thorough=turn > 0)
            if this.likelihood < best.likelihood + _SETTLED:
                break
            best = this
        return best

    def _whitened(self, noise: Noise) -> tuple[Array, Array]:
        """Slopes (N, k) and the residual (N,) in whitened rows."""
        whitened = self._regression.whitened(noise, np.column_stack((self._slopes, self._residual)))
        return whitened[:, :-1], whitened[:, -1]

    def _left(self, start: _Start, columns: Array, whitened: Array, *, thorough: bool = False) -> FittedNoise:
        """The noise model of what generalised least squares leave; every c is tried if it is to be thorough.

        `start` weighs rows, `columns` (M, q) are fitted beside the slopes, `whitened` the same in whitened rows (N, q).
        """
        cross = start.slopes.T @ whitened
        gram = np.block([[start.gram, cross], [cross.T, whitened.T @ whitened]])
        size = np.maximum(np.sqrt(np.diag(gram)), 1e-300)
        pull = np.append(start.pull, whitened.T @ start.white) / size
        weights = np.linalg.lstsq(gram / size / size[:, None], pull, rcond=1e-12)[0] / size
        count = self._slopes.shape[1]
        left = self._residual - self._slopes @ weights[:count] - columns @ weights[count:]
        r = self._regression
        among = None if thorough else sorted({0.0, start.noise.carry, self._limit})
        found = estimate(
            left,
            r.series,
            limit=self._limit,
            orders=r.orders,
            memory=r.memory,
            among=among,
            times=self._times,
        )
        return self._own(found)

    def _own(self, noise: Noise) -> FittedNoise:
        return FittedNoise(noise, noise.likelihood(len(self._regression.series)))


# ---- moments -------------------------------------------------------------------------------------------

_BUMPS_S = (0.25, 1.0)  # widths of bumps


def bumps(regression: Regression) -> tuple[list[tuple[int, int]], list[Array]]:
    """Bumps in time, a second and a quarter long, all over every stretch: rows of their ends, and their shapes."""
    spans, shapes_ = [], []
    for width_s in _BUMPS_S:
        n = max(4, round(width_s / regression.dt))
        shape = np.hanning(n + 2)[1:-1]
        for a, b in regression.series.edges:
            spans += [(s, s + n) for s in range(a, b - n, max(1, n // 2))]
            shapes_ += [shape for _ in range(a, b - n, max(1, n // 2))]
    return spans, shapes_


def largest_moment(
    regression: Regression,
    i: int,
    spans: Sequence[tuple[int, int]],
    moments: Sequence[Array],
    decisions: Decisions = DECISIONS,
) -> Dependence | None:
    """The moment at which a channel is pushed most, if that is more than all other moments let expect."""
    noise, white = regression.noises[i], regression.white[i]
    offset = regression.whitened_rows(np.arange(len(regression.series)))
    place = np.searchsorted(offset, np.arange(len(regression.series)), side="right") - 1
    z = []
    known: dict[int, Array] = {}
    for (a, _), shape in zip(spans, moments, strict=True):
        n = len(shape)
        if n not in known:  # what the filter of the noise makes of a bump, and of what follows it
            line = Series(((0, 2 * n),))
            padded = np.concatenate((shape, np.zeros(n)))[:, None]
            known[n] = noise.whiten(padded, line)[1:, 0]
        start = int(place[a])
        stop = min(start + 2 * n, len(white))
        template = known[n][: stop - start]
        z.append(float(template @ white[start:stop]) / max(float(np.linalg.norm(template)), 1e-300))
    if len(z) < decisions.moments_fewest:
        return None
    size = np.abs(np.array(z))
    scale = max(1.0, float(np.median(size)) / 0.6745)
    k = int(size.argmax())
    largest = size[k] / scale
    t = float(
        regression.physics.steps.t[min(spans[k][0] * regression.box, len(regression.physics.steps) - 1)]
    )
    return Dependence(
        channel=regression.physics.names[regression.rows[i]],
        variable="time",
        p=min(1.0, 2.0 * float(ndtr(-largest)) * len(z)),
        share=max(largest**2 - 1.0, 0.0) / len(white),
        odd=0.0,
        gain=0.5 * largest**2,
        functions=1,
        run=int(regression.owners[spans[k][0]]),
        moment=t,
    )
