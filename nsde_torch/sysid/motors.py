"""Which motor is which, and which way propellers turn, by the moments that the motors make.

    (w_{k+m} - w_k) / (m dt)  =  g_i (mixing_i, u of the rows before)  +  the rest,   g_i >= 0,   i = roll, pitch, yaw

both sides through the same filters, means over a short time less means over a longer one (`BANDS_S`): about 0.5 to 5
and 3 to 25 Hz, where motors turn a machine, and where neither gravity nor wind does. A wrong order makes moments of
another axis or of another sign, whose gain is 0. Orders of public racing flights were within 5 % of each other in what
the physics left of means over 0.15 s, and are thousands of nats apart here.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from nsde_torch.data import Run
from nsde_torch.data.system_info import rate_columns
from nsde_torch.systems.multirotor import Multirotor

Array = NDArray[np.float64]
Places = tuple[int, ...]

BANDS_S = ((0.02, 0.3), (0.1, 1.0))
"""Lengths of means, and of longer ones that are taken off [s]."""
LATEST_S = 0.06
"""How late motors may act, by a lag or a delay [s]."""
_BLOCK_S = 0.5
_FEWEST = 8  # blocks
_SURE, _LEAST = 3.0, 10.0  # standard errors and nats by which an order is surely better


@dataclass(frozen=True)
class MotorOrder:
    """An order of the motors and a direction of the propellers."""

    places: Places  # places of the motors in the inputs, in the order of the machine's mixing
    yaw: int  # 1: propellers turn as declared; -1: the other way
    blocks: Array  # log likelihood by block of half a second (B,), beyond that of no moments at all [nats]
    left: Array  # root mean square of what is left of roll, pitch and yaw (3,) [rad/s2]

    @property
    def nats(self) -> float:
        """All blocks together."""
        return float(self.blocks.sum())

    def surely_better(self, other: "MotorOrder") -> bool:
        """Whether the moments speak clearly for this order."""
        difference = self.blocks - other.blocks
        error = float(difference.std() * len(difference) ** 0.5)
        return float(difference.sum()) > max(_LEAST, _SURE * error)


def motor_orders(
    system: Multirotor, runs: Sequence[Run], clock: float, orders: Sequence[Places]
) -> list[MotorOrder]:
    """Orders of the motors with propellers either way, the likeliest first; none where there is too little to tell."""
    dt = runs[0].dt * clock
    some = [_in_a_band(system, runs, dt, band, orders) for band in BANDS_S]
    found = [
        MotorOrder(one.places, one.yaw, np.sum([o.blocks for o in same], 0), one.left)
        for same in zip(*(s for s in some if s), strict=True)
        for one in same[:1]
    ]
    return sorted(found, key=lambda o: -o.nats)


def _in_a_band(
    system: Multirotor, runs: Sequence[Run], dt: float, band: tuple[float, float], orders: Sequence[Places]
) -> list[MotorOrder]:
    """All orders, with the inputs as late as the likeliest of them has them; none where the log is too short."""
    moments = np.asarray(system.mixing)[1:]
    found: list[MotorOrder] = []
    for late in range(0, round(LATEST_S / dt) + 1, max(1, round(0.01 / dt))):
        u, turned, block, blocks = _filtered(system, runs, dt, band, late)
        if len(np.unique(block)) < _FEWEST:
            return []
        here = []
        for places in orders:
            for yaw in (1, -1):
                moment = u @ (moments[:, np.argsort(places)] * [[1], [1], [yaw]]).T
                each, left = _explained(moment, turned)
                here.append(
                    MotorOrder(places, yaw, np.bincount(block, each, blocks).astype(np.float64), left)
                )
        found = max(found, here, key=lambda some: max((o.nats for o in some), default=-np.inf))
    return found


def _explained(moment: Array, turned: Array) -> tuple[Array, Array]:
    """Log likelihood (N,) beyond that of no moments, and what is left (3,) of angular accelerations (N, 3)."""
    gain = ((moment * turned).sum(0) / np.square(moment).sum(0).clip(1e-300)).clip(0.0)
    rest = turned - gain * moment
    variance, whole = np.square(rest).mean(0), np.square(turned).mean(0).clip(1e-300)
    each = 0.5 * (np.square(turned) / whole - np.square(rest) / variance.clip(1e-300)).sum(1)
    return each + 0.5 * float(np.log(whole / variance.clip(1e-300)).sum()), np.sqrt(variance)


def _filtered(
    system: Multirotor, runs: Sequence[Run], dt: float, band: tuple[float, float], late: int
) -> tuple[Array, Array, NDArray[np.int64], int]:
    """Inputs so many rows before (N, nu), angular accelerations (N, 3), the block of each row, and their number."""
    rates = range(system.nx)[rate_columns(system) or slice(0)]
    fast = max(1, round(band[0] / dt))
    slow, rows_of_block = max(3 * fast, round(band[1] / dt)), max(1, round(_BLOCK_S / dt))
    pushed: list[Array] = []
    turned: list[Array] = []
    block: list[NDArray[np.int64]] = []
    first = 0
    for run in runs:
        for a, b in run.segments:
            rows = b - a - fast - late
            if rows >= 2 * slow:
                w, u = run.x[a:b, list(rates)], run.u[a:b, : system.nu]
                change = (w[fast + late :] - w[late : len(w) - fast]) / (fast * dt)
                mean = uniform_filter1d(u, fast, axis=0, origin=-(fast // 2))[:rows]
                inner = slice(slow // 2, rows - slow // 2, fast)
                for z, out in ((mean, pushed), (change, turned)):
                    out.append((z - uniform_filter1d(z, slow, axis=0))[inner])
                block.append(first + np.arange(rows)[inner] // rows_of_block)
            first += (b - a) // rows_of_block + 1
    if not block:
        return np.zeros((0, system.nu)), np.zeros((0, 3)), np.zeros(0, dtype=np.int64), 0
    return np.concatenate(pushed), np.concatenate(turned), np.concatenate(block), first
