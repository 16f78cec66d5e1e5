"""Streams that are shifted where no kinematics can show it: the inputs, an attitude with its rates.

The declared physics is fitted by plain least squares on means over 0.15 s (`rough`) with a stream moved in time. What
is left, L(s) = sum over channels of log(left / measured), has a sharp minimum in the shift s. What goes with a
channel's own state does not count: undeclared drag of a machine that oscillates resembles a late attitude, whose error
is proportional to the rate of the oscillation. A parabola through three shifts says where it is; where it is elsewhere,
the search follows it. Where a channel is worse once the stream is moved, or where states were smoothed, a lag and a
smoother together do the same as a shift, and none is advised.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from nsde_torch.data import Run
from nsde_torch.data.system_info import common_name, derivative_columns, rate_columns
from nsde_torch.recording.latency import moved
from nsde_torch.sysid.measured_inputs import later
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.rough import Objection, beginnings, left_at, objection, rough_fit
from nsde_torch.systems import System

STEP_S = 0.03  # distance of the shifts that are compared [s]
MOST_S = 0.2  # longest shift that is looked for [s]
LEAST_S = 0.012  # shortest shift that is reported [s], and at least a row: less may be how a machine steps
ACTUATOR_S = 0.08
"""How late inputs may act by what actuators do, a lag or a delay, which the declared physics may lack [s]."""
GAIN = 0.4  # by how much L must be smaller than without the shift; four channels that each lose a tenth
_WORSE = 0.05  # by how much the logarithm of one channel's residual must grow to speak against a shift
_ITERATIONS = 3
_PART_S = 30.0


@dataclass(frozen=True)
class Shifted:
    """A stream that belongs to another time."""

    stream: str  # what is shifted, by the names of its columns
    seconds: float  # by how much it is logged late; early, if negative [s]
    pace: float  # that of the machine (`nsde_torch.data.pace`)
    gain: float  # by how much L falls when it is moved back
    inputs: bool  # whether it is the inputs: then early means that they act later than they were logged
    against: tuple[str, ...] = ()  # channels of which the physics leaves more when the stream is moved
    smoothed: tuple[str, ...] = ()  # states that were smoothed before they were logged

    @property
    def of_actuators(self) -> bool:
        """Whether a lag or a delay of actuators does the same."""
        return self.inputs and -ACTUATOR_S * self.pace < self.seconds < 0

    @property
    def objection(self) -> Objection:
        """What was found, and what to do."""
        return objection("shifted_stream", s=self, times=np.exp(self.gain))


def shifted_stream(system: System, runs: Sequence[Run], clock: float, rough: Regression) -> Shifted | None:
    """The stream that is most surely shifted against the others; None where none is."""
    some = beginnings(runs, clock, seconds=_PART_S, fewest=100)
    found = [s for stream in _streams(system) if (s := _best(system, some, clock, rough, stream))]
    return max(found, key=lambda s: s.gain, default=None)


def _streams(system: System) -> list[tuple[str, list[int]]]:
    """Names, and columns of the states; none for the inputs."""
    out: list[tuple[str, list[int]]] = []
    if system.nu:
        out.append((_named(list(system.input_names)), []))
    rates = rate_columns(system)
    if system.quaternion is not None and rates is not None:
        columns = [*range(system.nx)[system.quaternion], *range(system.nx)[rates]]
        out.append((_named([system.state_names[c] for c in columns]), columns))
        return out
    pairs = [(i, j) for a, b in derivative_columns(system).values() for i, j in zip(a, b, strict=True)]
    for i, j in pairs[1:]:
        out.append((_named([system.state_names[i], system.state_names[j]]), [i, j]))
    return out


def _named(names: list[str]) -> str:
    numbered = [n[-2:-1] == "_" and n[-1] in "xyzw123456789" for n in names]
    groups = [common_name([n, n]) if one else n for n, one in zip(names, numbered, strict=True)]
    return " and ".join(dict.fromkeys(groups))


def _best(
    system: System, runs: Sequence[Run], clock: float, rough: Regression, stream: tuple[str, list[int]]
) -> Shifted | None:
    dt, (name, states) = runs[0].dt * clock, stream
    pace = runs[0].pace
    step = STEP_S * pace

    @cache
    def shares(seconds: float) -> dict[str, float]:
        read = _mover(system, seconds / dt, states)
        moved = [read(run) for run in runs]
        fitted = rough_fit(system, moved, clock, iterations=_ITERATIONS, start=rough.theta)
        if fitted is None or len(fitted.rows) < len(rough.rows):
            return {}
        return {c.name: c.share for c in left_at(fitted, fitted.theta, damped=True)}

    def score(seconds: float) -> float:
        left = shares(round(seconds, 6))
        return sum(left.values()) if left else float("inf")

    middle = 0.0
    while True:
        before, here, after = score(middle - step), score(middle), score(middle + step)
        if here <= min(before, after) or abs(middle) >= MOST_S * pace:
            break
        middle += step if after < before else -step
    bend = before + after - 2.0 * here
    if not (np.isfinite(bend) and bend > 0):
        return None
    best = middle + 0.5 * step * (before - after) / bend
    if abs(best) < max(LEAST_S * pace, dt):
        return None
    gain = score(0.0) - min(score(best), here)
    if not gain > GAIN:
        return None
    there = shares(round(best if score(best) < here else middle, 6))
    against = tuple(c for c, left in shares(0.0).items() if there.get(c, left) > left + _WORSE)
    smoothed = tuple(sorted({state for run in runs for state in run.band}))
    return Shifted(name, best, pace, gain, not states, against, smoothed)


def _mover(system: System, rows: float, states: list[int]) -> Callable[[Run], Run]:
    """Take out that some states, or the inputs where there are none, are so many rows late."""

    def read(run: Run) -> Run:
        x, q = np.array(run.x), system.quaternion
        lost = int(np.ceil(abs(rows)))
        long = [(a, b) for a, b in run.segments if b - a >= 2 * lost + 4]
        inner = tuple((a + lost, b - lost) for a, b in long) or run.segments
        if not states:
            return replace(later([run], range(system.nu), rows)[0], segments=inner)
        for a, b in long:
            x[a:b, states] = moved(np.asarray(run.x[a:b, states]), rows)
        if q is not None:
            x[:, q] /= np.linalg.norm(x[:, q], axis=1, keepdims=True)
        return replace(run, x=x, segments=inner)

    return read
