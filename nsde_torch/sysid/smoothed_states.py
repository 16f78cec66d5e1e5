"""States that were smoothed before they were logged, by what, and as they were before.

A motion alone ends in the white noise of the sensor, not in the log's digits. A log was smoothed where it ends in no
such noise, and where kinematics, zeros of its spectrum or else the declared physics say so, as
docs/content/theory/recording.md has it. Physics is not asked where kinematics or zeros show it: in a closed loop inputs
answer the noise of sensors. Of sensors in which nothing was found by their noise, it is asked what they show of the
inputs (`response_ends`).

An estimator integrates body rates to an attitude. Its error is an integral too, which falls with the frequency as
behind a filter of first order; restored, it would put an attitude that was on time 13 ms before its rates (logs of a
real PX4 at 250 Hz). With

    d(S) = - d arg S / d(2 pi f) at f = 0

the lateness of positions against rates must be d(S_positions) - d(S_rates). Where it is not, and is without one of the
two, that one is no smoother. **Restored** states are

    x = S^-1 x_log below f_r,        white noise above,

and noise much larger than what moves at f_r: what moves above is absent, and must not weigh. Noise is of a fixed seed;
ends of stretches, where nobody knows how the smoother began, are left out.

A longer step hides what the log shows: a rate that is 3 ms late, a filter at 100 Hz. So streams, sensors and smoothers
are looked for in the rows as they were logged, and states restored on the longer step (`undone_at_own_rate`).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.fft import irfft, rfft, rfftfreq
from scipy.ndimage import gaussian_filter1d

from nsde_torch.arrays import Array
from nsde_torch.data import DataSet, Finding, Run, SystemInfo
from nsde_torch.data.kinematics import ATTITUDE, axis_groups
from nsde_torch.data.quaternion import conjugate, multiply, rotation_vector
from nsde_torch.data.system_info import channel_columns, derivative_columns, rate_columns
from nsde_torch.recording import smoothers
from nsde_torch.recording.faults import remedies
from nsde_torch.recording.latency import Latency, late_channels, latencies, on_one_clock, surely_late
from nsde_torch.recording.noise import grains
from nsde_torch.recording.smoothers import Likely, Smoother, Spectra, SpectrumFit
from nsde_torch.recording.times import is_longer, on_longer_step
from nsde_torch.recording.unmeasured_rates import measured_part
from nsde_torch.rotation import turned
from nsde_torch.sysid import signals
from nsde_torch.sysid.measured_inputs import as_they_act, held_over_rows, without_noise_about_levels
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.response_ends import NATS, ends_of_response
from nsde_torch.sysid.rough import rough_fit
from nsde_torch.systems import System
from nsde_torch.texts import rendered

MISFIT, GAIN = 2.0, 3.0
"""Deviance per bin of a spectrum without a smoother, above which one is looked for; and how many times smaller it must
be behind one. Raw logs have 0.3 to 1.1; logs behind a smoother that cuts at up to a fifth of the rate 4.5 and more."""
DIGITS = 10.0  # how many times the noise of a log's digits may be measured: what is more is a sensor's
SOUND = 0.4
"""Share by which spectra may differ from the best fit (root mean square, beyond chance) and states be restored."""
_CHANCE = 0.5  # deviance per bin by chance
_DROWNED = 0.1  # of the windows: times that a partner is larger, to which what both hold shows (error 0.3)
_NO_MORE = 2.0  # times what rounding makes, up to which nothing else is seen
ALIKE = 0.3  # deviance that a sensor may lose by being fitted together with others
APART = 0.5
"""Share of the changes in which position and integrated rate differ, above which they are noise (independent: 1)."""
LAGS_S, LATEST_S = (0.0, 0.02, 0.05, 0.1), 0.05
"""Lags of actuators that the declared physics may lack, and the longest delay [s], by halves of a step."""
DEPTH, BEGINS = 1e-2, 0.9  # |S| down to which is restored; and at which noise is added instead
_NEAR, _FAR = 0.5, 1.0
"""Steps of the log by which a lateness may miss what smoothers make, and by which it must to speak against one."""
_ROUNDED = 0.1  # share of rounding in what is left, up to which it is restored
_OVER_DIGITS = 100.0  # power of an input over that of its digits, from which on it moves
_LEAKS = 1e-13  # and over its largest, which windows let through elsewhere
_HALF = 0.22  # of a mean's width, as a share of the step at which |S| is 0.7
_REFERENCE_S = 0.5  # standard deviation of the smooth attitude that rotations are measured from


@dataclass(frozen=True)
class SensorGroup:
    """States of one sensor: columns, or the attitude, whose small rotations about a smooth one are looked at."""

    columns: tuple[int, ...]
    names: tuple[str, ...]
    group: str = ""
    """Name in `data.kinematics.axis_groups` of the position and rate that they belong to; empty where none."""
    turns: bool = False  # whether they are a quaternion
    rates: bool = False  # whether they are rates of other states

    def values(self, x: Array, dt: float) -> Array:
        """What is filtered, of one stretch (n, C)."""
        own = x[:, list(self.columns)]
        return rotation_vector(multiply(conjugate(_smooth(own, dt)), own)) if self.turns else own

    def with_values(self, x: Array, values: Array, dt: float) -> None:
        """Put other values into one stretch."""
        if not self.turns:
            x[:, list(self.columns)] = values
            return
        reference = torch.from_numpy(_smooth(x[:, list(self.columns)], dt))
        x[:, list(self.columns)] = turned(reference, torch.from_numpy(values)).numpy()


@dataclass(frozen=True)
class SmoothedSensor:
    """A sensor behind a smoother."""

    sensor: SensorGroup
    reach: float  # frequency up to which it is restored, or from which on noise is added [Hz]
    restored: bool
    fit: SpectrumFit  # behind the smoother
    seen: Spectra

    @property
    def bin(self) -> int:
        """Number of the frequency of the spectra that is nearest to `reach`."""
        return int(np.argmin(np.abs(self.seen.f - self.reach)))

    @property
    def louder_above(self) -> bool:
        """Whether the noise that stands above the band is surely louder than the sensor's own below."""
        at = self.bin
        return not self.restored or bool((ABOVE * self.fit.motion[:, at] > self.fit.noise[:, at]).any())


@dataclass(frozen=True)
class Smoothed:
    """Sensors behind one smoother."""

    smoother: Smoother
    behind: tuple[SmoothedSensor, ...]
    others: tuple[Smoother, ...] = ()  # behind which these spectra are nearly as likely
    by_response: bool = False  # whether it was found by what the inputs do, and not by what is left of noise

    def finding(self) -> Finding:
        """What the data summary says."""
        names = [name for one in self.behind for name in one.sensor.names]
        whole, low = all(one.restored for one in self.behind), min(one.reach for one in self.behind)
        through = f"{self.smoother} (|S| = 0.7 at {self.smoother.falls_to(0.7):.3g} Hz)"
        told = {"whole": whole, "low": low, "through": through, "by_response": self.by_response}
        return Finding(
            "state_smoothing",
            "",
            len(names),
            rendered(__file__, "recording.txt", what="smoothed", names=names, **told),
            "restored" if whole else "noise added",
            {
                "states": names,
                "smoother": self.smoother.family.name,
                "order": self.smoother.order,
                "half_power_hz": self.smoother.falls_to(0.5**0.5),
                "band_hz": low,
            },
        )


def smoothed_states(runs: Sequence[Run], system: System, clock: float = 1.0) -> list[Smoothed]:
    """Sensors whose states were smoothed before they were logged, by smoother."""
    dt = runs[0].dt * clock
    driven = _driven_up_to(runs, system.nu, dt)
    seen = {sensor: s.above(driven) for sensor, s in _spectra(runs, system, dt).items()}
    without = {sensor: smoothers.fit(s, None).deviance for sensor, s in seen.items()}
    odd = {sensor: s for sensor, s in seen.items() if without[sensor] > MISFIT}
    if driven:
        odd = dict(zip(odd, smoothers.without_motion([*odd.values()]), strict=True))
    out = []
    regression: Regression | None = None
    for sensors, likely in _by_smoother(odd) if odd else ():
        smoother = likely.smoother
        fits = {sensor: smoothers.fit(odd[sensor], smoother) for sensor in sensors}
        if any(
            GAIN * one.deviance >= without[k]
            or _noisy_behind(odd[k], one, k, runs)
            or _rounding(odd[k], smoother, k, runs)
            for k, one in fits.items()
        ):
            continue
        known = max(_apart(system, runs, sensor, smoother, dt) for sensor in sensors) > APART
        if not (known or _by_its_zeros(likely, runs, system, dt)):
            regression = regression or rough_fit(system, runs, clock, levels=False)
            if regression is None or _nats(regression, sensors, smoother) < NATS:
                continue
        begins, behind = smoother.falls_to(BEGINS), []
        for k, one in fits.items():
            sound = _off(one, odd[k]) < SOUND
            reach = max(_reach(odd[k], one, smoother) if sound else 0.0, begins)
            behind.append(SmoothedSensor(k, reach, sound, one, odd[k]))
        out.append(Smoothed(smoother, tuple(behind), likely.others))
    return on_time(out, runs, system, clock)


def smoothed_by_response(
    runs: Sequence[Run], system: System, known: Sequence[Smoothed], clock: float = 1.0
) -> list[Smoothed]:
    """Sensors beside those known that do not show what the inputs do above some frequency.

    With partners that know of no more.
    """
    others = {k.sensor for one in known for k in one.behind}
    seen = {k: s for k, s in _spectra(runs, system, runs[0].dt * clock).items() if k not in others}
    out: list[Smoothed] = []
    ends = ends_of_response(runs, system, [sensor.columns for sensor in seen], clock)
    for sensor, smoother in zip(seen, ends, strict=True):
        if smoother is None:
            continue
        partners = [
            k
            for k in seen
            if k.group == sensor.group != "" and k.rates != sensor.rates
            if not _apart(system, runs, k, smoother, runs[0].dt * clock) > APART
        ]
        behind = [
            SmoothedSensor(k, smoother.falls_to(BEGINS), False, smoothers.fit(seen[k], smoother), seen[k])
            for k in (*partners, sensor)
        ]
        out.append(Smoothed(smoother, tuple(behind), by_response=True))
    return out


def on_time(found: Sequence[Smoothed], runs: Sequence[Run], system: System, clock: float) -> list[Smoothed]:
    """Smoothers without those that kinematics contradicts."""
    out = list(found)
    if not any(one.smoother.delay for one in found):
        return out
    for lag in latencies(system, runs, clock=clock):
        wrong = _contradicted(lag, out, system, runs[0].dt * clock, clock)
        kept = [replace(o, behind=tuple(k for k in o.behind if {*k.sensor.columns} != wrong)) for o in out]
        out = [one for one in kept if one.behind]
    return out


def sensors_of(system: System) -> list[SensorGroup]:
    """The sensors of a system: positions, velocities, body rates, states of no pair one by one, and the attitude."""

    def sensor(columns: Sequence[int], group: str = "", **which: bool) -> SensorGroup:
        return SensorGroup(tuple(columns), tuple(system.state_names[c] for c in columns), group, **which)

    groups = derivative_columns(system)
    out = [sensor(part, name, rates=k == 1) for name, pair in groups.items() for k, part in enumerate(pair)]
    if (rates := rate_columns(system)) is not None:
        out.append(sensor(range(system.nx)[rates], ATTITUDE, rates=True))
    attitude = range(system.nx)[system.quaternion or slice(0)]
    known = {column for one in out for column in one.columns} | set(attitude)
    out += [sensor([column]) for column in range(system.nx) if column not in known]
    return [*out, sensor(attitude, ATTITUDE, turns=True)] if attitude else out


def _smooth(q: Array, dt: float) -> Array:
    smooth = gaussian_filter1d(q, _REFERENCE_S / dt, axis=0, mode="nearest")
    return np.asarray(smooth / np.linalg.norm(smooth, axis=1, keepdims=True))


def _spectra(runs: Sequence[Run], system: System, dt: float) -> dict[SensorGroup, Spectra]:
    """Spectra of all sensors that were measured and move."""
    guessed = {name for run in runs for name in run.inferred}
    measured = [sensor for sensor in sensors_of(system) if not guessed & set(sensor.names)]
    return {sensor: s for sensor in measured if (s := group_spectra(sensor, runs, dt)) is not None}


def _driven_up_to(runs: Sequence[Run], nu: int, dt: float) -> float:
    """Frequency above which inputs hold nothing but their digits [Hz]; 0 where that is less than half of all.

    A motion under inputs of a few waves ends where these do, at once, which no power of the frequency does: behind a
    filter forwards and backwards at 12 Hz, a causal one at 6 Hz fitted a disk better
    (tests/sysid/test_smoothed_states.py::test_a_motion_under_a_few_waves_does_not_hide_the_filter).
    """
    inputs = [np.asarray(run.u[a:b, :nu]) for run in runs for a, b in run.segments]
    seen = smoothers.spectra_of(inputs, dt) if nu else None
    if seen is None:
        return 0.0
    every = np.concatenate(inputs)
    digits = np.array(
        [np.square(grains(column)).min() / 6.0 * dt if np.ptp(column) else np.inf for column in every.T]
    )
    least = np.maximum(_OVER_DIGITS * digits, _LEAKS * seen.power.max(1))
    driven = np.flatnonzero((seen.power > least[:, None]).any(0))
    end = int(driven[-1]) + 1 if len(driven) else 0
    return float(seen.f[end]) if 0 < end < len(seen.f) // 2 else 0.0


def group_spectra(sensor: SensorGroup, runs: Sequence[Run], dt: float) -> Spectra | None:
    """Spectra of the filtered columns of a sensor; None where stretches are short or a channel never moves."""
    parts = [sensor.values(np.asarray(run.x[a:b]), dt) for run in runs for a, b in run.segments]
    if not np.any([(part != part[0]).any(0) for part in parts], axis=0).all():
        return None
    found = smoothers.spectra_of(parts, dt)
    return found if found is not None and (found.power > 0).all() else None


def _by_smoother(odd: Mapping[SensorGroup, Spectra]) -> list[tuple[tuple[SensorGroup, ...], Likely]]:
    """Sensors that went through one smoother, and those that each went through one of their own.

    Who smooths a position smooths its rate: a family that is only near the true filter fits each a little better by a
    member of its own, so that the two keep one smoother where it fits both.
    """
    own = {sensor: smoothers.likeliest(s, rates=sensor.rates) for sensor, s in odd.items()}
    out: list[tuple[tuple[SensorGroup, ...], Likely]] = []
    left = dict(odd)
    pairs = [tuple(k for k in odd if k.group == name) for name in {k.group: None for k in odd if k.group}]
    for some in dict.fromkeys((tuple(odd), *pairs)):  # two sensors may be all and a pair
        if len(some) < 2 or not set(some) <= left.keys() or len({len(odd[k].f) for k in some}) > 1:
            continue
        together = replace(odd[some[0]], power=np.concatenate([odd[k].power for k in some]))
        tried = [own[k] for k in some if not own[k].smoother.family.differentiates]
        tried.append(smoothers.likeliest(together, rates=all(sensor.rates for sensor in some)))
        common = _best_of(tried, together)
        own |= {k: _best_of([own[k], *tried], odd[k]) for k in some}
        fits = {k: smoothers.fit(odd[k], common.smoother) for k in some}
        near = {k for k, one in fits.items() if one.deviance - own[k].deviance < ALIKE}
        kept = {k.group for k in near} - {""} if len(some) == len(odd) else {k.group for k in some}
        alike = [k for k in some if k in near or (k.group in kept and _off(fits[k], odd[k]) < SOUND)]
        if len(alike) > 1:
            out.append((tuple(alike), common))
            left = {k: s for k, s in left.items() if k not in alike}
    return [*out, *(((k,), own[k]) for k in left)]


def _best_of(tried: Sequence[Likely], seen: Spectra) -> Likely:
    """The likeliest behind one of several smoothers: what is found of one sensor may be missed of another."""
    fitted = [replace(one, deviance=smoothers.fit(seen, one.smoother).deviance) for one in tried]
    return min(fitted, key=lambda one: one.deviance)


def _off(one: SpectrumFit, seen: Spectra) -> float:
    """Share by which a spectrum differs from its fit, beyond chance: a share s has a deviance of K s^2 / 2."""
    return (2.0 * max(one.deviance - _CHANCE, 0.0) / seen.windows) ** 0.5


def _by_its_zeros(likely: Likely, runs: Sequence[Run], system: System, dt: float) -> bool:
    """Whether a spectrum vanishes between others that do not, as behind a mean, and those of the inputs do not.

    No motion does so, unless its inputs are held over several rows, and no white sensor. Of a motor's speed alone, a
    mean of ten rows, inputs say nothing at 10 Hz, where it first vanishes: it was a delay and a lag, both surely.
    """
    if not all(one.vanishes_between for one in (likely.smoother, *likely.others)):
        return False
    inputs = [np.asarray(run.u[a:b, : system.nu]) for run in runs for a, b in run.segments]
    moved = np.any([(part != part[0]).any(0) for part in inputs], axis=0)
    # one by one: beside the speed of a vehicle, which varies slowly, a steering that is held over 35 rows was no reason
    each = [smoothers.spectra_of([part[:, [j]] for part in inputs], dt) for j in np.flatnonzero(moved)]
    seen = [one for one in each if one is not None and (one.power > 0).all()]
    if not each or len(seen) < len(each):
        return False
    return all(
        GAIN * smoothers.fit(one, likely.smoother).deviance > smoothers.fit(one, None).deviance
        for one in seen
    )


def _noisy_behind(seen: Spectra, one: SpectrumFit, sensor: SensorGroup, runs: Sequence[Run]) -> bool:
    """Whether white noise behind a smoother is more than the sensor's before it, and than the log's digits make.

    A motion that ends at some frequency (inputs of a few waves) falls as if smoothed, down to the sensor's noise.
    """
    by_digits = 2.0 * seen.dt * _rounded(sensor, runs, least=True)
    louder = one.rounding > np.maximum(np.median(one.noise, axis=1), DIGITS * by_digits.max())
    return bool(louder.any())


def _rounding(seen: Spectra, smoother: Smoother, sensor: SensorGroup, runs: Sequence[Run]) -> bool:
    """Whether all that is seen where a smoother falls is no more than rounding makes of the raw motion.

    The rounding of a slow motion, as that of an encoder, is no white noise: it is a saw of the grain, whose spectrum
    falls too. Of whatever colour, its mean square is a twelfth of that of the grain.
    """
    beyond = seen.f > smoother.falls_to(BEGINS)
    squares = seen.power[:, beyond].sum(1) * float(seen.f[1] - seen.f[0])
    return bool((squares < _NO_MORE * _rounded(sensor, runs)).any())


def _rounded(sensor: SensorGroup, runs: Sequence[Run], *, least: bool = False) -> Array:
    """Mean squares (C,) of the rounding errors of a sensor's columns; a rotation is twice a quaternion's part.

    `least` takes the values that come in the least steps, where they were written with significant digits.
    """
    x = np.concatenate([np.asarray(run.x[:, list(sensor.columns)]) for run in runs])
    steps = [grains(column) for column in x.T]
    squares = np.array([np.square(s).min() if least else np.square(s).mean() for s in steps]) / 12.0
    return np.full(3, 4.0 * float(squares.max())) if sensor.turns else squares


def _apart(system: System, runs: Sequence[Run], sensor: SensorGroup, smoother: Smoother, dt: float) -> float:
    """Share of a sensor that its partner in the kinematics does not know of, where a smoother falls; 0 without one.

    Of changes of positions and integrals of rates. Where the noise of the partner drowns it, the partner cannot say.
    Where no more is seen than rounding makes, it is no sensor's noise.
    """
    parts = [
        (change, integral)
        for run in runs
        for a, b in run.segments
        for group, change, integral, _ in axis_groups(system, np.asarray(run.x[a:b]), dt)
        if group == sensor.group
    ]
    if not parts:
        return 0.0
    apart, places, integrals = (
        smoothers.spectra_of(some, dt)
        for some in ([c - i for c, i in parts], [c for c, _ in parts], [i for _, i in parts])
    )
    if apart is None or places is None or integrals is None:
        return 0.0
    level = np.abs(smoother.response(apart.f))
    band = (level < 0.7) & (level > 0.03)
    if band.sum() < 3:
        return 0.0
    pair = (integrals, places) if sensor.rates else (places, integrals)
    own, other = (seen.power[:, band] for seen in pair)
    both = 0.5 * (own + other - apart.power[:, band])
    turn = 2.0 * np.pi * apart.f[band] * dt
    through = dt**2 * np.cos(0.5 * turn) ** 2 if sensor.rates else 2.0 * (1.0 - np.cos(turn))
    rounded = 2.0 * dt * _rounded(sensor, runs)[:, None] * through
    heard = (other < _DROWNED * apart.windows * own) & (own > _NO_MORE * rounded)
    share = 1.0 - both / np.maximum(own, 1e-300)
    return float(np.median(share[heard])) if heard.sum() >= 3 else 0.0


def _nats(regression: Regression, sensors: Sequence[SensorGroup], smoother: Smoother) -> float:
    """By how much changes are likelier from the physics behind a smoother than from it alone, where inputs drive.

    A lag of actuators that is not declared removes the fast part of the inputs' effect as a smoother does. So both are
    judged behind the lag and the delay that suit each best.
    """
    physics = regression.physics
    steps, left = physics.steps, physics.residual(regression.theta)
    driven = {channel for way in signals.directions(regression) for channel in way.channels}
    channels = [
        [
            (physics.measured[a:b, c], smoothers.Stretch(physics.measured[a:b, c] - left[a:b, c], steps.dt))
            for a, b in steps.segments
        ]
        for c in sorted(driven & {c for sensor in sensors for c in sensor.columns})
    ]

    def likelihood(behind: Smoother | None, lag: float, delay: float) -> float:
        total = 0.0
        for parts in channels:
            rest = [(own - predicted.through(behind, lag, delay))[:, None] for own, predicted in parts]
            seen = smoothers.spectra_of(rest, steps.dt)
            if seen is None:
                continue
            level = np.abs(smoother.response(seen.f))
            band = (level < BEGINS) & (level > 0.01)
            total -= seen.windows * float(np.log(seen.power)[:, band].sum())
        return total

    delays = 0.5 * steps.dt * np.arange(int(2.0 * LATEST_S * steps.pace / steps.dt) + 1)
    late = [(steps.pace * lag, delay) for lag in LAGS_S for delay in delays.tolist()]
    with_it, without = (max(likelihood(behind, *one) for one in late) for behind in (smoother, None))
    return with_it - without


def _reach(seen: Spectra, one: SpectrumFit, smoother: Smoother) -> float:
    """Frequency up to which is restored [Hz]."""
    left = (one.motion + one.noise) * np.square(np.abs(smoother.response(seen.f)))
    rounded = (one.rounding[:, None] > _ROUNDED * left).any(0) & (seen.f > smoother.falls_to(BEGINS))
    deep = min(smoother.falls_to(DEPTH), 0.48 / seen.dt)
    return min(deep, float(seen.f[np.argmax(rounded)])) if rounded.any() else deep


def _contradicted(
    lag: Latency, found: Sequence[Smoothed], system: System, dt: float, clock: float
) -> set[int]:
    """Columns of the sensor whose smoother does not fit the lateness; none where all do, or nothing shows which."""
    pair = [set(channel_columns(system, name)) for name in (lag.channel, lag.other)]
    late = [[o.smoother.delay for o in found for k in o.behind if {*k.sensor.columns} == own] for own in pair]
    if not all(late):
        return set()
    (position, *_), (rate, *_) = late
    off, *without = (abs(lag.seconds * clock - made) / dt for made in (position - rate, -rate, position))
    best = int(np.argmin(without))
    return pair[best] if off >= _FAR and without[best] < _NEAR <= without[1 - best] else set()


# ---- as they were before -------------------------------------------------------------------------------

ABOVE, ADDED = 100.0, 10.0
"""Times the spectrum of the motion at f_r that the noise above it is; and times that of the log where noise is added.
The gain of a spring under a white force errs by 13 % where it is as large, by 3 % at 10 times, by 1 % at 100."""
_FADES = 0.15  # of f_r, over which the restored part gives way to noise
_ENDS = 1.5  # left out at the ends of stretches, over the frequency at which |S| is 0.7
_FEWEST = 50  # rows that must be left of a stretch


def undone_at_own_rate(
    data: DataSet,
    system: SystemInfo,
    *,
    dt: float | None,
    stream_offsets: str,
    state_smoothing: str,
    taken_out: Iterable[str] = (),
) -> DataSet:
    """A data set on the step that was asked for, without what the recording did to its states and inputs.

    Args:
        dt: The step that was asked for [s]; None: that of the data.
        stream_offsets: "undo", or "keep" streams, and sensors that a longer step would hide, where they are.
        state_smoothing: "restore", or "keep" states, and measured inputs, as they are.
        taken_out: Names of the faults that the reader took out.
    """
    data = on_one_clock(data, system, policy=stream_offsets)
    found: list[Smoothed] = []
    if state_smoothing != "keep" and isinstance(system, System):
        data, found = smoothers_of(data, system, taken_out)
    if dt is None or not is_longer(dt, data.dt):
        return restored(data, found)
    seen = measured_part(system, {name for run in data.runs for name in run.inferred})
    rows = restored(data, found).runs
    late = [] if stream_offsets == "keep" else late_channels(seen, rows, clock=data.clock_scale)
    late = surely_late(late, rows[0].dt) if late else []
    return restored(on_longer_step(data, system, dt, late=late), found)


def smoothers_of(
    data: DataSet, system: System, taken_out: Iterable[str] = ()
) -> tuple[DataSet, list[Smoothed]]:
    """A data set with its inputs as they act, and what smoothed its states, for `restored`; nothing once it is undone.

    Behind a fault that the reader took out (`taken_out`) and that smooths, no smoother can be identified. Noise of
    inputs is none of the states: what they do not show of the inputs is asked for last.
    """
    known = remedies()
    smooths = any(known[name].remedy_smooths for name in taken_out if name in known)
    done = any(finding.kind == "state_smoothing" for finding in data.summary.findings)
    ask, clock = not (smooths or done), data.clock_scale
    held = not system.nu or held_over_rows(data.runs, system.nu)
    data = without_noise_about_levels(data, system)
    found = smoothed_states(data.runs, system, clock) if ask else []
    found = [_on_time_by_physics(one, data, system) for one in found]
    if not held:
        data = as_they_act(data, system, restored(data, found).runs)
    return data, [*found, *(smoothed_by_response(data.runs, system, found, clock) if ask else ())]


def _on_time_by_physics(one: Smoothed, data: DataSet, system: System) -> Smoothed:
    """One smoother, on time or late as the physics says, restored up to where those that may be in its place agree.

    |S| of a centred mean of an odd number of rows is that of the mean of the past: the physics must choose. Of two axes
    under steps of their forces, behind a mean of the last five rows, something with a memory was missing. Behind other
    smoothers a delay may be the machine's: the physics only rules those out that would put the states too early.
    """
    smoother, past = one.smoother, next(f for f in smoothers.FAMILIES if f.name == smoothers.OF_THE_PAST)
    dt = data.dt * data.clock_scale
    late = [o for o in one.others if abs(o.delay - smoother.delay) > 0.5 * dt]
    if smoother.family.name == smoothers.CENTRED and smoother.size % 2:
        late = [replace(smoother, family=past), *late]
    rows = max(1, round(_HALF / (smoother.falls_to(0.7) * dt)))
    fitted = [
        rough_fit(system, restored(data, [replace(one, smoother=o)]).runs, data.clock_scale) for o in late
    ]
    own = rough_fit(system, restored(data, [one]).runs, data.clock_scale) if late else None
    others = list(one.others)
    for other, fit in zip(late, fitted, strict=True):
        if fit is None or own is None:
            continue
        (now, n), (then, m) = (_log_of_sums(some, rows) for some in (own, fit))
        gain = 0.5 * min(n, m) * (now - then)
        if other.family is past and gain > NATS:
            smoother = other
        elif other in others and gain < -NATS:
            others.remove(other)
    agree, begins = smoothers.Likely(smoother, 0.0, tuple(others)).agree_to, smoother.falls_to(BEGINS)
    behind = []
    for k in one.behind:
        reach = max(min(k.reach, agree), begins) if k.restored else k.reach
        whole = group_spectra(k.sensor, data.runs, dt) if reach < k.seen.f[0] else None
        seen = whole or k.seen  # the noise above must be louder than what inputs move there
        behind.append(
            replace(k, reach=reach, fit=smoothers.fit(seen, smoother) if whole else k.fit, seen=seen)
        )
    return replace(one, smoother=smoother, behind=tuple(behind), others=tuple(others))


def _log_of_sums(regression: Regression, rows: int) -> tuple[float, int]:
    """Log mean squares of what is left of driven channels, summed over so many rows, and the number of these sums."""
    driven = sorted({channel for way in signals.directions(regression) for channel in way.channels})
    sums = regression.single.summed(regression.physics.residual(regression.theta)[:, driven], rows)
    return float(np.log(np.maximum(np.square(sums).mean(0), 1e-300)).sum()), len(sums)


def restored(data: DataSet, found: Sequence[Smoothed]) -> DataSet:
    """A data set as it was before smoothers that were found in it, on its step or a shorter one.

    Its summary has a finding `state_smoothing` for each smoother.
    """
    if not found:
        return data
    dt, rng = data.dt * data.clock_scale, np.random.default_rng(0)
    pairs = [(one.smoother, k) for one in found for k in one.behind]
    ends = [_ENDS / smoother.falls_to(0.7) for smoother, k in pairs if k.restored]
    out_of_use = int(np.ceil(max(ends, default=0.0) / dt))
    held = [k for _, k in pairs if k.reach < 0.5 / dt]  # else these rows hold nothing of where it falls
    band = {name: k.reach for k in held for name in k.sensor.names}
    low_pass = {name: k.reach for k in held if k.louder_above for name in k.sensor.names}
    runs = []
    for run in data.runs:
        x = np.array(run.x)
        for a, b in run.segments:
            for smoother, k in pairs:
                if k.restored or k.reach < 0.5 / dt:
                    _restore_stretch(x[a:b], smoother, k, dt, rng)
        inner = [(a + out_of_use, b - out_of_use) for a, b in run.segments]
        kept = tuple((a, b) for a, b in inner if b - a >= _FEWEST)
        whole = run.unbroken or run.segments
        segments = kept or run.segments
        runs.append(replace(run, x=x, segments=segments, band=band, low_pass=low_pass, unbroken=whole))
    return data.changed(runs, [*data.summary.findings, *(one.finding() for one in found)])


def _restore_stretch(
    x: Array, smoother: Smoother, one: SmoothedSensor, dt: float, rng: np.random.Generator
) -> None:
    at, values = one.bin, one.sensor.values(x, dt)
    level = ADDED * one.seen.power[:, at]
    if one.restored:  # what moves above is removed: it must not weigh beside the noise that stands in for it
        level = one.fit.noise[:, at] + ABOVE * one.fit.motion[:, at]
    noise = rng.standard_normal(values.shape) * np.sqrt(level / (2.0 * dt))
    new = _unsmoothed(values, smoother, one.reach, noise, dt) if one.restored else values + noise
    one.sensor.with_values(x, new, dt)


def _unsmoothed(values: Array, smoother: Smoother, reach: float, noise: Array, dt: float) -> Array:
    """Values (n, C) of one stretch before a smoother up to a frequency, and noise above it."""
    n = len(values)
    around = min(n - 1, int(3.0 / (_FADES * reach * dt)) + _FEWEST)
    first, last = 2.0 * values[0] - values[around:0:-1], 2.0 * values[-1] - values[-2 : -around - 2 : -1]
    longer = np.concatenate([first, values, last])
    line = np.linspace(longer[0], longer[-1], len(longer))
    f = rfftfreq(len(longer), dt)
    keep = 0.5 * (1.0 + np.cos(np.pi * np.clip((f - reach) / (_FADES * reach) + 1.0, 0.0, 1.0)))
    response = np.where(keep > 0, smoother.response(f), 1.0)
    gain = np.where(keep > 0, keep / response, 0.0)
    before = irfft(rfft(longer - line, axis=0) * gain[:, None], len(longer), axis=0) + line
    there = np.interp(np.linspace(0.0, 1.0, n // 2 + 1), np.linspace(0.0, 1.0, len(keep)), keep)
    above = irfft(rfft(noise, axis=0) * np.sqrt(1.0 - np.square(there))[:, None], n, axis=0)
    return np.asarray(before[around : around + n] + above)
