"""Flights of a closed loop: minimum-snap paths through points at even times, at rest at both ends.

The genes of a flight are its points and headings, in [0, 1] of the room that the limits leave. What flies it is a
cascade of proportional loops (`control.cascade`). The plan that is written is the list of the points, which
`reference=csv` of `nsde track` and `nsde fly` reads as the same path.

With some of what runs leave open of gains that feedback hides, that cascade loses the machine; but the runs there are
were flown. So a step of the place is flown with each draw, and draws that do not come near are not taken (`flyable`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.control.cascade import Cascade
from nsde_torch.design.limits import ExperimentLimits
from nsde_torch.design.members import Drive, Member, Rollouts
from nsde_torch.systems import Multirotor

GAP = 1.0  # time between points [s]
SPEEDS = (0.5, 1.0, 1.5, 2.0, 3.0)  # of the lemniscates that are flown beside a plan [m/s]
SIDE, UP = 6.0, 4.0  # largest acceleration of a path sideways (a tilt of about 31 deg) and up or down [m/s2]
_ROOM = 0.8  # share of the room that points may lie in: paths and flights overshoot them
_ACCELERATION = 4.5  # largest horizontal acceleration of a first proposal [m/s2]
_TURN = np.pi / 2


def point_times(duration: float) -> Array:
    """Times of the points of a flight (K,) [s]."""
    return np.linspace(0.0, duration, max(round(duration / GAP), 4) + 1)


@dataclass(frozen=True)
class Paths:
    """Flights of one length within limits."""

    limits: ExperimentLimits  # limits, of which positions make the room
    dt: float  # step of the log [s]
    steps: int
    start: Array

    @cached_property
    def times(self) -> Array:
        """Of the points (K,) [s]."""
        return point_times(self.steps * self.dt)

    @cached_property
    def _box(self) -> tuple[Array, Array]:
        """Middle and half of the room of points (3,)."""
        floor, ceiling = self.limits.floor[:3], self.limits.ceiling[:3]
        return 0.5 * (floor + ceiling), 0.5 * _ROOM * (ceiling - floor)

    def random(self, count: int, rng: np.random.Generator) -> Array:
        """Genes (count, K, 4): one or two sines on some of the axes, now and then held."""
        t, (_, half) = self.times, self._box
        out = np.full((count, len(t), 4), 0.5)
        for g in out:
            axes = rng.uniform(size=4) < rng.choice([0.4, 0.7, 1.0])
            axes[rng.integers(3)] = True
            for axis in np.flatnonzero(axes):
                for _ in range(rng.integers(1, 3)):
                    f = np.exp(rng.uniform(np.log(1.0 / t[-1]), np.log(0.4)))
                    most = half[axis] if axis < 3 else 1.0
                    size = min(1.0, _ACCELERATION / (2 * np.pi * f) ** 2 / max(most, 1e-9))
                    size = 0.5 * size * rng.uniform(0.2, 1.0)
                    g[:, axis] += size * np.sin(2 * np.pi * (f * t + rng.uniform()))
            if rng.uniform() < 0.3:  # hold a place for a while
                a, b = sorted(rng.integers(len(t), size=2))
                g[a:b] = g[a]
        return np.clip(out, 0.0, 1.0)

    def gentle(self, count: int, rng: np.random.Generator) -> Array:
        """Genes of flights that hardly leave their place (count, K, 4)."""
        sizes = np.geomspace(0.02, 0.5, count)[:, None, None]
        middle, half = self._box
        here = np.append(0.5 + 0.5 * (self.start[:3] - middle) / half, 0.5)
        return np.asarray(here + sizes * (self.random(count, rng) - 0.5))

    def mutated(self, genes: Array, rng: np.random.Generator) -> Array:
        """Genes near others (count, K, 4)."""
        t, fresh = self.times, self.random(len(genes), rng)
        out = genes.copy()
        for g, other in zip(out, fresh, strict=True):
            kind = rng.integers(4)
            if kind == 0:  # more or less of one axis
                axis = rng.integers(4)
                g[:, axis] = 0.5 + (g[:, axis] - 0.5) * rng.choice([0.0, 0.6, 0.8, 1.2, 1.5])
            elif kind == 1:  # something added
                g += rng.choice([0.1, 0.3, 0.6]) * (other - 0.5)
            elif kind == 2:  # a bump
                width = rng.uniform(0.5, 2.0)
                bump = np.exp(-0.5 * ((t - rng.uniform(0, t[-1])) / width) ** 2)
                g[:, rng.integers(4)] += rng.uniform(-0.4, 0.4) * bump
            else:  # one axis of another flight
                axis = rng.integers(4)
                g[:, axis] = other[:, axis]
        return np.clip(out, 0.0, 1.0)

    def shrunk(self, genes: Array, shares: Array) -> Array:
        """Genes of the same flights with shares (count,) of their distances (count, K, 4)."""
        return np.asarray(0.5 + shares[:, None, None] * (genes - 0.5))

    def points(self, genes: Array) -> Array:
        """Points and headings (..., K, 4) [m, rad], the first where the experiment begins."""
        middle, half = self._box
        places, headings = middle + half * (2 * genes[..., :3] - 1), _TURN * (2 * genes[..., 3:] - 1)
        out = np.concatenate((places, headings), axis=-1)
        out[..., 0, :] = np.append(self.start[:3], 0.0)
        return np.asarray(out)

    def inputs(self, genes: Array) -> Array:
        """Tables (count, steps, 11) of genes."""
        return self.through(self.points(genes))

    def through(self, points: Array) -> Array:
        """Wanted positions, velocities, accelerations (3 each), heading and its rate (count, steps, 11) of points."""
        count = len(points)
        flat = np.moveaxis(points, 1, 0).reshape(len(self.times), -1)
        rest = [(order, np.zeros(flat.shape[1])) for order in (1, 2, 3)]
        spline = make_interp_spline(self.times, flat, k=7, bc_type=(rest, rest))
        t = self.dt * np.arange(self.steps, dtype=np.float64)
        p, v, a = (spline(t, order).reshape(self.steps, count, 4).swapaxes(0, 1) for order in (0, 1, 2))
        # a path is linear in its points: what asks for too much tilt or thrust becomes smaller
        side, up = np.linalg.norm(a[..., :2], axis=-1).max(1), np.abs(a[..., 2]).max(1)
        share = np.minimum(1.0, np.minimum(SIDE / np.maximum(side, 1e-9), UP / np.maximum(up, 1e-9)))
        share, first = share[:, None, None], p[:, :1]
        p, v, a = first + share * (p - first), share * v, share * a
        return np.concatenate((p[..., :3], v[..., :3], a[..., :3], p[..., 3:], v[..., 3:]), axis=-1)

    def words(self, genes: Array) -> list[str]:
        """What a person reads of the genes (K, 4) of one flight."""
        table = self.inputs(genes[None])[0]
        speed = np.linalg.norm(table[:, 3:6], axis=1)
        side = np.linalg.norm(table[:, 6:8], axis=1).max()
        spans = np.ptp(table[:, :3], axis=0)
        return [
            f"{len(self.times)} points, {self.times[1]:.3g} s apart (plan.csv), through {spans[0]:.2g} x "
            f"{spans[1]:.2g} x {spans[2]:.2g} m; heading over {np.degrees(np.ptp(table[:, 9])):.0f} deg; "
            f"speed up to {speed.max():.2g} m/s, {speed.mean():.2g} m/s in the mean; "
            f"acceleration sideways up to {side:.2g} m/s2"
        ]

    def baselines(self, rng: np.random.Generator, before: Array) -> dict[str, tuple[Array, tuple[str, ...]]]:
        """Usual flights (sizes, steps, 11), with words; `before` are positions (n, 3) of a run, flown again."""
        t, (middle, half) = self.times, self._box
        eight = []
        for speed in SPEEDS:
            turns = speed * t[-1] / (2 * np.pi * half[:2].max() * 0.9)
            s = 2 * np.pi * turns * t / t[-1]
            eight.append(self._around(np.stack((np.sin(s), 0.5 * np.sin(2 * s), 0.0 * s), 1)))
        sines = np.zeros((len(t), 3))
        for axis in range(3):
            for f in np.geomspace(1.0 / t[-1], 0.35, 5):
                sines[:, axis] += np.sin(2 * np.pi * (f * t + rng.uniform())) / (1.0 + (f / 0.1) ** 2)
        sines /= np.abs(sines).max(0)
        steps = np.zeros((len(t), 3))
        for k in range(1, len(t) - 1):
            steps[k, (k // 4) % 3] = (0.0, 1.0, 0.0, -1.0)[k % 4]
        sizes = (1.0, 0.6, 0.3)
        rows = np.minimum((t / self.dt).round().astype(int), len(before) - 1)
        again = np.concatenate((before[rows], np.zeros((len(t), 1))), 1)[None]
        again = np.clip(again, np.append(middle - half / _ROOM, 0), np.append(middle + half / _ROOM, 0))
        waves = {
            "lemniscate": (np.stack(eight), "a lemniscate of 0.5 to 3 m/s, the best of them"),
            "multisine": (np.stack([self._around(s * sines) for s in sizes]), "sums of 5 sines on each axis"),
            "doublets": (
                np.stack([self._around(s * steps) for s in sizes]),
                "to and fro on one axis after another",
            ),
            "the longest run again": (again, "the places of the longest run, every second"),
        }
        return {name: (self.through(points), (told,)) for name, (points, told) in waves.items()}

    def _around(self, unit: Array) -> Array:
        """Points (K, 4) in [-1, 1] of the room about the start, with an unmoved heading."""
        middle, half = self._box
        room = np.minimum(self.start[:3] - (middle - half), (middle + half) - self.start[:3]).clip(min=0.0)
        return np.concatenate((self.start[:3] + room * unit, np.zeros((len(unit), 1))), 1)


def flown_paths(tables: Array, *, system: Multirotor, dt: float) -> Drive:
    """Inputs of a cascade that flies paths (B, N, 11) in steps of `dt` [s], knowing the declared physics alone."""
    rows, cascade = torch.as_tensor(tables), Cascade(system, dt=dt)

    def drive(k: int, measured: Tensor) -> Tensor:
        p, v, a, yaw = rows[:, k].split((3, 3, 3, 2), 1)
        return cascade(measured, p, v, a, yaw[:, 0], yaw[:, 1])

    return drive


Draw = Callable[[Member, int, np.random.Generator], Array]
"""Draws parameters of a member (count, k), the fitted ones first."""

STEP = np.array([0.3, 0.3, 0.2])  # step of the wanted place [m]
_TIME = 3.0
_NEAR, _MORE = 0.15, 1.5
"""Distance that must be left after that time [m], or times as much as with the fitted parameters."""
_TRIES = 4


def flyable(
    member: Member, count: int, rng: np.random.Generator, *, start: Array, drive: Callable[[Array], Drive]
) -> Array:
    """Parameters (count, k) with which a cascade holds the machine, the fitted ones first.

    These again where too few others can be flown. From a state (nx,) that hovers; `drive` makes inputs of tables
    (B, N, 11).
    """
    draws, dt = member.draws(_TRIES * count, rng), member.log.dt
    table = np.zeros((len(draws), round(_TIME / dt), 11))
    table[..., :3] = start[:3] + STEP
    begun = np.tile(start, (len(draws), 1))
    states, _, _ = Rollouts(member.system, dt=dt).run(draws, begun, drive(table), table.shape[1])
    left = np.linalg.norm(states[:, -1, :3] - table[:, -1, :3], axis=1)
    near = np.isfinite(states).all((1, 2)) & (left <= max(_NEAR, _MORE * float(np.nan_to_num(left[0]))))
    near[0] = True
    kept = draws[near][:count]
    return np.concatenate((kept, np.tile(draws[:1], (count - len(kept), 1))))
