"""A wrong clock, and scaled or biased rates: slope and intercept of positions over the integral of their rates.

    p(t + T) - p(t) = s * integral of v dt - b T

p and q move as far as v and omega say only if a logged second is one second (`nsde_torch.data.kinematics` measures s);
for a rate that reads b too much, the rest is -b T on average. Of a single position and its rate, s is a wrong clock or
a rate that reads 1/s times too much. Such a rate is mostly computed of the position, by a nominal step or a filter,
and s is its fault: the time column of a pendulum's video with smoothed rates was right, and its gravity 9 % off by a
clock that was rescaled.
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.kinematics import (
    ATTITUDE,
    FOLDS,
    INTERVAL_S,
    Slope,
    Uncertain,
    axis_groups,
    called,
    pairs_of,
    pool,
)
from nsde_torch.data.raw import Finding, RawRun, Report
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.recording.fault import Detected, Fault, LoggedRuns

POLICIES = ("rescale", "trust", "refuse")
MIN_DEPARTURE = 0.01  # departure of the clock from 1 below which it is right for all purposes
SIGNIFICANT = 3.0  # standard errors by which every group of axes must depart from 1, to the same side
SURE = 0.02  # largest standard error of a scale that rows are rescaled by without being asked
IMPLAUSIBLE = (0.5, 2.0)  # slopes outside cannot be a clock: the columns hold other units, signs or frames

# without the test `v_x` times 1.05 in one flight went unnoticed (tests/recording/test_checks.py)
_CHANCE = 0.001  # of a scale in one run that the others do not have, over all runs and axes

_CAUSES = (
    (57.29578, "degrees where radians are expected (the angle)", 0.15),
    (1 / 57.29578, "degrees where radians are expected (the rate)", 0.15),
    (-1.0, "the opposite sign or another frame (NED where ENU is expected)", 0.2),
    (1000.0, "mm or ms where m or s are expected", 0.15),
    (0.001, "mm or ms where m or s are expected", 0.15),
    (1e-6, "microseconds where seconds are expected", 0.15),
    (3.28084, "feet and metres mixed", 0.05),
    (0.3048, "feet and metres mixed", 0.05),
)


def check_units(slopes: Sequence[Slope], names: tuple[str, ...]) -> None:
    """Refuses pairs of columns that cannot be a position and its rate: a well-excited slope is far from 1."""
    low, high = IMPLAUSIBLE
    for slope in slopes:
        sure = slope.error < 0.1 * abs(slope.value) and slope.r2 > 0.5
        if sure and not low <= slope.value <= high:
            causes = [text for factor, text, away in _CAUSES if abs(slope.value / factor - 1.0) < away]
            causes.append("other units, signs or frames, or the velocity belongs to another position")
            raise DataError(
                f"run {slope.run!r}: {slope.axis!r} ({slope.group}) changes {slope.value:.4g} times as fast "
                f"as its rate says (standard error {slope.error:.2g}, {slope.intervals} intervals). Likely "
                f"cause: {causes[0]}. All columns are SI, ENU world, FLU body, radians: "
                f"{', '.join(names)}."
            )


def check_scales(system: SystemInfo, slopes: Sequence[Slope], report: Report) -> None:
    """Reports a position or a rate that is larger in one run than in the others, by how the two go together."""
    pairs = {g: dict(zip(*both, strict=True)) for g, both in pairs_of(system).items() if g != ATTITUDE}
    for one in slopes:
        others = [s for s in slopes if (s.group, s.axis) == (one.group, one.axis) and s.run != one.run]
        if not others:
            continue
        pooled = pool(others)
        apart = Uncertain(one.value - pooled.value, float(np.hypot(one.error, pooled.error)), FOLDS - 1)
        # of two runs nobody knows which is the odd one; of more, the others must be alike
        alike = max(abs(s.value - pooled.value) for s in others) < 0.5 * abs(apart.value)
        if abs(apart.value) < MIN_DEPARTURE or apart.p * len(slopes) > _CHANCE or not alike:
            continue
        rate = pairs.get(one.group, {}).get(one.axis, "the rate of " + one.axis)
        message = (
            f"{one.axis} changes {one.value:.4f} +- {one.error:.4f} times as fast as {rate} says, and "
            f"{pooled.value:.4f} times in the other runs: one of the two columns is off by {abs(apart.value):.1%} "
            f"{'there' if len(others) > 1 else 'in one of them'}"
        )
        values = {"here": one.value, "others": pooled.value, "standard_error": apart.error}
        report(Finding("odd_scale", one.run, 1, message, "reported", values))


def decide(
    slopes: Sequence[Slope], rate: str | None = None, *, policy: str, report: Report
) -> tuple[float, dict[str, float]]:
    """The clock scale of a data set, physical seconds for each logged second, and how many times too much a rate reads.

    A wrong clock shows in every group of axes (positions and attitude) on the same side. Where only one group
    disagrees, its velocity is at fault, not the clock; that is reported and nothing is scaled. Of a `single_rate` of
    the machine it is the rate that is scaled. The policy `rescale` returns what was measured, `trust` reports it alone,
    and `refuse` raises a DataError.
    """
    if not slopes:
        return 1.0, {}
    groups = {g: pool([s for s in slopes if s.group == g]) for g in sorted({s.group for s in slopes})}
    total = pool(slopes)
    axes = {g: list(dict.fromkeys(s.axis for s in slopes if s.group == g)) for g in groups}
    text = ", ".join(f"{called(g, axes[g])}: {p.value:.4f} +- {p.error:.4f}" for g, p in groups.items())
    values = {
        "scale": total.value,
        "standard_error": total.error,
        "spread": total.spread,
        "groups": {g: p.value for g, p in groups.items()},
    }
    off = {g: p for g, p in groups.items() if abs(p.value - 1) > max(MIN_DEPARTURE, SIGNIFICANT * p.error)}
    if not off:
        return 1.0, {}
    sides = {p.value > 1 for p in off.values()}
    # a log that stands still has a slope of nothing
    clock_like = IMPLAUSIBLE[0] <= total.value <= IMPLAUSIBLE[1]
    if len(off) < len(groups) or len(sides) > 1 or total.error > SURE or not clock_like:
        disagree = (
            f"position and velocity disagree in {', '.join(called(g, axes[g]) for g in off)} but not in every "
            f"group, or not surely enough to blame the clock ({text})"
        )
        ((g, p), *more) = off.items()
        if not more and len(groups) > 1 and IMPLAUSIBLE[0] <= p.value <= IMPLAUSIBLE[1]:
            one = called(g, axes[g])
            disagree += (
                f"; either rates of {one} read {abs(1 / p.value - 1):.1%} too {'much' if p.value < 1 else 'little'} "
                f"(multiply them by {p.value:.4f}), or {one} itself is off (multiply it by {1 / p.value:.4f})"
            )
        report(Finding("kinematic_mismatch", "", len(off), disagree, "reported", values))
        return 1.0, {}
    kind, column = ("clock", "time column") if rate is None else ("sensor_scale", f"column of {rate}")
    message = (
        f"the logged clock runs wrong: one logged second holds {total.value:.4f} +- {total.error:.4f} "
        f"physical seconds by the kinematics ({text})"
        if rate is None
        else f"{rate} reads {1 / total.value:.4g} times what its position moves ({text}); or the time column is off: "
        "a single position and its rate cannot tell"
    )
    if policy == "refuse":
        raise DataError(
            f"{message}. Set `clock` to `rescale` (use the measured scale) or `trust` (keep the log as it is), or "
            f"correct the {column}."
        )
    trusted = policy == "trust"
    report(Finding(kind, "", 1, message, "reported" if trusted else "rescaled", values))
    if trusted:
        return 1.0, {}
    return (total.value, {}) if rate is None else (1.0, {rate: 1.0 / total.value})


def single_rate(system: SystemInfo) -> str | None:
    """The rate of a machine that measures one position and its rate, and nothing else whose rate it measures."""
    groups = pairs_of(system)
    rates = [rate for group, (_, rates) in groups.items() for rate in rates]
    return rates[0] if len(rates) == 1 and ATTITUDE not in groups else None


def of_runs(slopes: Sequence[Slope], runs: Sequence[str], *, measured: float) -> float:
    """Physical seconds for each logged second by some runs alone: what a model may know that is tested on the others.

    It is `measured` where slopes were taken over several short runs together and none is of these runs alone.
    """
    own = [s for s in slopes if s.run in set(runs)]
    if measured == 1.0 or not own:
        return measured
    return decide(own, policy="rescale", report=lambda finding: None)[0]


def wrong_clock(fault: Fault, log: LoggedRuns) -> Detected | None:
    """Whether the scale that the reader decided on is surely a fault.

    The reader decides at three standard errors, however few intervals they are from.
    """
    clock, system = log.data.clock_scale, log.system
    off = _sure(fault, log) if clock != 1.0 else None
    if off is None:
        return None
    groups = pairs_of(system)
    positions = [p for group, (names, _) in groups.items() if group != ATTITUDE for p in names]
    what = "positions and attitude" if ATTITUDE in groups else " and ".join(positions)
    how = "further" if clock > 1.0 else "less far"
    return Detected(
        fault.name,
        {"scale": (clock, clock - off.half, clock + off.half, "1")},
        off.p,
        f"A second of the log lasts {clock:.4g} s: {what} move {how} than their rates say.",
        clock=clock,
    )


def scaled_rate(fault: Fault, log: LoggedRuns) -> Detected | None:
    """Whether the scale of a single rate that the reader took out is surely a fault."""
    rate = single_rate(log.system)
    done = [f for f in log.data.summary.findings if f.kind == fault.name and f.action == "rescaled"]
    off = _sure(fault, log) if done and rate is not None else None
    if off is None or rate is None:
        return None
    clock = 1.0 + off.value
    return Detected(
        fault.name,
        {rate: (1.0 / clock, 1.0 / (clock + off.half), 1.0 / (clock - off.half), "1")},
        off.p,
        f"{rate} reads {1.0 / clock:.4g} times what its position moves.",
        ties=("clock_scale",),
        experiment=(
            f"hold the time column against another clock over a few minutes; if a logged second lasts {clock:.4g} s, "
            "correct the times"
        ),
    )


def _sure(fault: Fault, log: LoggedRuns) -> Uncertain | None:
    """By how much slopes depart from 1, if surely."""
    pooled = pool(log.data.summary.slopes)
    degrees = max(pooled.slopes - 1, FOLDS - 1)  # errors of slopes are from so many folds each
    off = Uncertain(pooled.value - 1.0, max(pooled.error, 1e-12), degrees)
    return off if off.p < log.level(fault.stage) else None


_FEWEST = 12  # intervals
_LEAST_SHARE = 0.02  # of the rate's own rms: a bias below that is of no consequence


def _rate_biases(system: SystemInfo, runs: Sequence[Run], clock: float) -> dict[str, tuple[Uncertain, float]]:
    """Biases of the rates whose integral is logged too, by name of the state, and what would matter."""
    parts: dict[str, list[tuple[Array, Array]]] = {}
    for run in runs:
        step = run.dt * clock
        length = max(2, round(INTERVAL_S / step))
        for x in (run.x[a:b] for a, b in run.segments):
            count = (len(x) - 1) // length
            for group, change, integral, rates in axis_groups(system, x, step) if count else ():
                sums = (change - integral)[: count * length].T.reshape(-1, count, length).sum(2)
                for name, total, rate in zip(pairs_of(system)[group][1], sums, rates.T, strict=True):
                    parts.setdefault(name, []).append((total / (length * step), rate))
    out = {}
    for name, pieces in parts.items():
        means, rates = (np.concatenate(both) for both in zip(*pieces, strict=True))
        if len(means) < _FEWEST:
            continue
        size = float(np.sqrt(np.mean(np.square(rates))))
        # the error of a mean of telescoping sums is below that of independent ones: this one is safe
        error = max(float(means.std(ddof=1)) / len(means) ** 0.5, 1e-12)
        out[name] = Uncertain(-float(means.mean()), error, len(means) - 1), _LEAST_SHARE * size
    return out


def found_biases(fault: Fault, log: LoggedRuns) -> Detected | None:
    """Biases of rates that are sure, and large enough to matter."""
    biases, level = _rate_biases(log.system, log.runs, log.clock), log.level(fault.stage)
    sure = {k: b for k, (b, least) in biases.items() if b.p * len(biases) < level and abs(b.value) > least}
    if not sure:
        return None
    unit = dict(zip(log.system.state_names, log.system.state_units, strict=True))
    values = {name: (bias.value, bias.low, bias.high, unit[name]) for name, bias in sure.items()}
    words = ", ".join(f"{name} by {bias.value:+.3g} {unit[name]}" for name, bias in sure.items())
    text = f"Sensors read too much: {words}; the integral of these rates says so."
    return Detected(fault.name, values, min(bias.p for bias in sure.values()), text)


_READS: dict[str, tuple[np.ufunc, np.ufunc]] = {
    "sensor_bias": (np.add, np.subtract),
    "sensor_scale": (np.multiply, np.divide),
}
"""What a sensor with a fault does to a state, and what undoes it."""


def misread(
    x: Array, system: SystemInfo, fault: str, sizes: Mapping[str, Any], *, undo: bool = False
) -> Array:
    """States (n, nx) as sensors with a fault of these sizes log them, or as they were."""
    x, change = x.copy(), _READS[fault][undo]
    for name, size in sizes.items():
        at = _column(fault, name, size, system)
        x[:, at] = change(x[:, at], size)
    return x


def without(run: Run | RawRun, system: SystemInfo, fault: str, values: Mapping[str, Any]) -> Array:
    """States (n, nx) of a run as they were: of sizes in all runs, or in this one (`{RUN: {STATE: size}}`)."""
    own = values.get(run.name)
    x = misread(run.x, system, fault, own, undo=True) if isinstance(own, Mapping) else run.x
    of_all = {name: size for name, size in values.items() if not isinstance(size, Mapping)}
    return misread(x, system, fault, of_all, undo=True)


def _column(fault: str, name: str, value: Any, system: SystemInfo) -> int:
    """The column of a state that a fault has a number for; ConfigError where there is no such state, or no number."""
    names = list(system.state_names)
    if name not in names:
        raise ConfigError(f"`{fault}` names {name!r}, which is no state; states: {', '.join(names)}.")
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ConfigError(f"`{fault}.{name}` must be a finite number; got {value!r}.")
    if fault == "sensor_scale" and value == 0.0:
        raise ConfigError(f"`{fault}.{name}` must be a number other than 0; got {value!r}.")
    return names.index(name)
