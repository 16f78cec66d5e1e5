"""What a demand must pass before it leaves, because PX4 does not check it, and the throttle for a thrust.

    throttle = hover * thrust / g,       hover' = hover + (hover_seen - hover) dt / T,    hover_seen = throttle g / f

with f the specific force along the body's z axis that the velocity showed, over windows of 0.2 s, and the throttle as
it was a motor's lag before.
"""

from collections import Counter, deque
from math import cos
from typing import final

from nsde_torch.px4.flight.cascade import GRAVITY, levelling
from nsde_torch.px4.flight.controller import Demand
from nsde_torch.px4.link.telemetry import VehicleState
from nsde_torch.px4.link.vectors import Vec, cos_tilt, finite, rotate_back, tilt_of
from nsde_torch.px4.options import SetpointLimits

LAG, WINDOW, LEARNING = 0.07, 0.2, 1.5
"""From throttle to thrust, the window that the velocity is looked at over, and time constant of learning [s]."""
LOWEST, HIGHEST = 0.08, 0.85  # throttles that are accepted as one that hovers


@final
class Guard:
    """Checks demands; `counts` says how often what was bounded."""

    def __init__(self, limits: SetpointLimits) -> None:
        self.limits = limits
        self.counts: Counter[str] = Counter()

    def check(self, w: Vec, throttle: float, state: VehicleState | None) -> tuple[Vec, float] | None:
        """Rates and throttle as they may leave; None where they are not finite."""
        if not finite(*w, throttle):
            self.counts["not finite"] += 1
            return None
        m = self.limits
        x, y = (_bounded(v, m.rate) for v in w[:2])
        z = _bounded(w[2], m.yaw_rate)
        if (x, y, z) != w:
            self.counts["rate"] += 1
        low, high = m.throttle
        bounded = min(max(throttle, low), high)
        if bounded != throttle:
            self.counts["throttle"] += 1
        if state is not None and cos_tilt(state.q) < cos(m.tilt):
            self.counts["tilt"] += 1
            x, y, _ = levelling(state.q)
            x, y = _bounded(x, m.rate), _bounded(y, m.rate)
        return (x, y, z), bounded


def _bounded(value: float, most: float) -> float:
    return min(max(value, -most), most)


@final
class HoverThrottle:
    """Learns the throttle that carries the vehicle, in flight; `first` is the autopilot's own idea (MPC_THR_HOVER)."""

    def __init__(self, first: float) -> None:
        self.value = first
        self._sent: deque[tuple[float, float]] = deque()
        self._states: deque[VehicleState] = deque()

    def throttle(self, thrust: float) -> float:
        """Throttle for a thrust over mass [m/s2]."""
        return self.value * thrust / GRAVITY

    def thrust(self, throttle: float) -> float:
        """The inverse."""
        return throttle * GRAVITY / self.value

    def sent(self, time: float, throttle: float) -> None:
        """A throttle left at a time [s]."""
        self._sent.append((time, throttle))
        while self._sent and self._sent[0][0] < time - 1.0:
            self._sent.popleft()

    def seen(self, state: VehicleState, *, learn: bool) -> None:
        """A state came; `learn` only in the air, away from the ground."""
        self._states.append(state)
        while self._states and self._states[0].time < state.time - WINDOW - 0.02:
            self._states.popleft()
        first = self._states[0]
        span = state.time - first.time
        if not learn or span < 0.8 * WINDOW:
            return
        used = [u for t, u in self._sent if first.time - LAG <= t <= state.time - LAG]
        if tilt_of(state.q) > 35.0 or len(used) < 5:
            return
        a = tuple((n - o) / span for n, o in zip(state.v, first.v, strict=True))
        force = rotate_back(state.q, (a[0], a[1], a[2] + GRAVITY))[2]
        if force < 0.4 * GRAVITY:
            return
        wanted = sum(used) / len(used) * GRAVITY / force
        # states come far more often than windows end; each counts for its own share of the time
        share = min((state.time - self._states[-2].time) / LEARNING, 0.1)
        self.value = min(max(self.value + share * (wanted - self.value), LOWEST), HIGHEST)


def level(state: VehicleState | None, thrust: float = GRAVITY) -> Demand:
    """The demand that levels the vehicle, or without an attitude keeps it from turning."""
    return Demand(levelling(state.q) if state is not None else (0.0, 0.0, 0.0), thrust)
