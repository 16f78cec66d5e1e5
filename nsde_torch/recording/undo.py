"""Faults of the recording chain, which need no dynamics to show: they are looked for, and undone, before any physics.

clock_scale       p and q move as far as v and omega say only if a logged second is s seconds (`data.kinematics`)
input_smoothing   a moving average of width w leaves nulls at k / w in the spectrum of the inputs (`smoothing`)
sensor_delay,     a position is late against the integral of its rate, or the rate against it (`lateness`), by a time
sensor_lag        or by a filter of first order
                  (one whose position and rate are late alike shows in physics alone)
sensor_bias       p(t + T) - p(t) - integral of v dt = -b T on average, for a rate that reads b too much

Inputs that were averaged are restored by `smoothing.restored`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import stdtr, stdtrit

from nsde_torch.data import DataSet, Run
from nsde_torch.data.kinematics import pool
from nsde_torch.data.quaternion import increments
from nsde_torch.data.system_info import derivative_columns, rate_columns
from nsde_torch.recording.lateness import Late, by_kind, lateness, on_time, sensors, surely_late
from nsde_torch.recording.smoothing import restored, smoothing_width
from nsde_torch.systems import System

Array = NDArray[np.float64]

_INTERVAL_S = 0.5
_FEWEST = 12
_FOLDS = 10  # of the jackknife in data.kinematics
_LEVEL = 0.9
_LEAST_STEPS = 0.2  # a delay that is of consequence
_NATS, _SURELY = (
    3.0,
    20.0,
)  # by which a log is likelier with a fault undone; and where nothing else tells of it
_LATEST_S, _Z90 = 0.2, 1.645
_LEAST_SHARE = 0.02  # of the rate's own rms: a bias below that is of no consequence


@dataclass(frozen=True)
class Fault:
    """Something that the recording chain did.

    Args:
        name: `clock_scale`, `sensor_delay`, `sensor_lag`, `sensor_bias` or `input_smoothing`.
        values: By parameter: value, low, high (90 %; None where there is no interval), unit.
        p: Chance of it in a sound log; None where it is not a test of chance.
        sentence: What it means.
        short: Whether it is shorter than a step, and so undone but not called a finding.
        ties: Other faults that no data of the log tell from it.
        experiment: What would tell.
    """

    name: str
    values: Mapping[str, tuple[float, float | None, float | None, str]]
    p: float | None
    sentence: str
    short: bool = False
    ties: tuple[str, ...] = ()
    experiment: str = ""


@dataclass(frozen=True)
class Recorded:
    """Runs with the recording chain undone.

    Args:
        runs: The runs.
        clock: Physical seconds per logged second.
        faults: What was found.
    """

    runs: tuple[Run, ...]
    clock: float
    faults: tuple[Fault, ...]

    @property
    def inputs_restored(self) -> bool:
        """Whether the inputs were averaged in the log, and are restored."""
        return any(fault.name == "input_smoothing" for fault in self.faults)

    @property
    def biases(self) -> dict[str, float]:
        """What was taken out of rates, by name of the state, in its unit."""
        return self._values("sensor_bias")

    @property
    def delays(self) -> dict[str, float]:
        """By how much channels were late, by name of the state or of several [s of the log]."""
        return self._values("sensor_delay")

    @property
    def lags(self) -> dict[str, float]:
        """Time constants of filters that were undone, by name of the state or of several [s of the log]."""
        return self._values("sensor_lag")

    def like(self, run: Run, system: System) -> Run:
        """A further run of the same log with the same faults undone."""
        run = _without(on_time(run, system, self.delays, self.lags), system, self.biases)
        for width in (f.values["width"][0] for f in self.faults if f.name == "input_smoothing"):
            run = restored(run, system.nu, width)
        return run

    def _values(self, name: str) -> dict[str, float]:
        return {k: v[0] for f in self.faults if f.name == name for k, v in f.values.items()}


def undo(
    data: DataSet,
    runs: Sequence[Run],
    system: System,
    *,
    alpha: float,
    misfit: Callable[[Sequence[Run], float], float],
) -> Recorded:
    """Find the faults of a recording chain and undo them.

    Two of them can look like something else, and are undone only where the declared physics fits better for it: rows
    that were lost at a regular distance leave nulls in the spectrum of held inputs, as an average does; and what is
    half a step late may be how a simulator steps.

    Args:
        data: Where the runs are from; it knows the clock.
        runs: Those to look at.
        system: The machine.
        alpha: Chance of finding a fault in a sound log.
        misfit: Negative log likelihood per row [nats] of the declared physics in runs, at a clock.
    """
    faults: list[Fault] = []
    clock = data.clock_scale
    if clock != 1.0:
        fault = _clock(data, system)
        if fault.p is not None and fault.p < 0.5 * alpha:  # the other half is for biases
            faults.append(fault)
        else:
            clock = 1.0  # the reader decides at three standard errors, however few intervals they are from
    late = lateness(system, runs, clock=clock)
    surely = surely_late(late, runs[0].dt, chance=alpha)
    late = [d for d in late if d.p * len(late) < alpha and d.low > _LEAST_STEPS * runs[0].dt]
    runs = _on_time(runs, system, surely)
    faults += _delays(surely)
    biases = rate_biases(system, runs, clock)
    sure = {k: v for k, v in biases.items() if v.p * len(biases) < 0.5 * alpha and abs(v.value) > v.least}
    if sure:
        runs = [_without(run, system, {k: v.value for k, v in sure.items()}) for run in runs]
        faults.append(_bias(system, sure))
    width = smoothing_width(runs, system.nu) if system.nu else 0.0
    if width > 0:
        before = [restored(run, system.nu, width) for run in runs]
        if misfit(before, clock) < misfit(runs, clock):
            runs = before
            faults.append(_smoothing(width, runs[0].dt))
    for d in late:
        if d in surely:
            continue
        # moved the other way it would be as smooth
        there, back = (misfit(_on_time(runs, system, [e]), clock) for e in (d, d.early))
        if there < back - _NATS / sum(len(run) for run in runs):
            runs = _on_time(runs, system, [d])
            faults += _delays([d], short=True)
    return Recorded(tuple(runs), clock, tuple(faults))


def _on_time(runs: Sequence[Run], system: System, late: Sequence[Late]) -> list[Run]:
    times = {kind: {d.channel: d.seconds for d in some} for kind, some in by_kind(late).items()}
    delays, filters = times.get("sensor_delay", {}), times.get("sensor_lag")
    return [on_time(run, system, delays, filters) if late else run for run in runs]


def late_sensor(
    found: Recorded, system: System, misfits: Callable[[Sequence[Run]], Array], *, rows: int, other: float
) -> Recorded | None:
    """What the log is with one sensor moved, position and rate alike, against all else; None where that is no better.

    Kinematics do not show it, and effects that stand for it pay for one channel with another. So it is asked for where
    effects leave structure, has to do better than they, and no channel may pay for it: attitude and rates moved by the
    time that motors lag behind would otherwise stand for them.

    Args:
        found: The recording chain, undone as far as it is known.
        system: The machine.
        misfits: Negative log likelihood per row [nats] of the declared physics in runs, by channel.
        rows: Number of rows.
        other: The misfit of physics with effects, all channels together.
    """
    pairs, step = sensors(system), found.runs[0].dt
    if len(pairs) < 2:
        return None
    unmoved = misfits(found.runs)
    other = min(other, float(unmoved.sum()))

    def misfit(runs: Sequence[Run]) -> float:
        return float(misfits(runs).sum())

    best: tuple[float, float, tuple[str, str]] | None = None
    for pair in pairs:

        def of(steps: float, pair: tuple[str, str] = pair) -> float:
            return misfit([on_time(run, system, dict.fromkeys(pair, steps * step)) for run in found.runs])

        longest = min(_LATEST_S / step, 0.1 * min(b - a for run in found.runs for a, b in run.segments))
        at, here = 1.0, of(1.0)
        while 2.0 * at <= longest and (there := of(2.0 * at)) < here:
            at, here = 2.0 * at, there
        if here < other - _NATS / rows and (best is None or here < best[0]):
            nearer = minimize_scalar(
                of, bounds=(0.5 * at, 2.0 * at), method="bounded", options={"maxiter": 8}
            )
            best = min((here, at, pair), (float(nearer.fun), float(nearer.x), pair))
    if best is None or best[0] > other - _SURELY / rows:
        return None
    here, at, pair = best
    late = dict.fromkeys(pair, at * step)
    runs = tuple(on_time(run, system, late) for run in found.runs)
    if (misfits(runs) > unmoved + _NATS / rows).any():
        return None
    bend = (
        misfit([on_time(run, system, late | dict.fromkeys(pair, 1.5 * at * step)) for run in found.runs])
        - here
    )
    half = _Z90 * 0.5 * at * step / max(2.0 * rows * bend, 1e-12) ** 0.5
    values = {}
    for channel in pair:
        whole = at * step + found.delays.get(channel, 0.0)
        values[channel] = (whole, whole - half, whole + half, "s")
    told = (
        f"{' and '.join(pair)} are logged {1e3 * at * step:.3g} ms later than all else: the declared physics fits "
        "better so than with any effects."
    )
    return replace(found, runs=runs, faults=(*found.faults, Fault("sensor_delay", values, None, told)))


def _smoothing(width: float, dt: float) -> Fault:
    return Fault(
        "input_smoothing",
        {"width": (width, width - 0.5 * dt, width + 0.5 * dt, "s")},
        None,
        f"The log holds a moving average over {width:.3g} s of the inputs that acted.",
    )


def _clock(data: DataSet, system: System) -> Fault:
    pooled = pool(data.summary.slopes)
    degrees = max(pooled.slopes - 1, _FOLDS - 1)  # errors of slopes are from so many folds each
    half = float(stdtrit(degrees, 0.5 * (1 + _LEVEL))) * pooled.error
    clock = data.clock_scale
    p = 2.0 * float(stdtr(degrees, -abs(pooled.value - 1.0) / max(pooled.error, 1e-12)))
    pairs = [
        (system.state_names[a], system.state_names[b])
        for i, j in derivative_columns(system).values()
        for a, b in zip(i, j, strict=True)
    ]
    turns = rate_columns(system) is not None
    single = len(pairs) == 1 and not turns
    what = "positions and attitude" if turns else " and ".join(position for position, _ in pairs)
    moves, says = ("moves", "its rate says") if single else ("move", "their rates say")
    rate, how = pairs[0][1], "further" if clock > 1.0 else "less far"
    return Fault(
        "clock_scale",
        {"scale": (clock, clock - half, clock + half, "1")},
        p,
        f"A second of the log lasts {clock:.4g} s: {what} {moves} {how} than {says}.",
        ties=("sensor_scale",) if single else (),
        experiment="hold the time column against another clock over a few minutes; if it is right, "
        f"{rate} is logged {1 / clock:.4g} times too large: multiply it by {clock:.4g}"
        if single
        else "",
    )


def _delays(late: Sequence[Late], *, short: bool = False) -> list[Fault]:
    """Channels that are late as faults: delays, and filters."""
    out = []
    for name, some in by_kind(late).items():
        how = "later than" if name == "sensor_delay" else "late behind a filter, against"
        words = ", ".join(f"{d.channel} is logged {1e3 * d.seconds:.3g} ms {how} {d.other}" for d in some)
        values = {d.channel: (d.seconds, d.low, d.high, "s") for d in some}
        told = f"Channels do not belong to the same time: {words}, as the one is the integral of the other."
        out.append(Fault(name, values, min(d.p for d in some), told, short))
    return out


@dataclass(frozen=True)
class Bias:
    """What a rate reads too much, with its standard error, degrees of freedom and chance; and what would matter."""

    value: float
    error: float
    degrees: int
    p: float
    least: float


def rate_biases(system: System, runs: Sequence[Run], clock: float) -> dict[str, Bias]:
    """Biases of the rates whose integral is logged too, by name of the state."""
    parts: dict[str, list[tuple[Array, Array]]] = {}
    for run in runs:
        for a, b in run.segments:
            x = run.x[a:b]
            for name, change, rate in _pairs(system, x):
                step = run.dt * clock
                gap = change - 0.5 * step * (rate[1:] + rate[:-1])
                length = max(2, round(_INTERVAL_S / step))
                count = len(gap) // length
                if count:
                    means = gap[: count * length].reshape(count, length).sum(1) / (length * step)
                    parts.setdefault(name, []).append((means, rate))
    out = {}
    for name, pieces in parts.items():
        means = np.concatenate([m for m, _ in pieces])
        if len(means) < _FEWEST:
            continue
        size = float(np.sqrt(np.mean(np.concatenate([np.square(r) for _, r in pieces]))))
        # the error of a mean of telescoping sums is below that of independent ones: this one is safe
        error = max(float(means.std(ddof=1)) / len(means) ** 0.5, 1e-12)
        value = -float(means.mean())
        p = 2.0 * float(stdtr(len(means) - 1, -abs(value) / error))
        out[name] = Bias(value, error, len(means) - 1, p, _LEAST_SHARE * size)
    return out


def _pairs(system: System, x: Array) -> list[tuple[str, Array, Array]]:
    """Rates, and what their integrals changed by over each step."""
    out = []
    for i, j in derivative_columns(system).values():
        out += [(system.state_names[b], np.diff(x[:, a]), x[:, b]) for a, b in zip(i, j, strict=True)]
    rates = rate_columns(system)
    if rates is not None and system.quaternion is not None:
        turns = increments(x[:, system.quaternion])
        out += [(system.state_names[c], turns[:, k], x[:, c]) for k, c in enumerate(range(system.nx)[rates])]
    return out


def _without(run: Run, system: System, biases: dict[str, float]) -> Run:
    x = run.x.copy()
    for name, value in biases.items():
        x[:, system.state_names.index(name)] -= value
    return replace(run, x=x)


def _bias(system: System, found: dict[str, Bias]) -> Fault:
    unit = dict(zip(system.state_names, system.state_units, strict=True))
    values: dict[str, tuple[float, float | None, float | None, str]] = {}
    for name, bias in found.items():
        half = float(stdtrit(bias.degrees, 0.5 * (1 + _LEVEL))) * bias.error
        values[name] = (bias.value, bias.value - half, bias.value + half, unit[name])
    words = ", ".join(f"{name} by {bias.value:+.3g} {unit[name]}" for name, bias in found.items())
    return Fault(
        "sensor_bias",
        values,
        min(bias.p for bias in found.values()),
        f"Sensors read too much: {words}; the integral of these rates says so.",
    )
