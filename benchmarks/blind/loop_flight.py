"""Flights of the closed-loop cases: wanted paths, sensors, a cascade of controllers, and what is logged of them.

Paths are waypoints, circles, sums of sines, or a pilot's sticks: random tilts that a weak hold keeps about one place.
What is asked for from outside the loop is logged as `stick_roll`, `stick_pitch`, `stick_yaw`, `stick_thrust` [rad, rad,
rad/s, m/s2], functions of time alone. The setpoints of the rate loop, `setpoint_rate_x` ..., answer the state.

    v* = v_w + k_p (p_w - p),   a* = a_w + k_v (v* - v) + integral,   R* from a* + g and yaw
    omega* = -k_a vee(R*^T R - R^T R*) / 2,   alpha = k_r (omega* - omega) + integral,   u = mixer(a* . z, alpha)

Regimes, which say what the controller sees:

    a   the logged measurements, at 100 Hz
    b   other sensors, as good as those of the log, at 100 Hz
    c   other sensors, four times as good, and setpoints at 1 kHz; every tenth command is logged
    d   the outer loops as in a, and the rate loop on its own gyroscope at 1 kHz: each logged command is the first of
        ten, after a step of its setpoint, and larger than their mean (5 % where the rate loop closes at 11 rad/s)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from loop_machine import STEP, Array, Bodies, G, Machine, cross, product, rotation

LOG = 0.01
"""Step of the log [s]."""
REGIMES = ("a", "b", "c", "d")
PATHS = ("waypoints", "circle", "sines", "sticks")
SENSORS = np.array([0.002] * 3 + [0.015] * 3 + [np.radians(0.15)] * 3 + [0.015] * 3)
"""Noise of position [m], velocity [m/s], attitude [rad] and rate [rad/s], times the factor of the case."""
BETTER = 0.25
PAUSE_S = 15.0
"""Time between two flights on the clock [s]."""
STICKS = ("stick_roll", "stick_pitch", "stick_yaw", "stick_thrust")
RATES = ("setpoint_rate_x", "setpoint_rate_y", "setpoint_rate_z")


@dataclass(frozen=True)
class Flight:
    machine: Machine
    path: str  # one of `PATHS`
    regime: str  # one of `REGIMES`
    seconds: float  # its length [s]
    t0: float  # reading of the clock at its start [s]
    seed: int
    sensor_noise: float = 1.0  # factor on the noise of the log's sensors
    vigour: float = 1.0  # factor on accelerations that are asked for
    known: tuple[float, ...] = (1.0,) * 4  # how far the controller's thrust and gains are off, as factors
    log: float = LOG  # step of the log and of a controller that reads it [s], whole milliseconds


@dataclass(frozen=True)
class Logged:
    """What is logged of a flight: times (n,), measured states (n, 13), commands (n, motors), further columns (n,)."""

    t: Array
    x: Array
    u: Array
    extra: dict[str, Array]
    truth: Array = field(repr=False)


class Wanted(NamedTuple):
    """What is asked for, time first: position, velocity, acceleration (n, 3), yaw and its rate (n,), and the hold."""

    p: Array
    v: Array
    a: Array
    yaw: Array
    yaw_rate: Array
    hold: float


def wanted(flight: Flight) -> Wanted:
    """The path or the sticks of a flight, of its own random numbers."""
    rng = np.random.default_rng([flight.seed, 1])
    dt = flight.log
    t = dt * np.arange(round(flight.seconds / dt) + 1)
    size = flight.vigour
    height = 1.3
    yaw = _sines(t, rng, 3, (0.03, 0.25), 0.35 * size)
    yaw_rate = np.gradient(yaw, dt)
    if flight.path == "sticks":
        tilt = np.stack([_sines(t, rng, 8, (0.15, 1.6), 1.4 * size, flat=True) for _ in range(2)], 1)
        a = np.concatenate([tilt, _sines(t, rng, 6, (0.1, 1.0), 0.7 * size, flat=True)[:, None]], 1)
        return Wanted(np.tile([0.0, 0.0, height], (len(t), 1)), 0 * a, a, yaw, yaw_rate, 0.3)
    if flight.path == "waypoints":
        p = _waypoints(t, rng, size, dt) + np.array([0, 0, height])
    elif flight.path == "circle":
        speed, radius = rng.uniform(1.2, 2.4) * np.sqrt(size), rng.uniform(1.0, 2.0)
        phase = np.cumsum(speed / radius * (0.6 + 0.4 * np.sin(2 * np.pi * rng.uniform(0.1, 0.25) * t))) * dt
        heave = _sines(t, rng, 3, (0.1, 0.4), 0.3)
        east = radius * np.cos(phase) * rng.choice((-1, 1))
        p = np.stack([east, radius * np.sin(phase), height + heave], 1)
    else:
        p = np.stack([_sines(t, rng, 5, (0.08, 0.7), s) for s in (1.0 * size, 1.0 * size, 0.35)], 1)
        p[:, 2] += height
    p[:, 2] = np.maximum(p[:, 2], 0.3)
    v = np.gradient(p, dt, axis=0)
    return Wanted(p, v, np.gradient(v, dt, axis=0), yaw, yaw_rate, 1.0)


def _sines(
    t: Array, rng: np.random.Generator, count: int, band: tuple[float, float], rms: float, flat: bool = False
) -> Array:
    """A sum of sines with random frequencies [Hz], falling as 1 / f^2 (or flat)."""
    f = np.exp(rng.uniform(*np.log(band), size=count))
    size = rng.uniform(0.5, 1.0, count) * (1.0 if flat else (band[0] / f) ** 1.5)
    turn, phase = 2 * np.pi * f[:, None] * t, rng.uniform(0, 2 * np.pi, count)[:, None]
    out = (size[:, None] * np.sin(turn + phase)).sum(0)
    return np.asarray(out * rms / np.sqrt(0.5 * (size**2).sum()))


def _waypoints(t: Array, rng: np.random.Generator, size: float, dt: float) -> Array:
    """Steps to random places every one to three seconds, through four low-pass filters in a row."""
    out = np.zeros((len(t), 3))
    at = 0
    while at < len(t):
        n = int(rng.uniform(1.0, 3.0) / dt)
        out[at : at + n] = rng.uniform(-1, 1, 3) * [1.3 * size, 1.3 * size, 0.7]
        at += n
    return four_times(out, np.exp(-dt / 0.16))


def four_times(rows: Array, keep: float) -> Array:
    """Rows through four low-pass filters in a row, in place."""
    for _ in range(4):
        for k in range(1, len(rows)):
            rows[k] = keep * rows[k - 1] + (1 - keep) * rows[k]
    return rows


class _Noise:
    """White noise of each row from its own generator, drawn in pieces, so that rows do not depend on their batch."""

    def __init__(self, seeds: list[list[int]], width: int) -> None:
        self._rng = [np.random.default_rng(seed) for seed in seeds]
        self._width, self._k, self._piece = width, 0, np.empty((0, len(seeds), width))

    def __call__(self) -> Array:
        if self._k >= len(self._piece):
            self._piece = np.stack([r.standard_normal((1000, self._width)) for r in self._rng], axis=1)
            self._k = 0
        self._k += 1
        return np.asarray(self._piece[self._k - 1])


def measured(true: Array, noise: Array) -> Array:
    """Measured states (B, 13): the attitude is turned by a small rotation."""
    turn = np.concatenate([np.ones((len(noise), 1)), 0.5 * noise[:, 6:9]], 1)
    q = product(true[:, 6:10], turn / np.linalg.norm(turn, axis=1, keepdims=True))
    return np.concatenate([true[:, :6] + noise[:, :6], q, true[:, 10:] + noise[:, 9:]], 1)


class Cascade:
    """The controllers of all rows; integrals are their memory."""

    def __init__(self, flights: list[Flight], body: Bodies) -> None:
        n = len(flights)
        known = np.array([f.known for f in flights])
        mix = np.concatenate([body.there[:, None], body.signs], 1)  # (B, 4, motors)
        self.mixer = np.linalg.pinv(mix)
        self.thrust_gain = body.thrust_gain * known[:, 0]
        self.thrust_offset, self.gains = body.thrust_offset, body.gains * known[:, 1:]
        rng = [np.random.default_rng([f.seed, 2]) for f in flights]
        self.k = np.array([r.uniform(0.85, 1.15, 4) for r in rng]) * [0.9, 2.0, 5.0, 11.0]
        self.hold = np.array([wanted(f).hold for f in flights])[:, None]
        self.sum_v, self.sum_w = np.zeros((n, 3)), np.zeros((n, 3))
        self.frame, self.thrust, self.rate = np.tile(np.eye(3), (n, 1, 1)), np.full(n, G), np.zeros((n, 3))

    def outer(self, x: Array, w: tuple[Array, ...], dt: float) -> None:
        """Position, velocity and attitude: what the rate loop is asked for."""
        p, v, a, yaw, yaw_rate = w
        k = self.k
        off = np.clip(p - x[:, :3], -1.5, 1.5)
        error = v + k[:, :1] * self.hold * off - x[:, 3:6]
        self.sum_v = np.clip(self.sum_v + 0.5 * dt * self.hold * error, -2.0, 2.0)
        push = np.clip(a + self.hold * k[:, 1:2] * error + self.sum_v, -6.0, 6.0)
        push[:, 2] += G
        up = push / np.linalg.norm(push, axis=1, keepdims=True)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], 1)
        left = cross(up, ahead)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        aim = np.stack([cross(left, up), left, up], axis=2)
        now = rotation(x[:, 6:10])
        d = np.einsum("bji,bjk->bik", aim, now)
        d = d - d.transpose(0, 2, 1)
        turn = 0.5 * np.stack([d[:, 2, 1], d[:, 0, 2], d[:, 1, 0]], 1)
        rate = -k[:, 2:3] * turn * [1.0, 1.0, 0.5]
        rate[:, 2] += yaw_rate
        self.rate = np.clip(rate, -5.0, 5.0)
        self.thrust = (push * now[:, :, 2]).sum(1)

    def inner(self, w: Array, dt: float) -> Array:
        """Rates: commands (B, motors)."""
        error = self.rate - w
        self.sum_w = np.clip(self.sum_w + 4.0 * dt * error, -4.0, 4.0)
        turn = (self.k[:, 3:] * error * [1.0, 1.0, 0.4] + self.sum_w) / self.gains
        ask = np.concatenate([((self.thrust - self.thrust_offset) / self.thrust_gain)[:, None], turn], 1)
        return np.clip(np.einsum("bij,bj->bi", self.mixer, ask), 0.0, 1.0)


def fly(flights: list[Flight], bodies: type[Bodies] = Bodies) -> list[Logged]:
    """Fly flights of one regime at once, of machines, paths and lengths of their own.

    Nothing that is logged of one depends on the other flights of the batch.
    """
    regime = flights[0].regime
    dt = flights[0].log
    if any((f.regime, f.log) != (regime, dt) for f in flights):
        raise ValueError(
            "`flights` must be of one regime and logged at one rate; fly those of each by themselves."
        )
    ticks = round(dt / STEP)
    paths = [wanted(f) for f in flights]
    n = [len(path.yaw) for path in paths]
    asked = [_stacked(part, max(n)) for part in list(zip(*paths, strict=True))[:-1]]
    gust = _Noise([[f.seed, 3] for f in flights], 6)
    body = bodies([f.machine for f in flights], np.array([f.t0 for f in flights]), gust)
    body.p, body.v = asked[0][0].copy(), asked[1][0].copy()
    half = 0.5 * asked[3][0]
    body.q = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)
    controller = Cascade(flights, body)
    log_noise, own_noise = (_Noise([[f.seed, part] for f in flights], 12) for part in (4, 5))
    std = SENSORS * np.array([f.sensor_noise for f in flights])[:, None]
    own = std * (BETTER if regime in "cd" else 1.0)
    used = np.array([f.t0 / 320.0 for f in flights])
    rows: list[tuple[Array, ...]] = []
    for k in range(max(n)):
        u = np.empty(0)
        for tick in range(ticks):
            # what a controller at 1 kHz is asked for moves between rows too
            ahead = tick / ticks if regime == "c" and k + 1 < max(n) else 0.0
            now = tuple(part[k] + ahead * (part[min(k + 1, max(n) - 1)] - part[k]) for part in asked)
            fast, true = regime in "cd", np.concatenate([body.p, body.v, body.q, body.w], 1)
            logged = measured(true, std * log_noise()) if tick == 0 else None
            other = measured(true, own * own_noise()) if fast or (tick == 0 and regime == "b") else None
            if tick == 0 or regime == "c":
                seen = logged if regime in "ad" else other
                assert seen is not None
                controller.outer(seen, now, STEP if regime == "c" else dt)
            if tick == 0 or fast:
                seen = other if other is not None else logged
                assert seen is not None
                u = controller.inner(seen[:, 10:], STEP if fast else dt)
            if tick == 0:
                load = (u * body.there).sum(1) / body.there.sum(1)
                body.voltage = 16.7 - 2.4 * used - 0.9 * load
                used = used + load * dt / (0.4 * 320.0)
                assert logged is not None
                rows.append((logged, u.copy(), controller.rate.copy(), body.voltage.copy(), true))
            body.advance(u)
    x, u, rate, voltage, true = (np.stack(part) for part in zip(*rows, strict=True))
    out = []
    for b, flight in enumerate(flights):
        m, motors = n[b], int(body.there[b].sum())
        columns = (*sticks(paths[b]).T, *rate[:m, b].T, voltage[:m, b])
        extra = dict(zip((*STICKS, *RATES, "battery_voltage"), columns, strict=True))
        out.append(Logged(flight.t0 + dt * np.arange(m), x[:m, b], u[:m, b, :motors], extra, true[:m, b]))
    return out


def sticks(path: Wanted) -> Array:
    """What is asked for from outside as sticks (n, 4): roll, pitch [rad], yaw rate [rad/s], climb [m/s2]."""
    c, s = np.cos(path.yaw), np.sin(path.yaw)
    ahead, left = c * path.a[:, 0] + s * path.a[:, 1], c * path.a[:, 1] - s * path.a[:, 0]
    return np.stack([-np.arctan2(left, G), np.arctan2(ahead, G), path.yaw_rate, path.a[:, 2]], 1)


def _stacked(rows: Sequence[Array], n: int) -> Array:
    """A part of all paths (n, B, ...), the last row held."""
    return np.stack([np.concatenate([r, np.repeat(r[-1:], n - len(r), axis=0)]) for r in rows], axis=1)


def several(
    machine: Machine,
    rng: Any,
    regime: str,
    seed: int,
    count: int,
    seconds: Callable[[], float],
    log: float = LOG,
) -> list[Flight]:
    """Flights of a machine with pauses between them: no two paths alike, noise, vigour and gains known drawn."""
    paths = [PATHS[i] for i in rng.permutation(len(PATHS))]
    noise, vigour = float(rng.uniform(0.7, 1.4)), float(rng.uniform(0.9, 1.4))
    known = tuple(float(v) for v in rng.uniform(0.9, 1.1, 4))
    out, t0 = [], 0.0
    for k in range(count):
        length = seconds()
        out.append(Flight(machine, paths[k], regime, length, t0, seed + k, noise, vigour, known, log))
        t0 = round(t0 + length + PAUSE_S, 2)
    return out
