"""A fit of declared physics held against two simple ones.

    the fit              by whatever method, theta
    least squares        on means over 0.15 s, both sides of the equation through one filter (`rough`)
    the first values     theta_0

all judged by what they leave of the rates by the end of these means, without the mean over each run. What decides which
of them is accepted, and the longer boxes that are tried where a noise model may have learned the physics, is in
docs/content/theory/identification.md. "Surely" is one test of all parameters, d' (V + W)^-1 d for the difference d of
two fits with covariances from blocks of time. Before come interpretations of the columns (`readings`), streams of
another time (`timing`) and runs of another machine (`run_differences`): where the log is at fault, fits part for that
reason.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from math import log
from typing import Any

import numpy as np
from scipy.special import fdtrc, stdtrit

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.inference.estimate import ARITHMETIC
from nsde_torch.sysid.physics import per_second
from nsde_torch.sysid.readings import better_readings
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.rough import Left, Objection, left_at, objection, rough_fit
from nsde_torch.sysid.run_differences import odd_run, unexplained_runs
from nsde_torch.sysid.timing import shifted_stream
from nsde_torch.systems import System

CHANCE = 1e-3  # chance of calling two fits of a sound log different
MORE = 0.1
"""Share of a channel's variance that least squares must explain beyond the fit, beside that: what the physics lacks
biases both, and not alike."""
SOME = 0.95  # times what was measured that least squares leave where they explain something
TIMES = 2.0
"""Or times what least squares leave that the fit leaves: how much of the rest they explain, where the rest is small."""
LESS = 0.9  # times what the fit predicts of a channel below which least squares find less of it
BEHIND = 0.3
"""By how much the sum over channels of log(left) must be smaller at the first values than at the fit, of channels of
which least squares find no less."""
MATTERS = 0.01
"""Share of a channel's variance that the first values must explain beyond the fit, beside that: of what is explained
almost wholly, the widths of frictions leave more or less in rough rates."""
GONE = 10.0
"""Times smaller than its first value that a parameter must surely be (two standard errors) to have vanished."""
NOTHING = 0.02  # share of a channel's variance up to which a fit explains nothing of it
POOR = 0.8
"""Share of the measured that the best fit leaves of half of the channels, where physics explains nothing."""


def doubts_the_fit(kinds: Iterable[str]) -> bool:
    """Whether objections of these kinds speak against the fit.

    That physics explains next to nothing (`poor`) is said of data, not of the fit: a machine at rest shows nothing.
    """
    return any(kind != "poor" for kind in kinds)


@dataclass(frozen=True)
class Compared:
    """One channel, and what each fit leaves of it in means over 0.15 s."""

    name: str
    unit: str
    measured: float  # root mean square of the measured rate about the mean of each run
    fit: float  # what the fit leaves
    least_squares: float  # what least squares leave
    first_values: float  # what the first values leave
    less: bool = False
    """Whether what least squares predict of it is surely smaller (`LESS`) than what the fit predicts."""
    noise: float = 0.0  # what the noise of the sensor leaves

    @property
    def unexplained(self) -> bool:
        """Whether physics explains next to nothing of what moves beyond the noise, or nothing does."""
        moves, left = self.measured**2 - self.noise**2, self.best**2 - self.noise**2
        return moves < NOTHING * self.measured**2 or left > POOR**2 * moves

    @property
    def best(self) -> float:
        """What is left by the best of them: least squares that diverge say nothing of the physics.

        Of a ball above a fan they left 0.26 of 0.13 m/s2, and the right lag was rejected.
        """
        return min(self.fit, self.least_squares, self.first_values)

    def as_dict(self) -> dict[str, Any]:
        return {k: v for k, v in asdict(self).items() if k not in ("name", "less", "noise")}


@dataclass(frozen=True)
class Guarded:
    """What speaks against a fit, and how it stands beside simple ones."""

    objections: tuple[Objection, ...] = ()  # what speaks against it; nothing where it is accepted
    channels: tuple[Compared, ...] = ()  # what each fit leaves of each channel
    labels: tuple[str, ...] = ()
    least_squares: tuple[float, ...] = ()  # their values by least squares (k,)
    chance: float = 1.0  # chance of so large a difference between the fit and least squares
    notes: tuple[str, ...] = ()  # what is worth knowing and speaks not against the fit
    half_90: tuple[float, ...] = ()
    """Half-widths of the 90 % intervals of these (k,), nan where the data do not show one; empty where they are not to
    be used."""
    units: tuple[str, ...] = ()  # units of the parameters, likewise

    def doubts(self, channels: Iterable[str]) -> bool:
        """Whether an objection speaks of one of these channels."""
        some = {*channels}
        return any(not o.channels or some & {*o.channels} for o in self.objections)

    @property
    def to_use(self) -> dict[str, dict[str, Any]]:
        """Values, 90 % intervals and units of least squares by parameter, where these are to be used; else nothing."""
        rows = zip(self.labels, self.least_squares, self.half_90, self.units, strict=False)
        return {
            name: {"value": v, "interval_90": [v - h, v + h] if np.isfinite(h) else None, "unit": unit}
            for name, v, h, unit in rows
        }

    def as_dict(self) -> dict[str, Any]:
        return {
            "objections": [o.as_dict() for o in self.objections],
            "channels": {c.name: c.as_dict() for c in self.channels},
            "least_squares": dict(zip(self.labels, self.least_squares, strict=True)),
            "chance": self.chance,
            "notes": list(self.notes),
            **({"to_use": self.to_use} if self.to_use else {}),
        }


def guarded(
    regression: Regression,
    runs: Sequence[Run],
    *,
    clock: float = 1.0,
    theta: Array | None = None,
    covariance: Array | None = None,
    first: Array | None = None,
) -> Guarded:
    """Hold a fit against simple ones, and look for faults of the log that explain where they part.

    Values that are printed (k,), `theta` with its covariance (k, k), and first ones are those of the regression, unless
    others are given.
    """
    vector = regression.vector
    first = vector.start if first is None else first
    system = vector.at(first)
    rough = rough_fit(system, runs, clock)
    theta = regression.theta if theta is None else theta
    if rough is None or len(rough.theta) != len(theta):
        return Guarded()
    places = theta, rough.theta, vector.inside(first)
    fit, squares, begun = (left_at(rough, at) for at in places)
    channels = []
    for c, s, f in zip(fit, squares, begun, strict=True):
        smaller = s.predicted < LESS * c.predicted
        channels.append(
            Compared(c.name, per_second(c.unit), c.measured, c.left, s.left, f.left, smaller, s.noise)
        )
    objections, notes = _faults(system, runs, clock, rough, regression)
    chance = _chance(rough, theta, covariance)
    if not objections:
        apart = _disagreement(channels, chance) or _gone(rough, theta, covariance, fit)
        objections = [] if apart is None else [apart]
        less = ", ".join(c.name for c in channels if _apart(c) and c.less)
        if less and not objections and chance < CHANCE:
            notes.append(
                f"least squares on means over 0.15 s, or five rows, find less of {less} than the fit: the fit is kept. "
                "Feedback that answers what the physics lacks, and noise of the states, make what they find smaller"
            )
    values = tuple(vector.labels), tuple(rough.theta.tolist())
    found = Guarded(tuple(objections), tuple(channels), *values, chance, tuple(notes))
    return _recommended(found, rough) if "least_squares" in {o.kind for o in objections} else found


def _recommended(found: Guarded, rough: Regression) -> Guarded:
    """The same with least squares, their 90 % intervals (nan where the data show none), and words of them.

    What is not known to its own size, and to a typical one, is not shown: nobody can use a gravity of -126 to 180.
    """
    basis, sure = rough.shown.basis, rough.spread()
    error = np.sqrt(np.clip(np.diag(basis @ sure.covariance @ basis.T), 0.0, None))
    half = stdtrit(sure.degrees(basis).clip(1.0), 0.95) * error
    known = rough.shown.known & (half <= np.maximum(np.abs(rough.theta), rough.vector.scale))
    half = np.where(known, half, np.nan)
    found = replace(found, half_90=tuple(half.tolist()), units=tuple(rough.vector.units))
    told = []
    for name, own in found.to_use.items():
        ends, unit = own["interval_90"], "" if own["unit"] == "1" else f" {own['unit']}"
        between = f"90 % interval {ends[0]:.3g} to {ends[1]:.3g}" if ends else "not shown by the data"
        told.append(f"{name} {own['value']:.3g}{unit} ({between})")
    (one,) = found.objections  # where least squares are to be used, nothing else is said
    remedy = (
        f"the values of least squares are nearer, if nothing else is missing: {', '.join(told)}; {one.remedy}"
    )
    return replace(found, objections=(replace(one, remedy=remedy),))


def _faults(
    system: System, runs: Sequence[Run], clock: float, rough: Regression, regression: Regression
) -> tuple[list[Objection], list[str]]:
    """Faults of the log, the first kind that is found: the columns, times, a run, another machine."""
    better = better_readings(system, runs, clock, rough)
    if better is not None:
        return [better], []
    moved = shifted_stream(system, runs, clock, rough)
    if moved is not None and not moved.of_actuators:
        return [moved.objection], []
    notes = [] if moved is None else [str(moved.objection)]
    apart = unexplained_runs(rough, runs)
    odd = None if apart else odd_run(regression, rough, runs)
    return apart or [o for o in (odd,) if o], notes


def _disagreement(channels: Sequence[Compared], chance: float) -> Objection | None:
    """Where the fit and the simple ones part, the surest one."""
    lost = [c for c in channels if _apart(c) and not c.less]
    # where least squares find less, and explain something, inputs cancel what the physics lacks
    cancelled = [c for c in channels if c.less and c.least_squares < SOME * c.measured]
    if lost and chance < CHANCE:
        return objection("least_squares", lost=lost)
    # smaller gains leave less too where inputs cancel what the physics lacks
    behind = sum(log(max(c.fit, 1e-12) / max(c.first_values, 1e-12)) for c in channels if not c.less)
    matters = any(c.fit**2 - c.first_values**2 > MATTERS * c.measured**2 for c in channels)
    if behind > BEHIND and matters and chance < CHANCE:
        return objection("first_values")
    poor = [c for c in channels if c.unexplained and c not in cancelled]
    return objection("poor", poor=poor) if channels and 2 * len(poor) > len(channels) else None


def _gone(rough: Regression, theta: Array, covariance: Array | None, now: Sequence[Left]) -> Objection | None:
    """Parameters that have surely vanished, and with them all that is explained of a channel."""
    vector = rough.vector
    error = np.zeros(len(theta)) if covariance is None else np.sqrt(np.diag(covariance).clip(0.0))
    small = GONE * (np.abs(theta) + 2.0 * error) < np.abs(vector.start)
    bare = [c.left**2 > (1.0 - NOTHING) * c.measured**2 for c in now]
    gone: dict[str, list[str]] = {}
    for j in np.flatnonzero(small):
        if "." in vector.labels[j]:
            continue  # an effect that is declared may well be nothing
        back = theta.copy()
        back[j] = vector.start[j]
        more = [
            (a.predicted**2 - c.predicted**2) / max(c.measured**2, 1e-300)
            for a, c in zip(left_at(rough, back), now, strict=True)
        ]
        moved = int(np.argmax(more))
        if bare[moved] and more[moved] > NOTHING:
            gone.setdefault(now[moved].name, []).append(
                f"{vector.labels[j]} {theta[j]:.2g} {vector.units[j]} (first value {vector.start[j]:.3g})"
            )
    return objection("gone", gone=gone, of=tuple(gone)) if gone else None


def _apart(c: Compared) -> bool:
    """Whether a fit leaves more than least squares do, beyond what arithmetic leaves."""
    more = c.fit**2 - c.least_squares**2 > MORE * c.measured**2
    return more or c.fit > max(TIMES * c.least_squares, ARITHMETIC * c.measured)


def _chance(rough: Regression, theta: Array, covariance: Array | None) -> float:
    """Chance of so large a difference between a fit and least squares, in the directions that the data show."""
    basis, sure = rough.shown.basis, rough.spread()
    if not basis.shape[1]:
        return 1.0
    back = np.linalg.pinv(basis)
    apart = back @ (rough.theta - theta)
    total = sure.covariance
    if covariance is not None:
        total = total + back @ covariance @ back.T
    count = len(apart)
    statistic = float(apart @ np.linalg.pinv(total, hermitian=True) @ apart)
    free = max(float(np.median(sure.degrees(basis))), 1.0) - count + 1.0
    if free < 2.0:
        return 1.0
    # Hotelling's law of a mean with an estimated covariance
    return float(fdtrc(count, free, statistic * free / (count * (free + count - 1.0))))


# ---- longer boxes --------------------------------------------------------------------------------------

LENGTHS_S = (0.05, 0.2)
"""Length of the boxes, and of those that they are held against [s]: a bias as the root of the length doubles."""
LONGER = 2.0  # times the length of the boxes before that the first must have


def asks_for_longer_boxes(guard: Guarded | None) -> bool:
    """Whether what speaks against a fit is what its noise model may have learned."""
    kinds = {"least_squares", "first_values", "gone"}
    return guard is not None and bool(guard.objections) and {o.kind for o in guard.objections} <= kinds


def of_longer_boxes(box_s: float, guard: Guarded) -> str:
    """What was done, and the remedy, for a person."""
    why = "; ".join(o.sentence for o in guard.objections)
    longest = LENGTHS_S[1] / LENGTHS_S[0] * box_s
    return (
        f"means over {box_s:.3g} s are fitted: nothing speaks against these; over shorter ones, {why}; intervals are "
        f"widened by what changes with means over {longest:.3g} s. The states may have been smoothed or filtered "
        "before they were logged, or something that acts is not declared: log raw sensors; `nsde diagnose` names "
        "effects"
    )
