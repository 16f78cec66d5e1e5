"""Manual flights: a pilot's wishes, flown by a cascade on a plant, logged as an autopilot logs them.

The pilot flies many variants at once (a batch costs little more than one); the variant whose figures are
nearest to the supplement's Figure 15 is the one that is kept. Where the nearest is still far, the aim is
moved by what flying added to or took from the wanted figures, and all is flown once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np
import torch
from scipy.fft import next_fast_len
from scipy.ndimage import gaussian_filter1d

from nsde_torch.arrays import Array
from nsde_torch.control.cascade import Cascade
from nsde_torch.data.quaternion import euler_zyx
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.battery import battery_column, battery_of
from nsde_torch.simulation.make import Making, noise_generator, simulated_run
from nsde_torch.systems import Multirotor
from nsde_torch.systems.machines import make_plant_system

# What a pilot wants: smooth random flights whose envelope is that of the supplement's Figure 15.
#
# Each horizontal axis is a slow wander through the room, with quick and quicker corrections on top that come
# and go,
#
#     slow:   p(t) = A e(t) / w(t)^2 sin(phi(t)),   phi' = w,   e = exp(s n(t) - s^2 / 2)
#     quick:  a(t) = A g(t) (e(t) sin(phi) + tremor),   0 < g < 1, integrated twice above 0.12 Hz
#
# with n smooth noise: A is the size of the accelerations and s how uneven they are, which sets apart the 95 %
# quantile and the maximum; a negative s bounds them instead (tanh). Height wanders about 1.4 m; heading
# wanders and, once in a data set, turns far. The sizes are found from the figures: level flight ties roll and
# pitch to acceleration (thrust along a + g + drag), so that they can be read off the wanted path without
# flying it.
#
# Frequencies (slow 0.15 Hz, quick 0.5 Hz) are about those at which velocity and tilt of the published flights
# have half their power.

TARGETS = (1.71, 2.7, 18.0, 23.0, 13.0, 23.0, 24.0, 80.0)
"""95 % quantile and maximum of speed [m/s] and of |roll|, |pitch|, |yaw| [deg] (supplement, Figure 15)."""

SLOW_HZ, QUICK_HZ, TREMOR_HZ = 0.15, 0.5, 1.0
TREMOR = 0.15  # size of the quickest corrections relative to the quick ones
TRIM_S = 4.0  # time in which the pilot lifts off to, and comes down from, the height of the flight [s]
LOW, HEIGHT = 0.4, 1.4  # heights at both ends and of the flight [m]
SHORTEST_S = 2.0
DRAG = 0.15  # of the machines, along x and y of the body [1/s]


START = np.array([0.8, 0.4, 1.2, 1.8, 0.3, 0.1, 0.15, 1.2])
"""Sizes of the pilot's inputs (8,) from which others are sought.

Acceleration of the slow wander [m/s2] and how uneven it is; of the quick corrections along x and y [m/s2], and how
uneven these are (negative: how tightly bounded); wander of the heading, and the one far turn [rad].
"""
LEAST = np.array([0.05, 0.0, 0.1, 0.1, -1.0, -1.0, 0.01, 0.1])
MOST = np.array([2.5, 1.4, 5.0, 5.0, 1.0, 1.0, 0.5, 2.0])


@dataclass(frozen=True)
class Path:
    """What the pilot wants of one run, sample by sample; heading and its rate in rad and rad/s."""

    p: Array
    v: Array
    a: Array
    yaw: Array
    yaw_rate: Array


def _smooth(rng: np.random.Generator, n: int, time: float, dt: float) -> Array:
    """Smooth Gaussian noise (n,) of unit variance with the correlation time `time` [s]."""
    width = time / dt
    pad = int(4 * width) + 1
    rough = gaussian_filter1d(rng.standard_normal(n + 2 * pad), width, mode="constant")[pad : pad + n]
    return np.asarray(rough * np.sqrt(2.0 * np.sqrt(pi) * width))


def _ramp(n: int, dt: float) -> Array:
    """From 0 to 1 and back, smooth to the second derivative, over `TRIM_S` at both ends."""
    trim = min(TRIM_S, 0.35 * n * dt)
    t = dt * np.arange(n)
    s = np.clip(np.minimum(t, t[-1] - t) / trim, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s * s))


def _wave(rng: np.random.Generator, n: int, hertz: float, dt: float) -> tuple[Array, Array, Array]:
    w = 2.0 * pi * hertz * np.exp(0.2 * _smooth(rng, n, 1.5 / hertz, dt))
    phase = rng.uniform(0.0, 2.0 * pi) + np.cumsum(w) * dt
    # bounded smoothly: a kink would be a jump of the acceleration
    return np.sin(phase), w, 2.5 * np.tanh(_smooth(rng, n, 1.2 / hertz, dt) / 2.5)


def _uneven(noise: Array, spread: float) -> Array:
    """Envelope exp(s n - s^2 / 2); 1 for s <= 0."""
    return np.asarray(np.exp(spread * noise - 0.5 * spread**2)) if spread > 0 else np.ones_like(noise)


def _twice_integrated(a: Array, dt: float) -> Array:
    """Positions (n,) of accelerations (n,) without what is slower than about 0.12 Hz, which would drift."""
    padded = next_fast_len(len(a) + round(20.0 / dt))
    f2 = np.fft.rfftfreq(padded, dt) ** 2
    # -1 / (2 pi f)^2 times (f^2 / (f^2 + f0^2))^2, written so that f = 0 needs no care
    filtered = np.fft.rfft(a, padded) * (-f2 / (f2 + 0.12**2) ** 2 / (4.0 * pi**2))
    return np.asarray(np.fft.irfft(filtered, padded)[: len(a)])


def _wish(rng: np.random.Generator, n: int, dt: float, *, turns: bool) -> Callable[[Array], Path]:
    """What the pilot wants of one run by the sizes (8,); noises and phases are drawn once, while sizes are found."""
    slow, quick, tremor = (
        [_wave(rng, n, hertz, dt) for _ in range(2)] for hertz in (SLOW_HZ, QUICK_HZ, TREMOR_HZ)
    )
    # x, y: how much the quick corrections are at work
    active = [0.5 + 0.5 * np.tanh(2.0 * _smooth(rng, n, 1.5, dt) + 1.0) for _ in range(2)]
    height = 0.8 * np.tanh(0.5 * _smooth(rng, n, 0.8, dt))
    # headings are held for a while: soft rounding to multiples of 2/3 of the standard deviation
    rough = 1.5 * _smooth(rng, n, 2.0, dt)
    heading = (rough - 0.85 / (2.0 * pi) * np.sin(2.0 * pi * rough)) / 1.5
    t = dt * np.arange(n)
    at, sign = rng.uniform(0.3, 0.7) * n * dt, rng.choice((-1.0, 1.0))
    width = min(2.0, 0.06 * n * dt)
    far = sign * np.exp(-0.5 * ((t - at) / width) ** 4) if turns else np.zeros(n)
    ramp = _ramp(n, dt)

    def path(sizes: Array) -> Path:
        size_of_slow, slow_spread, *by_axis, wander, turn = sizes.tolist()
        p = np.empty((n, 3))
        for k in range(2):
            sine, w, noise = slow[k]
            p[:, k] = size_of_slow * _uneven(noise, slow_spread) / (w * w) * sine
            size, spread = by_axis[k], by_axis[2 + k]
            push = quick[k][0] * _uneven(quick[k][2], spread) + TREMOR * tremor[k][0]
            if spread < 0:
                push = np.tanh(-3.0 * spread * push) / np.tanh(-3.0 * spread)
            p[:, k] += _twice_integrated(size * ramp * active[k] * push, dt)
        p[:, :2] *= ramp[:, None]
        p[:, 2] = LOW + ramp * (HEIGHT - LOW + height)
        # the wander makes room for the far turn, so that the turn alone sets the largest heading
        yaw = ramp * wander * heading * (1.0 - np.abs(far)) + turn * far
        p, yaw = gaussian_filter1d(p, 0.08 / dt, axis=0), gaussian_filter1d(yaw, 0.08 / dt)
        v = np.gradient(p, dt, axis=0)
        return Path(p, v, np.gradient(v, dt, axis=0), yaw, np.gradient(yaw, dt))

    return path


def attained(path: Path) -> Array:
    """Speed [m/s] and |roll|, |pitch|, |yaw| [deg] of flying a path exactly, (4, n)."""
    force = path.a + DRAG * path.v * np.array([1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 9.81])
    c, s = np.cos(path.yaw), np.sin(path.yaw)
    fx, fy = c * force[:, 0] + s * force[:, 1], c * force[:, 1] - s * force[:, 0]
    pitch, roll = np.arctan2(fx, force[:, 2]), np.arctan2(-fy, np.hypot(fx, force[:, 2]))
    speed = np.linalg.norm(path.v, axis=1)
    return np.stack([speed, *np.degrees(np.abs([roll, pitch, path.yaw]))])


def figures(values: Array) -> Array:
    """95 % quantiles and maxima of rows (4, n), in the order of `TARGETS` (8,)."""
    return np.stack([np.quantile(values, 0.95, axis=1), values.max(axis=1)], axis=1).reshape(-1)


class Pilot:
    """The pilot of one data set, of runs of some lengths [s]; ConfigError where there is none, or one too short."""

    def __init__(self, durations: Sequence[float], *, dt: float, seed: int) -> None:
        if not durations or min(durations) < SHORTEST_S:
            raise ConfigError(
                f"`durations` of flights must be one or more times of {SHORTEST_S:g} s or longer; "
                f"got {list(durations)}."
            )
        self.targets = np.array(TARGETS)
        self.rows = [round(d / dt) + 1 for d in durations]
        rng = np.random.default_rng([seed, 1])
        turning = int(rng.integers(len(durations)))
        self._wishes = [_wish(rng, n, dt, turns=k == turning) for k, n in enumerate(self.rows)]
        self._rng = rng

    def paths(self, sizes: Array) -> list[Path]:
        """What the pilot wants of each run with inputs of these sizes (8,)."""
        return [wish(sizes) for wish in self._wishes]

    def rehearse(self, sizes: Array, aim: Array) -> Array:
        """Sizes for which the wanted paths have the figures `aim` (8,), by fixed-point iteration from these.

        Figures that the random part cannot reach are left as near as the bounds of the sizes allow.
        """
        for k in range(40):
            now = figures(np.concatenate([attained(path) for path in self.paths(sizes)], axis=1))
            rate = 0.7 if k < 20 else 0.35
            speed, roll, pitch, yaw = (aim[0::2] / now[0::2]) ** rate
            uneven, by_roll, by_pitch, _ = (
                rate * 0.7 * np.log((aim[1::2] / aim[0::2]) / (now[1::2] / now[0::2]))
            )
            factors = np.array([speed**1.3, 1.0, pitch, roll, 1.0, 1.0, yaw, (aim[7] / now[7]) ** rate])
            shift = np.array([0.0, uneven, 0.0, 0.0, by_pitch, by_roll, 0.0, 0.0])
            sizes = np.clip(sizes * factors + shift, LEAST, MOST)
        return sizes

    def variants(self, sizes: Array, count: int, spread: float) -> list[Array]:
        """The sizes themselves and `count` - 1 others near them."""
        scale = np.array([1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.6])
        shift = np.array([0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
        draws = spread * self._rng.uniform(-1.0, 1.0, (count - 1, 8))
        return [sizes, *(sizes * np.exp(scale * d) + shift * d for d in draws)]


DURATIONS = (73.0, 66.0, 64.0)  # lengths of the flights of the supplement [s]
RESPONSE = (1.07, 1.06, 1.36, 1.36, 1.27, 1.33, 1.02, 1.03)
"""Figures flown over figures wanted, measured on the default plants (the loops overshoot)."""
VARIANTS = 48
NEAR = 0.07  # largest relative departure from the figures with which a flight is kept at once
ROUNDS = 2
ROOM, FLOOR = 4.0, 0.2
"""Flights stay within this distance of the middle of the room and above this height [m]."""


@dataclass(frozen=True)
class Flown:
    """Flights, time first; rows of a batch in between where there are several."""

    x: Array  # measured states (n, ..., 13)
    u: Array  # commands given at them (n, ..., nu)
    voltage: Array  # of the battery (n, ..., 1), or (n, ..., 0) where none is logged
    z: Array
    """True states with the memory of the effects (n, ..., nz), or (n, ..., 0) where they are not kept."""

    def one(self, rows: int, index: int) -> Flown:
        """The first rows of one flight of a batch, copied."""
        return Flown(*(a[:rows, index].copy() for a in (self.x, self.u, self.voltage, self.z)))


def fly(
    name: str,
    paths: Sequence[Path],
    *,
    generator: torch.Generator,
    making: Making = Making(),
    durations: Sequence[float] = (),
    keep_truth: bool = False,
) -> Flown:
    """Fly wanted paths of a multirotor at once (n, B, ...), with its battery's voltage; shorter ones hold their end.

    `durations` are lengths of the runs that take turns on one battery [s]; row i is run i modulo their number. With
    `keep_truth`, true states are kept too. A NonFiniteError where the flight left the finite numbers.
    """
    plant = making.plant(name, generator=generator)
    logged = battery_of(plant, making, durations or [len(paths[0].p) * plant.dt], rows=len(paths))
    pilot_knows = make_plant_system(name, declared_only=True)
    assert isinstance(pilot_knows, Multirotor)
    cascade = Cascade(pilot_knows, dt=plant.dt, device=generator.device)
    n = max(len(path.p) for path in paths)

    def stacked(part: str) -> torch.Tensor:
        """One part of all paths, (n, B, ...), the last row held."""
        rows = [getattr(path, part) for path in paths]
        held = [np.concatenate([r, np.repeat(r[-1:], n - len(r), axis=0)]) for r in rows]
        return torch.as_tensor(np.stack(held, axis=1), device=generator.device)

    p, v, a, yaw, yaw_rate = (stacked(part) for part in ("p", "v", "a", "yaw", "yaw_rate"))
    start = p.new_zeros(len(paths), 13)
    start[:, :3], start[:, 3:6] = p[0], v[0]
    start[:, 6], start[:, 9] = torch.cos(0.5 * yaw[0]), torch.sin(0.5 * yaw[0])
    hover = cascade.hover(len(paths))
    x = plant.reset(start, logged.seen_by(plant, hover, logged.voltage(hover)))
    states, commands, voltages, truths = [], [], [], []
    for k in range(n):
        u = cascade(x, p[k], v[k], a[k], yaw[k], yaw_rate[k])
        voltage = logged.voltage(u)
        states.append(x)
        commands.append(u)
        voltages.append(voltage)
        truths.append(plant.whole_state if keep_truth else x[:, :0])
        if k + 1 < n:
            x = plant.step(logged.seen_by(plant, u, voltage))
            logged.use(u)
    parts = (states, commands, voltages, truths)
    return Flown(*(np.asarray(torch.stack(rows).cpu().numpy(), dtype=np.float64) for rows in parts))


def flown(x: Array) -> Array:
    """Speed [m/s] and |roll|, |pitch|, |yaw| [deg] of states (n, 13), as (4, n)."""
    angles = np.degrees(np.abs(euler_zyx(x[:, 6:10]))).T
    return np.concatenate([np.linalg.norm(x[:, 3:6], axis=1)[None], angles])


def _choose(takes: Sequence[Sequence[Array]], targets: Array) -> tuple[float, list[int]]:
    """For each run one of its takes (n, 13), so that all together come nearest to the figures (8,): the departure left,
    and the index of each run's take; infinite where a run has no take in the room."""

    def inside(x: Array) -> bool:
        return bool(np.abs(x[:, :3]).max() < ROOM and x[:, 2].min() > FLOOR)

    values = [[flown(x) if inside(x) else None for x in run] for run in takes]
    common = [k for k in range(len(takes[0])) if all(run[k] is not None for run in values)]
    free = [[k for k, v in enumerate(run) if v is not None] for run in values]
    if not all(free):
        return float("inf"), []

    def miss(choice: Sequence[int]) -> float:
        """Largest relative departure (log) from the figures of runs (4, n_i) together."""
        runs = [v for run, k in zip(values, choice, strict=True) if (v := run[k]) is not None]
        return float(np.abs(np.log(figures(np.concatenate(runs, axis=1)) / targets)).max())

    starts = [[k] * len(takes) for k in common] or [[run[0] for run in free]]
    best = min(starts, key=miss)
    left = miss(best)
    for i in [*range(len(takes))] * 2:  # one run after another takes its best, twice
        for k in free[i]:
            trial = [*best[:i], k, *best[i + 1 :]]
            if (now := miss(trial)) < left:
                best, left = trial, now
    return left, best


def chosen_flights(
    name: str,
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    making: Making = Making(),
    variants: int = VARIANTS,
    rounds: int = ROUNDS,
    keep_truth: bool = False,
) -> list[Flown]:
    """Flights by hand whose envelope, over all of them, is that of the supplement's Figure 15.

    Of a `hexacopter` or `quadrotor`, with lengths [s] (default: the supplement's three). Of fewer `variants` to choose
    from, and of much shorter flights, they meet the figures less well; `rounds` is how often the aim may be moved at
    most. With `keep_truth`, true states are kept too. A ConfigError where a system or effect is unknown, a number out
    of range, or the cascade cannot fly with these effects.
    """
    if min(variants, rounds) < 1:
        raise ConfigError(f"`variants` and `rounds` must be 1 or more; got {variants!r} and {rounds!r}.")
    dt = making.sample(name)
    lengths = DURATIONS if durations is None else tuple(durations)
    pilot = Pilot(lengths, dt=dt, seed=seed)
    generator = noise_generator(seed, 2)
    aim, sizes = pilot.targets / np.array(RESPONSE), START
    best: tuple[float, list[Flown]] = (float("inf"), [])
    for _ in range(rounds):
        sizes = pilot.rehearse(sizes, aim)
        tried = pilot.variants(sizes, variants, 0.1)
        paths = [path for variant in tried for path in pilot.paths(variant)]
        made = fly(name, paths, generator=generator, making=making, durations=lengths, keep_truth=keep_truth)
        x, count = made.x, len(pilot.rows)
        takes = [[x[:n, k * count + i] for k in range(len(tried))] for i, n in enumerate(pilot.rows)]
        miss, choice = _choose(takes, pilot.targets)
        if miss < best[0]:
            rows = [k * count + i for i, k in enumerate(choice)]
            best = (miss, [made.one(n, r) for n, r in zip(pilot.rows, rows, strict=True)])
        if best[0] < NEAR:
            break
        got = figures(np.concatenate([flown(x[:n, i]) for i, n in enumerate(pilot.rows)], axis=1))
        aim = np.clip(aim * pilot.targets / got, 0.4 * pilot.targets, 1.7 * pilot.targets)
    if not best[1]:
        raise ConfigError(
            f"no flight of the {name} stayed in its room of {2 * ROOM:g} m and above {FLOOR:g} m: `effects` "
            "or `process_noise` are too strong for the pilot. Make them weaker, or the flights shorter."
        )
    return best[1]


def manual_flights(name: str, *, making: Making = Making(), **options: Any) -> list[RawRun]:
    """Flights by hand, at 100 Hz (or on the step of `making`): measured states, commands in [0, 1].

    Arguments and errors are those of `chosen_flights`.
    """
    flights = chosen_flights(name, making=making, **options)
    dt, digits = making.sample(name), len(str(len(flights) - 1))
    return [
        simulated_run(f"flight_{i:0{digits}d}", dt, flight.x, flight.u, battery_column(flight.voltage))
        for i, flight in enumerate(flights)
    ]
