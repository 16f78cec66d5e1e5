"""The state that a vehicle will be in, by what was asked for, and what pushes it that the model does not know.

    q' = q * w / 2,   v' = R ((0, 0, f) - D R'v + d) - g,   p' = v      with (w, f) asked for a delay before

`D` is what the model says of braking by speed: a drag of 1 1/s is 0.2 m/s over a delay at 3 m/s. `d` follows from how
wrong the velocity was that had been predicted, as in `nsde_torch.control.estimator`,

    d' = d + R'(v - v_predicted) / T

A push that goes with the speed comes a quarter of a period of the path too late that way, so that it is learned as
braking, D_i' = D_i - dt / 2 s d_i u_i / (u_i^2 + (1 m/s)^2) with u = R'v, and `d` keeps the rest. On a hexacopter with
a drag of 0.7, 0.5, 0.3 1/s that its model does not know: 4.2 cm off a lemniscate at 3.4 m/s, and 9.4 cm by `d` alone.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from typing import final

from nsde_torch.px4.flight.cascade import GRAVITY
from nsde_torch.px4.flight.controller import Asked
from nsde_torch.px4.link.vectors import Vec, rotate, rotate_back, turned_by_rates

SLOPE_TIME, SLOW, STEEPEST = 2.0, 1.0, 1.0
"""Time constant of learning how it brakes [s], speed below which little is learned [m/s], largest slope [1/s]."""
STEP = 0.01
"""Longest step of the integration, about [s]."""
Drag = tuple[Vec, Vec, Vec]
NO_DRAG: Drag = ((0.0, 0.0, 0.0),) * 3
NO_PUSH: Vec = (0.0, 0.0, 0.0)


def carried(
    row: tuple[float, ...],
    time: float,
    span: float,
    asked: Asked,
    *,
    delay: float,
    drag: Drag = NO_DRAG,
    push: Vec = NO_PUSH,
) -> tuple[float, ...]:
    """The state a span later, by what was asked for.

    Args:
        row: State of 13 numbers, ENU and FLU.
        time: When it was valid [s].
        span: How much later [s].
        asked: What was sent lately, as it left.
        delay: From a setpoint to its effect [s].
        drag: How the machine brakes by its speed along the body, D of a = -D v [1/s].
        push: Acceleration along the body's axes that the model does not know [m/s2].
    """
    p, v, q = row[0:3], row[3:6], row[6:10]
    w: Vec = (row[10], row[11], row[12])
    steps = max(round(span / STEP), 1)
    dt = span / steps
    times = [left for left, _ in asked]
    for k in range(steps):
        newest = bisect_right(times, time - delay + (k + 0.5) * dt) - 1
        thrust = GRAVITY  # where nothing is known it hovers
        if newest >= 0:
            w, thrust = asked[newest][1].w, asked[newest][1].thrust
        u = rotate_back(q, v)  # type: ignore[arg-type]
        x, y, z = (d[0] * u[0] + d[1] * u[1] + d[2] * u[2] for d in drag)
        force = rotate(q, (push[0] - x, push[1] - y, push[2] + thrust - z))  # type: ignore[arg-type]
        a = (force[0], force[1], force[2] - GRAVITY)
        p = tuple(pi + dt * vi + 0.5 * dt * dt * ai for pi, vi, ai in zip(p, v, a, strict=True))
        v = tuple(vi + dt * ai for vi, ai in zip(v, a, strict=True))
        q = turned_by_rates(q, w, dt)  # type: ignore[arg-type]
    return (*p, *v, *q, *w)


@final
class PushEstimate:
    """What pushes the vehicle, learned from velocities while it flies.

    Args:
        delay: From a setpoint to its effect [s].
        drag: See `carried`.
        time: Time constant of learning [s]; 0: nothing is learned.
        limit: Largest push along each axis [m/s2].

    Attributes:
        value: Acceleration along the body's axes at the newest state [m/s2].
        rest: What of it does not go with the speed [m/s2].
        slopes: How it brakes by its speed along each axis, beyond what the model says [1/s].
    """

    LONGEST = 0.2
    """Time between two states beyond which nothing is learned from them [s]."""

    def __init__(self, *, delay: float, drag: Drag, time: float, limit: float) -> None:
        self._delay, self._drag, self._time, self._limit = delay, drag, time, limit
        self.reset()

    def reset(self) -> None:
        """Forget what was learned."""
        self.value = self.rest = self.slopes = NO_PUSH
        self._last: tuple[float, tuple[float, ...]] | None = None

    @property
    def drag(self) -> Drag:
        """How the machine brakes, as the model says and as was learned [1/s]."""
        (a, b, c), (k, m, n) = self._drag, self.slopes
        return ((a[0] + k, a[1], a[2]), (b[0], b[1] + m, b[2]), (c[0], c[1], c[2] + n))

    def at(self, row: tuple[float, ...]) -> Vec:
        """The push that the model does not know, at a state of 13 numbers [m/s2]."""
        u = rotate_back(row[6:10], row[3:6])  # type: ignore[arg-type]
        return self._bounded(d - k * v for d, k, v in zip(self.rest, self.slopes, u, strict=True))

    def take(self, row: tuple[float, ...], time: float, asked: Asked) -> Vec:
        """Learn from a state.

        Args:
            row: State of 13 numbers.
            time: When it was valid [s].
            asked: What was sent lately, as it left.
        """
        last, self._last = self._last, (time, row)
        if last is None or not self._time > 0 or not 0.0 < time - last[0] <= self.LONGEST:
            return self.value
        dt = time - last[0]
        told = carried(last[1], last[0], dt, asked, delay=self._delay, drag=self.drag, push=self.rest)
        off = (row[3] - told[3], row[4] - told[4], row[5] - told[5])
        error = rotate_back(row[6:10], off)  # type: ignore[arg-type]
        share = 1.0 / max(self._time, dt)
        self.rest = self._bounded(d + share * e for d, e in zip(self.rest, error, strict=True))
        u = rotate_back(row[6:10], row[3:6])  # type: ignore[arg-type]
        k, m, n = (
            min(max(s - dt / SLOPE_TIME * d * v / (v * v + SLOW * SLOW), -STEEPEST), STEEPEST)
            for s, d, v in zip(self.slopes, self.rest, u, strict=True)
        )
        # the push at this state stays what it is, whatever it is put down to
        self.rest = self._bounded(
            d + (new - old) * v for d, new, old, v in zip(self.rest, (k, m, n), self.slopes, u, strict=True)
        )
        self.slopes = (k, m, n)
        self.value = self.at(row)
        return self.value

    def _bounded(self, push: Iterable[float]) -> Vec:
        x, y, z = (min(max(d, -self._limit), self._limit) for d in push)
        return (x, y, z)
