"""The state that a vehicle will be in, by what was asked for, and what pushes it that the model does not know.

    q' = q * w / 2,   v' = R ((0, 0, f) - D R'v + d) - g,   p' = v      with (w, f) asked for a delay before

`D` is what the model says of braking by speed: a drag of 1 1/s is 0.2 m/s over a delay at 3 m/s. `d` follows from how
wrong the velocity was that had been predicted, as in `nsde_torch.control.estimator`,

    d' = d + R'(v - v_predicted) / T
"""

from __future__ import annotations

from bisect import bisect_right
from typing import final

from nsde_torch.px4.flight.cascade import GRAVITY
from nsde_torch.px4.flight.controller import Asked
from nsde_torch.px4.link.vectors import Vec, rotate, rotate_back, turned_by_rates

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
        value: Acceleration along the body's axes [m/s2].
    """

    LONGEST = 0.2
    """Time between two states beyond which nothing is learned from them [s]."""

    def __init__(self, *, delay: float, drag: Drag, time: float, limit: float) -> None:
        self._delay, self._drag, self._time, self._limit = delay, drag, time, limit
        self.reset()

    def reset(self) -> None:
        """Forget what was learned."""
        self.value = NO_PUSH
        self._last: tuple[float, tuple[float, ...]] | None = None

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
        told = carried(
            last[1], last[0], time - last[0], asked, delay=self._delay, drag=self._drag, push=self.value
        )
        off = (row[3] - told[3], row[4] - told[4], row[5] - told[5])
        error = rotate_back(row[6:10], off)  # type: ignore[arg-type]
        share = 1.0 / max(self._time, time - last[0])
        x, y, z = (
            min(max(d + share * e, -self._limit), self._limit) for d, e in zip(self.value, error, strict=True)
        )
        self.value = (x, y, z)
        return self.value
