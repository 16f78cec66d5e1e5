"""What is left in a channel: as a rate, against one variable, and in words where no effect accounts for it.

**Rates.** Means over a test function (`sysid.physics`), before and after, and the floor that sensors and gusts leave:
over a step the residual is r_k = w_k + e_{k+1} - e_k, what pushes (w) and what the sensor adds (e), and the spectrum

    S(f) = s_w^2 + 4 sin^2(pi f h) s_e^2

gives their sizes, by non-negative least squares over the upper three quarters of the band, each frequency weighed by
its own size.

**Bins.** A mean over a bin of a variable is that of all overlapping test functions whose variable lies in it; its
standard error is that of a ratio of sums over blocks of time,

    m = sum_b s_b / sum_b n_b,      var m = B / (B - 1) sum_b (s_b - m n_b)^2 / (sum_b n_b)^2

so that noise which lasts inside a block does no harm (Cochran, Sampling Techniques, 1977).

**In words**, how a residual depends on a variable: odd or even (from the test of structure), local, periodic, in one
run only; for what each is said, and by which numbers, see `Wording` and docs/content/theory/evidence.md. What is
periodic is at least half as large in the other thirds of the range as where it is strongest.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.signal import welch

from nsde_torch.arrays import Array, Labels
from nsde_torch.diagnosis.decisions import Wording
from nsde_torch.diagnosis.periodicity import best_repeat, waves_of
from nsde_torch.diagnosis.regressors import BEFORE, BY_RUN, OTHERS, OVER_TIME, Measured
from nsde_torch.diagnosis.residual_tests import Dependence, PhysicsResiduals
from nsde_torch.inference.force_scores import FunctionScores
from nsde_torch.sysid.physics import bump, per_second, smooth_rate
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System

_BINS, _FEWEST = 18, 4  # of a picture, and blocks of time in one
_BLOCK_S = 2.0  # for the errors of means in bins


@dataclass(frozen=True)
class Rates:
    """Mean residual rates over the test function, wherever it fits."""

    names: tuple[str, ...]
    units: tuple[str, ...]  # names, units: of the channels
    residual: Array  # residual rates (M, channels)
    values: Mapping[str, Array]  # by name of a variable: its mean over the same test function (M,)
    value_units: Mapping[str, str]  # unit of each variable
    run: Labels  # number of the run (M,)
    block: Labels  # block of time (M,)


@dataclass(frozen=True)
class Bins:
    """Means in bins of one variable."""

    centre: Array  # mean of the variable in each bin (B,)
    mean: Array  # mean of the residual (B,)
    error: Array  # standard error of it (B,)


def rates(regression: Regression, variables: Measured) -> Rates:
    """Mean residual rates of the dynamic channels, and everything that they may depend on."""
    columns, t = variables.columns, variables.t
    edges = regression.series.edges
    window = bump(regression.dt, regression.pace)
    names = [*columns, "time"]
    table = np.column_stack([*columns.values(), t, *regression.residual[:, regression.rows].T])
    # `smooth_rate` divides by the step, as is due to changes over steps
    table[:, : len(names)] *= regression.dt
    smooth = smooth_rate(table, edges, window, regression.dt)
    owners = regression.physics.steps.runs
    counts = [max(b - a - len(window) + 1, 0) for a, b in edges]
    run = np.repeat(np.array(owners, dtype=np.int64), counts)
    place = np.concatenate([np.arange(n) for n in counts]) if sum(counts) else np.zeros(0, dtype=np.int64)
    stretch = np.repeat(np.arange(len(counts)), counts)
    block_of = (place * regression.dt / (_BLOCK_S * regression.pace)).astype(np.int64)
    _, block = np.unique(np.stack((stretch, block_of)), axis=1, return_inverse=True)
    return Rates(
        names=tuple(regression.physics.names[c] for c in regression.rows),
        units=tuple(per_second(regression.physics.units[c]) for c in regression.rows),
        residual=smooth[:, len(names) :],
        values=dict(zip(names, smooth[:, : len(names)].T, strict=True)),
        value_units=variable_units(regression.vector.system),
        run=run,
        block=block.reshape(-1).astype(np.int64),
    )


def rates_width(regression: Regression) -> float:
    """Length of the test function of `rates` [s]."""
    return len(bump(regression.dt, regression.pace)) * regression.dt


def variable_units(system: System) -> dict[str, str]:
    """Unit of each variable that a residual may depend on, as far as it is known."""
    pairs = [
        *zip(system.input_names, system.input_units, strict=True),
        *zip(system.state_names, system.state_units, strict=True),
        *zip(system.feature_names, system.feature_units, strict=True),
    ]
    return {**dict(pairs), "time": "s"}


def is_plain(variable: str) -> bool:
    """Whether a variable can be an axis: no product, and not the number of a run."""
    return not variable.endswith((OTHERS, OVER_TIME, BY_RUN, BEFORE)) and variable != "run"


def bins(value: Array, residual: Array, block: Labels, *, count: int = _BINS) -> Bins:
    """Means in `count` bins of a variable, from 1 to 99 % of its values (M,); those of few blocks are left out."""
    if not len(value):
        return Bins(np.zeros(0), np.zeros(0), np.zeros(0))
    # half of the edges at equal numbers, half at equal distances, so that rare extremes are seen too
    inner = np.linspace(0.01, 0.99, count // 2 + 1)
    low, high = np.quantile(value, [0.01, 0.99])
    edges = np.unique(np.concatenate((np.quantile(value, inner), np.linspace(low, high, count // 2 + 1))))
    edges = edges[np.append(True, np.diff(edges) > 0.01 * (high - low))] if high > low else edges
    place = np.searchsorted(edges, value, side="right") - 1
    out = []
    for k in range(len(edges) - 1):
        inside = place == k
        _, owner = np.unique(block[inside], return_inverse=True)
        blocks = int(owner.max()) + 1 if owner.size else 0
        if blocks < _FEWEST:
            continue
        n, s = np.bincount(owner), np.bincount(owner, weights=residual[inside])
        mean = s.sum() / n.sum()
        error = np.sqrt(np.square(s - mean * n).sum() * blocks / (blocks - 1)) / n.sum()
        out.append((value[inside].mean(), mean, error))
    centre, mean, error = (
        np.array(column, dtype=np.float64) for column in (zip(*out, strict=True) if out else ((), (), ()))
    )
    return Bins(centre, mean, error)


# ---- channels ------------------------------------------------------------------------------------------

_FROM = 0.25  # of half the sampling rate
_PART = 256  # steps of a periodogram
_REWEIGHTED = 5  # fits of the two levels, each weighted by the one before


@dataclass(frozen=True)
class ChannelResidual:
    """Residual of one channel, rms of mean rates over the test function."""

    name: str  # of the channel
    unit: str  # of its rate
    measured: float  # standard deviation of the measured rate
    before: float
    after: float  # before, after: without and with the effects
    floor: float  # what white noise of sensors and disturbances may leave

    @property
    def explained(self) -> float:
        """Share of the residual above the floor, in variance, that the effects explain."""
        above = self.before**2 - self.floor**2
        return float(np.clip((self.before**2 - self.after**2) / above, 0.0, 1.0)) if above > 0 else 0.0

    @property
    def times_noise(self) -> float:
        """What is left, over what white noise leaves; infinite where that is nothing."""
        return self.after / self.floor if self.floor > 0 else (float("inf") if self.after > 0 else 0.0)

    def as_dict(self) -> dict[str, str | float]:
        """Plain containers, for JSON."""
        out = asdict(self) | {"explained": self.explained}
        del out["name"]
        return out


def channel_residuals(before: Regression, after: Regression) -> list[ChannelResidual]:
    """Residuals of every dynamic channel without and with effects."""
    steps = before.physics.steps
    window = bump(steps.dt, steps.pace)
    bend = np.square(np.diff(window, prepend=0.0, append=0.0)).sum()
    out = []
    for channel in before.rows:
        left = before.physics.residual(before.theta), after.physics.residual(after.theta)
        measured, first, second = (
            smooth_rate(values[:, [channel]], steps.segments, window, steps.dt)
            for values in (before.physics.measured, *left)
        )
        _, sensor, push = white_parts(after, int(channel))
        floor = float(np.sqrt(push * np.square(window).sum() + sensor * bend) / after.physics.steps.dt)
        name, unit = before.physics.names[channel], per_second(before.physics.units[channel])
        size = float(measured.std()) if len(measured) else 0.0
        sizes = size, _rms(first), _rms(second), min(floor, _rms(second))
        out.append(ChannelResidual(name, unit, *sizes))
    return out


def spectrum(regression: Regression, channel: int) -> tuple[Array, Array]:
    """Frequencies [Hz] (M,) and mean power per step (M,) of a channel's residual."""
    residual = regression.physics.residual(regression.theta)[:, channel]
    steps = regression.physics.steps
    longest = max(b - a for a, b in steps.segments)
    part = min(_PART, longest)
    total: Array = np.zeros(part // 2 + 1)
    weight = 0
    for a, b in steps.segments:
        if b - a >= part:
            _, power = welch(residual[a:b], nperseg=part, detrend=False, return_onesided=False)
            total += (b - a) * power[: part // 2 + 1]
            weight += b - a
    frequency: Array = np.arange(part // 2 + 1) / (part * steps.dt)
    return frequency, total / max(weight, 1)


def white_parts(regression: Regression, channel: int) -> tuple[float, float, float]:
    """Variances per step of the disturbance and of the sensor, and the largest that the first may be.

    By Whittle's likelihood, from the upper half of the band. Where the sensor's noise hides the disturbance there, the
    first is 0; the third is two standard errors above it. By the first alone, what dry friction and white gusts left of
    seven blind logs was "10 to 25 times white noise".
    """
    frequency, power = spectrum(regression, channel)
    steps = regression.physics.steps
    high = frequency >= _FROM * frequency[-1]
    parts = max(sum(b - a for a, b in steps.segments) / (2 * (len(frequency) - 1)), 1.0)
    columns = np.stack((np.ones(int(high.sum())), 4.0 * np.sin(np.pi * frequency[high] * steps.dt) ** 2), 1)
    level, found = np.maximum(power[high], 1e-300), np.zeros(2)
    for _ in range(_REWEIGHTED):  # by what is fitted: by the powers themselves it would be biased low
        found, _ = nnls(columns / level[:, None], power[high] / level)
        level = np.maximum(columns @ found, 1e-12 * max(float(power[high].max()), 1e-288))
    information = parts * (columns / level[:, None]).T @ (columns / level[:, None])
    error = np.sqrt(np.diag(np.linalg.pinv(information))[0])
    return float(found[0]), float(found[1]), float(found[0] + 2.0 * error)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean())) if values.size else 0.0


# ---- in words ------------------------------------------------------------------------------------------

_EXTENT_BINS, _FEWEST_BINS = 24, 6  # means that the extent of a dependence is seen in
_SWING = re.compile(r"(?:run_)?periodic_force(\[\w+\])?\.frequency")
_ENDS = {
    OVER_TIME: "otherwise early in a run than late: something drifts",
    BY_RUN: "otherwise in one run than in another: something differs between runs",
    BEFORE: "as it was a moment before: something has a memory",
}


@dataclass(frozen=True)
class Shape:
    """How the residual of a channel depends on a variable."""

    channel: str  # name of the channel
    variable: str  # name of the variable, `a * b` for a product
    symmetry: str  # `odd`, `even`, `mixed`, or empty where that means nothing (time, runs, products)
    extent: str  # `local` or `global`, empty where it cannot be an axis
    where: tuple[float, float] | None  # range of the variable that a local one lies in
    period: float | None  # period, in the unit of the variable, or None
    only_run: int | None  # number of the run that it is confined to, or None
    sentence: str  # all this in words
    note: str  # the same without the names


def symmetry(dependence: Dependence, wording: Wording) -> str:
    """`odd`, `even` or `mixed`; empty for what has no sides."""
    if not is_plain(dependence.variable) or dependence.variable == "time":
        return ""
    if dependence.odd > wording.odd_share:
        return "odd"
    return "even" if dependence.odd < wording.even_share else "mixed"


def called(run: str) -> str:
    """A run in words, by its name."""
    return run if run.lower().startswith(("run", "flight")) else f"run {run}"


def shape(left: PhysicsResiduals, dependence: Dependence, seen: Rates, runs: Sequence[str]) -> Shape:
    """Describe a dependence that is there beyond chance; `runs` are the names of the runs, by number."""
    channel, wording = seen.names.index(dependence.channel), left.decisions.wording
    fewest, regression = left.decisions.fewest_runs, left.regression
    run, at, frequency = dependence.run, dependence.moment, dependence.sinusoid
    variable, rate = dependence.variable, f"The rate of {dependence.channel}"
    if run is not None and at is not None:
        # other runs may have the same: not tested
        note = f"most of all at one moment, {called(runs[run])} at {at:.1f} s"
        said = f"{rate} departs {note}."
        return Shape(dependence.channel, variable, "", "local", (at, at), None, None, said, note)
    if frequency is not None:
        of_runs = _sinusoid_by_run(regression, channel, frequency)
        most = max(of_runs, key=lambda run: of_runs[run])
        alone = len(of_runs) >= fewest and of_runs[most] > wording.one_run_share * sum(of_runs.values())
        note = f"in a swing of {frequency:.4g} Hz" + (
            f", in {called(runs[most])} only" if alone else _of_phase(regression, channel, frequency, wording)
        )
        said, only = f"{rate} departs {note}.", most if alone else None
        return Shape(dependence.channel, variable, "", "", None, 1.0 / frequency, only, said, note)
    name, unit, side = variable, seen.value_units.get(variable, ""), symmetry(dependence, wording)
    extent, where, period = "", None, None
    if is_plain(name):
        there = np.full(len(seen.run), True) if run is None else seen.run == run
        value, residual = seen.values[name][there], seen.residual[there, channel]
        extent, where = _extent(value, residual, seen.block[there], wording)
        if side == "odd":  # what grows to both sides may have been seen far out on one of them only
            extent, where = "global" if extent else "", None
        period = period_of(left, dependence.port, name) if run is None else None
    else:
        name = dependence.pair or name
    for end, said in _ENDS.items():
        if name.endswith(end):
            other = _other_run(left, dependence) if end == BY_RUN else None
            note = said if other is None else f"otherwise in {called(runs[other])} than in the others"
            name = name.removesuffix(end)
            said = f"{rate} depends on {name} {note}."
            return Shape(dependence.channel, variable, "", "", None, None, None, said, note)
    only = run
    if variable not in left.columns or period is not None:  # no test of one run alone was made
        only = _only_run(left, dependence.port, variable)
    words = [f"{rate} depends on {name}"]
    if name == "run":
        what = "constants that differ from run to run" if only is None else "a constant"
        words = [f"{rate} is off by {what}"]
    if only is not None:
        words.append(f"in {called(runs[only])} only")
    if period is not None:
        words.append(f"periodically, every {period:.3g} {unit}".rstrip())
    elif extent == "local" and where is not None:
        words.append(f"locally, between {where[0]:.3g} and {where[1]:.3g} {unit}".rstrip())
    elif extent:
        words.append("over its whole range")
    if side and period is None:
        words.append(
            {"odd": "as an odd function", "even": "as an even function"}.get(side, "neither odd nor even")
        )
    said, note = ", ".join(words) + ".", ", ".join(words[1:])
    return Shape(dependence.channel, name, side, extent, where, period, only, said, note)


def _sinusoid_by_run(regression: Regression, channel: int, frequency: float) -> dict[int, float]:
    """What a sine and a cosine in each stretch explain of a residual (half its squares), by number of the run."""
    left, waves = regression.residual[:, regression.rows[channel]], waves_of(regression, frequency)
    out: dict[int, float] = {}
    for k, run in enumerate(regression.physics.steps.runs):
        out[int(run)] = out.get(int(run), 0.0) + nats(waves[:, 2 * k : 2 * k + 2], left)
    return out


def _of_phase(regression: Regression, channel: int, frequency: float, wording: Wording) -> str:
    """Whether an oscillation has the same phase in all stretches, by the log's clock; and what it is a harmonic of."""
    left, waves = regression.residual[:, regression.rows[channel]], waves_of(regression, frequency)
    turns, steps = 2.0 * np.pi * frequency, regression.physics.steps
    found = []
    for k, (a, b) in enumerate(regression.series.edges):
        sine, cosine = np.linalg.lstsq(waves[a:b, 2 * k : 2 * k + 2], left[a:b], rcond=1e-9)[0]
        start = float(steps.t[min(a * regression.box, len(steps) - 1)])
        found.append((b - a) * (cosine - 1j * sine) * np.exp(1j * turns * (a * regression.dt - start)))
    if len(found) > 1 and abs(sum(found)) < wording.same_phase * sum(abs(z) for z in found):
        return " whose phase differs from run to run"
    known = dict(zip(regression.vector.labels, regression.theta.tolist(), strict=True))
    swings = [f for name, f in known.items() if _SWING.fullmatch(name)]
    for times in (frequency / f for f in swings if f > 0):
        whole = round(times)
        if whole > 1 and abs(times - whole) < wording.whole_tolerance * times:
            return f", {whole} times the one that is known"
    return ""


def _extent(
    value: Array, residual: Array, block: Labels, wording: Wording
) -> tuple[str, tuple[float, float] | None]:
    b = bins(value, residual, block, count=_EXTENT_BINS)
    if len(b.mean) < _FEWEST_BINS:
        return "", None
    power = np.clip(np.square(b.mean) - np.square(b.error), 0.0, None)
    edges = np.concatenate(([b.centre[0]], 0.5 * (b.centre[1:] + b.centre[:-1]), [b.centre[-1]]))
    power = power * np.diff(edges)
    total, span = float(power.sum()), float(edges[-1] - edges[0])
    if total <= 0:
        return "global", None
    best = (span, 0, len(power))
    for i in range(len(power)):
        for j in range(i + 1, len(power) + 1):
            if power[i:j].sum() >= wording.local_power * total:
                best = min(best, (float(edges[j] - edges[i]), i, j))
                break
    width, i, j = best
    if width > wording.local_range * span:
        return "global", None
    return "local", (float(edges[i]), float(edges[j]))


def nats(z: Array, white: Array) -> float:
    """Log-likelihood that columns (N, q) bring to whitened residuals (N,) [nats]."""
    fit = z @ np.linalg.lstsq(z, white, rcond=1e-9)[0]
    return 0.5 * float(fit @ white)


def period_of(left: PhysicsResiduals, port: int, variable: str) -> float | None:
    """Period of a dependence on a plain variable, or None where a cubic does about as well."""
    v, wording = left.values(variable), left.decisions.wording
    best = best_repeat(left.forces, port, v)
    if best is None:
        return None
    low, high = np.quantile(v, [0.005, 0.995])
    s = np.clip((v - 0.5 * (low + high)) / (high - low), -1, 1)
    cubic = left.forces.of(np.stack((s, s**2, s**3), 1), port).nats
    # an angle is expected to repeat every turn or part of one: of two turns a cubic makes much too
    turns = variable_units(left.system).get(variable) == "rad"
    part = 2.0 * np.pi / best.period if turns else 0.5
    whole = round(part) > 0 and abs(part / round(part) - 1.0) < wording.whole_tolerance
    factor = wording.sine_angle_factor if whole else wording.sine_factor
    if not best.scores.nats > max(factor * cubic, wording.sine_nats):
        return None
    place = ((v - low) / (high - low) * wording.sine_parts).astype(np.int64)
    place = np.clip(place, 0, wording.sine_parts - 1)
    wave = 2.0 * np.pi * (v - low) / best.period
    waves = np.stack((np.sin(wave), np.cos(wave)), 1)
    parts = [left.forces.of(waves * (place == k)[:, None], port) for k in range(wording.sine_parts)]
    most = max(range(len(parts)), key=lambda k: parts[k].nats)
    rest = left.forces.of(waves * (place != most)[:, None], port)
    return best.period if _holds(_weights(parts[most]), rest, wording) else None


def _only_run(left: PhysicsResiduals, port: int, variable: str) -> int | None:
    """Number of the run that a dependence is confined to."""
    runs, wording = np.unique(left.owners), left.decisions.wording
    if len(runs) < left.decisions.fewest_runs:
        return None
    functions = left.functions[variable]()[0]
    scores = left.forces.of(np.ones((len(functions), 1)) if variable == "run" else functions, port)
    parts = [scores.of(left.owners == run) for run in runs]
    gains = [max(own.nats - 0.5 * scores.blocks.shape[1], 0.0) for own in parts]
    most = int(np.argmax(gains))
    if not gains[most] > wording.one_run_share * sum(gains) > 0:
        return None
    # what is only strongest in one run holds in the others too, as far as they can show
    others = scores.of(left.owners != runs[most])
    return None if _holds(_weights(parts[most]), others, wording) else int(runs[most])


def _other_run(left: PhysicsResiduals, dependence: Dependence) -> int | None:
    """Number of the run in which a variable acts otherwise than in all others, which are alike; None where none is."""
    runs = np.unique(left.owners)
    if len(runs) < left.decisions.fewest_runs:
        return None
    scores = left.forces.of(left.functions[dependence.variable]()[0], dependence.port)
    weights = _weights(scores)
    apart = np.abs(weights - np.median(weights))
    most = int(np.argmax(apart))
    # sizes of the others lie as close together as their errors, or closer than a third of that one's distance: 15 %
    # more mass in one flight of three was "otherwise in one run" (docs, fifth tester)
    errors = np.diag(scores.information).clip(1e-300) ** -0.5
    others = np.delete(apart, most) <= np.maximum(2.0 * np.delete(errors, most), apart[most] / 3.0)
    return int(runs[most]) if others.all() else None


def _weights(scores: FunctionScores) -> Array:
    """Sizes of functions that these scores ask for (q,)."""
    return np.asarray(np.linalg.lstsq(scores.information, scores.total, rcond=1e-6)[0])


def _holds(weights: Array, rest: FunctionScores, wording: Wording) -> bool:
    """Whether the rest may have a good part of the prediction of functions of these sizes, as far as its data show."""
    size = max(float(weights @ rest.information @ weights), 1e-300)
    return float(weights @ rest.total) / size + wording.holds_errors * size**-0.5 >= wording.holds_share
