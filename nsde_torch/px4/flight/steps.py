"""Steps of the autopilot's estimate: a state against what the one before it predicts.

    position |p' - p - v dt|,    velocity |v' - v| - a dt,    heading z of log(q' (q exp(w dt))^-1),    a = 30 m/s2

Estimators reset themselves. A step of the heading alone is harmless, PX4 makes one in every flight; one of position or
velocity is a fall or a leap to whoever flies by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.px4.link.vectors import Vec, distance, multiply, rotation_vector, turned_by_rates

HARDEST = 30.0
"""Acceleration that thrust and gravity may make [m/s2]: a small multirotor at full throttle."""
UNANNOUNCED = radians(3.0)
"""Step of the heading that is a reset though nothing announced it: ATTITUDE_QUATERNION has no counter [rad]."""
LONGEST = 0.5
"""Longest time between two states that are compared [s]."""


@dataclass(frozen=True)
class EstimateStep:
    """What a reset changed.

    Args:
        stamp: Of the first state after it, on the autopilot's clock [s].
        position: Step of the position [m].
        velocity: Step of the velocity, beyond what thrust explains [m/s].
        heading: Step of the heading, counter-clockwise from above [rad].
        announced: Whether the autopilot said so.
    """

    stamp: float
    position: float
    velocity: float
    heading: float
    announced: bool


def step_between(last: VehicleState, state: VehicleState) -> EstimateStep | None:
    """The step from one state to a later one; None where they are the same, or too far apart to tell."""
    dt = state.stamp - last.stamp
    if not 0.0 < dt < LONGEST:
        return None
    p: Vec = tuple(a + dt * b for a, b in zip(last.p, last.v, strict=True))  # type: ignore[assignment]
    w: Vec = tuple(0.5 * (a + b) for a, b in zip(last.w, state.w, strict=True))  # type: ignore[assignment]
    before = turned_by_rates(last.q, w, dt)
    turn = multiply(state.q, (before[0], -before[1], -before[2], -before[3]))
    return EstimateStep(
        state.stamp,
        distance(state.p, p),
        max(distance(state.v, last.v) - HARDEST * dt, 0.0),
        rotation_vector(turn)[2],
        state.resets != last.resets,
    )
