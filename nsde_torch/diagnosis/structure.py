"""What the residual still depends on: tests against flexible functions of everything that was measured.

For a channel with whitened residual w and a group of functions Z of one variable (cut free of what the parameters
can do), the scores s_b = Z_b' w_b of B blocks of time have mean 0 if nothing is missing (`chances`). The functions
are taken at states foreseen from earlier steps, so that gusts and sensor noise are not in them. Each variable is
tested in all runs and in the one run that stands out (`one_run`), and times the time in the run and each run, as
where a parameter drifts or differs between runs; inputs are tested as they were before, as where they act with a
memory.

What is strong hides twice: the law of the noise has learned it, and it scatters over blocks itself. Where a law without
it is much likelier (`laws`), it is tested under that law too, with the scatter from leaving blocks out.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from nsde_torch.diagnosis.chances import chance, gain_of, independent, orthonormal
from nsde_torch.diagnosis.evidence import folds
from nsde_torch.diagnosis.laws import Laws
from nsde_torch.diagnosis.one_run import LIKELY, Alone, alone
from nsde_torch.diagnosis.repeats import COUNTS, best_repeat
from nsde_torch.diagnosis.spectrum import WHOLE, Line, lines, waves_of
from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.series import Series
from nsde_torch.systems import System

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_HATS = 7
_MIXED = ("collective", "roll_command", "pitch_command", "yaw_command")
_WAVES = 6
_BUMPS_S = (0.25, 1.0)
_FEWEST_MOMENTS = 20
_MOST_RUNS = 12
_FAR = 4.0  # standard deviations
_BEFORE_BOXES = (1, 2, 4, 8)
OVER_TIME, BY_RUN, BEFORE = " over time", " by run", " before"
"""Ends of the names of groups: a variable times time or run, and an input as it was before."""
SMOOTH = 7
"""How many of `functions_of` are smooth over the whole range, ahead of the hats."""


@dataclass(frozen=True)
class Dependence:
    """How one channel depends on one variable.

    Args:
        channel: Name of the channel.
        variable: Name of the variable ("time", "run" and "x * y" too).
        p: Chance of this without any dependence, not corrected for the number of tests.
        share: Share of the whitened variance that the functions explain, corrected for their number.
        odd: Share of that by odd functions, the rest by even ones.
        gain: Twice the log likelihood that the functions would bring.
        functions: Number of functions.
        run: Number of the run, of a test of one run alone or of a single moment.
        moment: Time of a single moment [s].
        swing: Frequency of a swing that no phase holds together [Hz].
        law: Law of the noise without the functions; None: that of the regression.
    """

    channel: str
    variable: str
    p: float
    share: float
    odd: float
    gain: float
    functions: int
    run: int | None = None
    moment: float | None = None
    swing: float | None = None
    law: Noise | None = None

    @property
    def everywhere(self) -> bool:
        """Whether it is one of functions that are the same in all runs."""
        return self.run is None and self.swing is None


def _columns(regression: Regression, *, inputs: bool) -> tuple[dict[str, Array], Array]:
    """Variables that a residual may depend on, in the middle of each box (M,), and the time in the run (M,) [s].

    States that are foreseen (positions and rates, of a quaternion what the system's features make of it), inputs if
    asked for, and logged channels.
    """
    physics, system = regression.physics, regression.vector.system
    z = physics.middle(regression.theta)
    x = z[:, : system.nx]
    columns: dict[str, Array] = {}
    q = system.quaternion
    features = system.residual_features(x).numpy()
    names = [*system.feature_names]
    names += [f"up_{'xyz'[i]}" for i in range(features.shape[1] - len(names))]
    for i, name in enumerate(names):
        columns[name] = features[:, i]
    for i, name in enumerate(system.state_names):
        inside = q is not None and q.start <= i < q.stop
        seen = name in columns or (q is not None and name.startswith("v_"))
        if not (inside or seen):
            columns[name] = x[:, i].numpy()
    u, mix = physics.steps.u.numpy(), getattr(system, "mix", None)
    if inputs and mix is not None:
        columns |= dict(zip(_MIXED, (u[:, : system.nu] @ mix.numpy()).T, strict=True))
    elif inputs:
        columns |= dict(zip(system.input_names, u[:, : system.nu].T, strict=True))
    columns |= dict(zip(system.exogenous, u[:, system.nu :].T, strict=True))
    single, box = regression.single, regression.box
    columns = {k: single.summed(v[:, None], box)[:, 0] / box for k, v in columns.items() if v.std() > 1e-9}
    starts = physics.steps.t.numpy()
    return columns, single.summed(starts[:, None], box)[:, 0] / box


def functions_of(v: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Odd and even functions and bumps of one standardised variable (M, q), and which of them are odd."""
    centre, spread = np.median(v), max(float(np.quantile(v, 0.95) - np.quantile(v, 0.05)) / 2, 1e-12)
    about_zero = v / spread if abs(centre) < spread else (v - centre) / spread
    s = np.clip(about_zero, -3, 3)
    edges = np.quantile(v, np.linspace(0.02, 0.98, _HATS))
    edges = np.unique(edges)
    columns = [s, s**3, np.tanh(5 * s), s**2, np.abs(s), s**4, s**5]
    odd = [True, True, True, False, False, False, True]
    if len(edges) > 3:
        width = np.diff(edges)
        for i in range(1, len(edges) - 1):
            up, down = (v - edges[i - 1]) / width[i - 1], (edges[i + 1] - v) / width[i]
            columns.append(np.clip(np.minimum(up, down), 0, 1))
            odd.append(False)
    return np.stack(columns, 1), np.array(odd)


@dataclass(frozen=True)
class Regressors:
    """All that the residuals of a regression may depend on, in the middle of each box.

    Args:
        columns: Variables by name (M,).
        t: Time in the run (M,) [s].
        functions: By variable; products, drifts, differences between runs, inputs before, `time` and `run` too:
            functions (M, q), and which of them are odd (q,).
        inputs: Whether the inputs are what acted.
    """

    columns: dict[str, Array]
    t: Array
    functions: dict[str, tuple[Array, NDArray[np.bool_]]]
    inputs: bool = True

    def values(self, variable: str) -> Array:
        """A plain variable, or time (M,)."""
        return self.t if variable == "time" else self.columns[variable]


def regressors(regression: Regression, *, inputs: bool = True, moved: bool = False) -> Regressors:
    """Everything that the residuals of a regression may depend on.

    Args:
        regression: At its optimum.
        inputs: Whether the inputs are what acted. Those that were restored from an average err, and what a residual
            holds of such an error depends on them.
        moved: Whether channels were moved to where they belong. Between rows, they bend where inputs change, and what
            moves them does not know.
    """
    columns, t = _columns(regression, inputs=inputs)
    before = _BEFORE_BOXES[1:] if moved else _BEFORE_BOXES
    functions = {name: (z, odd) for name, z, odd in _groups(regression, columns, t, before)}
    return Regressors(columns, t, functions, inputs)


def _groups(
    regression: Regression, columns: dict[str, Array], t: Array, before: Sequence[int]
) -> Iterator[tuple[str, Array, NDArray[np.bool_]]]:
    for name, v in columns.items():
        functions, odd = functions_of(v)
        yield name, functions, odd
    names = list(columns)
    scaled = {k: (v - v.mean()) / max(float(v.std()), 1e-12) for k, v in columns.items()}
    for i, first in enumerate(names):
        others = [np.clip(scaled[first] * scaled[second], -6, 6) for second in names[i + 1 :]]
        if others:
            yield f"{first} times others", np.stack(others, 1), np.zeros(len(others), dtype=bool)
    owners, runs = regression.owners, np.unique(regression.owners)
    phase = np.empty(len(t))
    for run in runs:
        own = owners == run
        phase[own] = (t[own] - t[own].min()) / max(float(np.ptp(t[own])), 1e-9)
    for name, v in scaled.items():
        s = np.clip(v, -_FAR, _FAR)
        yield _named(name + OVER_TIME, [s * (2.0 * phase - 1.0), s * (2.0 * phase - 1.0) ** 2])
        if 1 < len(runs) <= _MOST_RUNS:
            yield _named(name + BY_RUN, [s * (owners == run) for run in runs])
    for name in _inputs_of(regression, columns):
        yield _named(name + BEFORE, [_before(columns[name], regression.series, k) for k in before])
    waves = [phase - 0.5, *(np.cos(np.pi * k * phase) for k in range(1, _WAVES + 1))]
    yield _named("time", waves)
    if 1 < len(runs) <= _MOST_RUNS:
        yield _named("run", [(owners == run) * 1.0 for run in runs])


def _named(name: str, functions: Sequence[Array]) -> tuple[str, Array, NDArray[np.bool_]]:
    return name, np.stack(functions, 1), np.zeros(len(functions), dtype=bool)


def _inputs_of(regression: Regression, columns: Mapping[str, Array]) -> list[str]:
    return [n for n in (*_MIXED, *regression.vector.system.input_names) if n in columns]


def _before(v: Array, series: Series, boxes: int) -> Array:
    """A variable (M,) as it was so many boxes before, in the same stretch."""
    out = v.copy()
    for a, b in series.edges:
        out[a:b] = v[np.maximum(np.arange(a, b) - boxes, a)]
    return out


def dependences(regression: Regression, variables: Regressors, *, overview: bool = False) -> list[Dependence]:
    """Every channel against every variable, the surest first.

    Args:
        regression: At its optimum.
        variables: What it may depend on.
        overview: Whether single variables, inputs before, time and run are enough, without products of variables and
            what differs over time or between runs: what effects that were found had left to explain.
    """
    of_white = regression.whitened_rows(regression.blocks)
    fold = folds(regression)
    out = []
    spans, moments = _moments(regression)
    places, limits = _places(regression.vector.system, variables), regression.carry_limits()
    of_channel = [Laws(regression, i, float(limits[c])) for i, c in enumerate(regression.rows)]
    for i, channel in enumerate(regression.rows):
        white, laws, own = regression.white[i], of_channel[i], own_space(regression, i)
        for name in variables.functions:
            if overview and not _is_overview(name, variables):
                continue
            out += _of_variable(regression, i, name, variables, laws, (fold, of_white))
        for name in places:
            again = best_repeat(regression, i, variables.columns[name], own)
            if again is not None:
                price = 2.0 * np.log(len(COUNTS))
                out.append(
                    Dependence(
                        channel=regression.physics.names[channel],
                        variable=name,
                        p=min(1.0, len(COUNTS) * chance(again.columns, white, fold, of_white)),
                        share=max(again.gain - 2.0 - price, 0.0) / len(white),
                        odd=0.5,
                        gain=again.gain - price,
                        functions=2,
                    )
                )
        found = _one_moment(regression, i, spans, moments)
        if found is not None:
            out.append(found)
    # inputs that were restored swing at the nulls of the average
    for line in lines(regression, swings=WHOLE)[:1] if variables.inputs else []:
        out.append(_swing(regression, line, of_channel[line.row]))
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
            best[d.channel] = max(best.get(d.channel, -np.inf), d.gain - d.functions)
    return [
        replace(d, p=1.0)
        if d.run is not None and d.moment is None and d.gain - d.functions <= best.get(d.channel, -np.inf)
        else d
        for d in tests
    ]


def _of_variable(
    regression: Regression,
    i: int,
    name: str,
    variables: Regressors,
    laws: Laws,
    labels: tuple[Labels, Labels],
) -> list[Dependence]:
    """A channel against one group of functions: in all runs, and of a plain variable in one run alone.

    Args:
        regression: At its optimum.
        i: Number of the channel among its rows.
        name: Of the group.
        variables: What the residual may depend on.
        laws: Of the channel.
        labels: Folds and blocks of whitened rows.
    """
    functions, odd = variables.functions[name]
    there, own = regression, own_space(regression, i)
    whitened = whitened_functions(there, i, functions)
    z, kept = independent(whitened - own @ (own.T @ whitened))
    if not z.shape[1]:
        return []
    left, law = regression.white[i], None
    p, gain = chance(z, left, *labels), gain_of(z, left)
    other = laws.without(functions)
    if other is not None:
        law, there = other.law, regression.under(i, other.law)
        own = own_space(there, i)
        whitened = whitened_functions(there, i, functions)
        z, kept = independent(whitened - own @ (own.T @ whitened))
        # under another law the parameters would be elsewhere
        left = there.white[i] - own @ (own.T @ there.white[i])
        p = min(1.0, 2.0 * min(p, chance(z, left, *labels, strong=True)))
        gain = 2.0 * (other.likelihood - laws.base.likelihood)
    channel = regression.physics.names[regression.rows[i]]
    out = [_dependence(channel, name, z, odd[kept], left, p=p, gain=gain, law=law)]
    if name in variables.columns:
        alone = _in_one_run(there, i, (functions, odd), (out[0], gain_of(z, left)), laws)
        out += [] if alone is None else [alone]
    return out


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
    law: Noise | None = None,
) -> Dependence:
    """A test of orthonormal columns (N, q) on what is left (N,)."""
    squares, q = np.square(z.T @ left), z.shape[1]
    explained = float(squares.sum())
    share, of_odd = max(explained - q, 0.0) / max(float(left @ left), 1e-300), float(squares[odd].sum())
    return Dependence(
        channel, variable, p, share, of_odd / max(explained, 1e-300), gain, functions=q, run=run, law=law
    )


def _in_one_run(
    regression: Regression,
    i: int,
    group: tuple[Array, NDArray[np.bool_]],
    in_all: tuple[Dependence, float],
    laws: Laws,
) -> Dependence | None:
    """The same variable in the run that stands out.

    Args:
        regression: Under the law of the test of all runs.
        i: Number of the channel among its rows.
        group: Functions and which of them are odd.
        in_all: The test of all runs, and the squares that it explains under that law.
        laws: Of the channel.
    """
    functions, odd = group[0][:, :SMOOTH], group[1][:SMOOTH]
    everywhere, explained = in_all
    found = _alone(regression, i, group[0])
    if found is None:
        return None
    p, there, law = found.p, regression, everywhere.law
    gain = everywhere.gain * gain_of(found.columns, regression.white[i]) / max(explained, 1e-300)
    if p < LIKELY:
        other = laws.without(functions * (regression.owners == found.run)[:, None])
        if other is not None:
            law, there = other.law, regression.under(i, other.law)
            again = _alone(there, i, group[0])
            if again is not None and again.run == found.run:
                found, p = again, min(1.0, 2.0 * min(p, again.p))
            gain = 2.0 * (other.likelihood - laws.base.likelihood)
    z, kept, left = found.columns, found.kept, there.white[i]
    return _dependence(
        everywhere.channel, everywhere.variable, z, odd[kept], left, p=p, gain=gain, run=found.run, law=law
    )


def _alone(regression: Regression, i: int, functions: Array) -> Alone | None:
    own, white = own_space(regression, i), regression.white[i]
    whitened = whitened_functions(regression, i, np.column_stack((functions, np.ones(len(functions)))))
    whole, constant = whitened[:, :-1], whitened[:, -1]
    owners = regression.whitened_rows(regression.owners)
    return alone(whole[:, :SMOOTH], whole, constant, white, own, owners, regression.dt)


def _swing(regression: Regression, line: Line, laws: Laws) -> Dependence:
    """A line of the spectrum as a sine and a cosine of its own in each stretch."""
    waves = waves_of(regression, line.frequency)
    other = laws.without(waves)
    z = independent(projected(regression, line.row, waves, own_space(regression, line.row)))[0]
    gain = gain_of(z, regression.white[line.row])
    left = regression.residual[:, regression.rows[line.row]]
    explained = left @ waves @ np.linalg.lstsq(waves, left, rcond=1e-9)[0]
    return Dependence(
        channel=regression.physics.names[regression.rows[line.row]],
        variable="time",
        p=line.p,
        share=float(explained) / max(float(left @ left), 1e-300),
        odd=0.0,
        gain=gain if other is None else 2.0 * (other.likelihood - laws.base.likelihood),
        functions=waves.shape[1],
        swing=line.frequency,
    )


def _places(system: System, variables: Regressors) -> list[str]:
    """Variables along which something may repeat: positions, and angles."""
    named = {position for position, _, _ in system.position_derivatives}
    angles = {n for n, unit in zip(system.feature_names, system.feature_units, strict=True) if unit == "rad"}
    return [name for name in variables.columns if name in named | angles]


def _moments(regression: Regression) -> tuple[list[tuple[int, int]], list[Array]]:
    """Bumps in time, a second and a quarter long, all over every stretch: rows of their ends, and their shapes."""
    spans, shapes_ = [], []
    for width_s in _BUMPS_S:
        n = max(4, round(width_s / regression.dt))
        shape = np.hanning(n + 2)[1:-1]
        for a, b in regression.series.edges:
            spans += [(s, s + n) for s in range(a, b - n, max(1, n // 2))]
            shapes_ += [shape for _ in range(a, b - n, max(1, n // 2))]
    return spans, shapes_


def _one_moment(
    regression: Regression, i: int, spans: Sequence[tuple[int, int]], moments: Sequence[Array]
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
    if len(z) < _FEWEST_MOMENTS:
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
        gain=largest**2,
        functions=1,
        run=int(regression.owners[spans[k][0]]),
        moment=t,
    )


def own_space(regression: Regression, channel: int) -> Array:
    """Orthonormal columns (N, r) of what the parameters can do to a channel's whitened residual."""
    return orthonormal(regression.slopes[channel])


def projected(regression: Regression, channel: int, functions: Array, own: Array) -> Array:
    """Functions per unit of time (M, q), whitened and free of `own_space` (N, q)."""
    z = whitened_functions(regression, channel, functions)
    return np.asarray(z - own @ (own.T @ z))


def whitened_functions(regression: Regression, channel: int, functions: Array) -> Array:
    """Functions per unit of time (M, q), whitened (N, q)."""
    return regression.whitened(regression.noises[channel], functions * regression.dt)
