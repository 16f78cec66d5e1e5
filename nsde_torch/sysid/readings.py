"""Other ways to read the columns of a log, and the one in which the declared physics leaves much less.

Each interpretation changes the runs; the physics is fitted to it by plain least squares on means over 0.15 s (`rough`),
gains inside their bounds, and score = sum over channels of log(left / measured) says how much is left, whatever the
units. Others are tried only where the log as it is leaves much, and one is reported only where it leaves `LESS` times
less: in a sound log nothing is better than what the columns say.

**Motors.** Which motor is which, and which way propellers turn, is found by the moments that the motors make,

    (w_{k+m} - w_k) / (m dt)  =  g_i (mixing_i, u of the rows before)  +  the rest,   g_i >= 0,   i = roll, pitch, yaw

both sides through the same filters, means over a short time less means over a longer one (`BANDS_S`): about 0.5 to 5
and 3 to 25 Hz, where motors turn a machine, and where neither gravity nor wind does. A wrong order makes moments of
another axis or of another sign, whose gain is 0. Orders of public racing flights were within 5 % of each other in what
the physics left of means over 0.15 s, and are thousands of nats apart here.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from math import exp, log

import numpy as np
from scipy.ndimage import uniform_filter1d

from nsde_torch.arrays import Array, Labels
from nsde_torch.data import Run
from nsde_torch.data.quaternion import multiply
from nsde_torch.data.system_info import derivative_columns, rate_columns
from nsde_torch.effects.coordinates import MOVING
from nsde_torch.effects.law import joined_name
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.rough import Objection, beginnings, left_at, rough_fit, share_left
from nsde_torch.sysid.signals import surely_more
from nsde_torch.systems import System
from nsde_torch.systems.multirotor import Multirotor

Places = tuple[int, ...]
BANDS_S = ((0.02, 0.3), (0.1, 1.0))  # lengths of means, and of longer ones that are taken off [s]
LATEST_S = 0.06  # how late motors may act, by a lag or a delay [s]
_BLOCK_S = 0.5
_FEWEST = 8  # blocks


@dataclass(frozen=True)
class MotorOrder:
    """An order of the motors and a direction of the propellers."""

    places: Places  # places of the motors in the inputs, in the order of the machine's mixing
    yaw: int  # 1: propellers turn as declared; -1: the other way
    blocks: Array  # log likelihood by block of half a second (B,), beyond that of no moments at all [nats]
    left: Array  # root mean square residuals of roll, pitch and yaw (3,) [rad/s2]

    @property
    def nats(self) -> float:
        """All blocks together."""
        return float(self.blocks.sum())

    def surely_better(self, other: "MotorOrder") -> bool:
        """Whether the moments speak clearly for this order."""
        return surely_more(self.blocks - other.blocks)


def motor_orders(
    system: Multirotor, runs: Sequence[Run], clock: float, orders: Sequence[Places]
) -> list[MotorOrder]:
    """Orders of the motors with propellers either way, the likeliest first; none where data are too few to decide."""
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
                by_block = np.bincount(block, each, blocks).astype(np.float64)
                here.append(MotorOrder(places, yaw, by_block, left))
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
) -> tuple[Array, Array, Labels, int]:
    """Inputs so many rows before (N, nu), angular accelerations (N, 3), the block of each row, and their number."""
    rates = range(system.nx)[rate_columns(system) or slice(0)]
    fast = max(1, round(band[0] / dt))
    slow, rows_of_block = max(3 * fast, round(band[1] / dt)), max(1, round(_BLOCK_S / dt))
    pushed, turned, block, first = list[Array](), list[Array](), list[Labels](), 0
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


# ---- interpretations for all machines ----------------------------------------------------------------------

MUCH = 0.25
"""Share of the measured that least squares leave, in the mean of the channels, from which on interpretations are
looked at. It saves time and decides nothing: sound logs of machines in motion leave 0.1 to 0.3."""
LESS = exp(1.0)
"""Factor by which another interpretation must lower the residual of all channels; 30 ms of delay make six times."""
AS_GOOD = 0.15  # difference of scores within which two interpretations are equally good
_ITERATIONS = 4
_PART_S = 20.0  # of the runs, on which interpretations are compared before the best is tried on all
_ROUNDS = 3  # exchanges of two inputs, one after another
_BOTH_SIGNS = 0.05  # share of samples of either sign from which an input has a direction
_METRES = {"millimetres": 1e-3, "centimetres": 1e-2, "feet": 0.3048}


@dataclass(frozen=True)
class Reading:
    """A way to read the columns."""

    words: str  # what would be so
    remedy: str  # how to write the columns
    read: Callable[[Run], Run]  # the runs, read like that


def better_readings(system: System, runs: Sequence[Run], clock: float, rough: Regression) -> Objection | None:
    """The interpretation of the columns in which the declared physics leaves least, if much less than in theirs."""
    return _much_better(system, runs, clock, rough) or _propellers(system, runs, clock)


def _much_better(system: System, runs: Sequence[Run], clock: float, rough: Regression) -> Objection | None:
    """Another sign, order, unit or frame that leaves `LESS` times less of all channels together.

    Of physics that may brake: where a cart's friction is not declared, what it leaves hides the sign of the pole (the
    swing-ups of physical-cartpole, 1.7 times less of plain physics, 4.3 with friction).
    """
    if not float(np.mean([c.left / max(c.measured, 1e-300) for c in left_at(rough, rough.theta)])) > MUCH:
        return None
    system, rough = _braked(system, runs, clock, rough)
    now = left_at(rough, rough.theta)
    some = beginnings(runs, clock, seconds=_PART_S, fewest=50)

    def score(read: Callable[[Run], Run]) -> float:
        fitted = rough_fit(system, [read(run) for run in some], clock, iterations=_ITERATIONS)
        return float("inf") if fitted is None or len(fitted.rows) < len(now) else share_left(fitted)

    before = score(lambda run: run)
    tried = [(score(one.read), one) for one in _readings(system, runs)]
    if system.nu > 2:
        tried += _orders(system, score, before)
    if not tried or not min(value for value, _ in tried) < before - log(LESS):
        return None
    best = min(value for value, _ in tried)
    alike = [one for value, one in sorted(tried, key=lambda t: t[0]) if value < best + AS_GOOD][:3]
    after = rough_fit(system, [alike[0].read(run) for run in runs], clock)
    if after is None or not share_left(after) < share_left(rough) - log(LESS):
        return None
    left = zip(now, left_at(after, after.theta), strict=False)
    told = ", ".join(f"{a.name} {a.left:.3g} to {b.left:.3g} {a.unit}" for a, b in left)
    words = " or ".join(one.words for one in alike)
    return Objection(
        "reading",
        f"With {words} the declared physics, and what may brake it, leaves much less of the rates ({told})",
        " or ".join(dict.fromkeys(one.remedy for one in alike)),
        share=share_left(after),
    )


def _braked(
    system: System, runs: Sequence[Run], clock: float, rough: Regression
) -> tuple[System, Regression]:
    """The physics with a viscous friction of every coordinate, fitted; as it is where it has none, or no fit."""
    moving = [at for at in system.bound_coordinates() if at.kind in MOVING]
    names = [joined_name("viscous_friction", at.name) for at in moving]
    new = [system.make_effect(name) for name in names if name not in system.effect_names]
    braked = system.with_effects(*new)
    fitted = rough_fit(braked, runs, clock) if new else None
    return (system, rough) if fitted is None else (braked, fitted)


def _propellers(system: System, runs: Sequence[Run], clock: float) -> Objection | None:
    """Propellers that turn the other way, as the moments of the motors say.

    Yaw is weak and one channel of six: read the other way, it never leaves `LESS` times less of all channels together;
    and no numbering of the motors turns yaw alone.
    """
    if not isinstance(system, Multirotor):
        return None
    found = motor_orders(system, runs, clock, [tuple(range(system.nu))])
    if not found or found[0].yaw > 0 or not found[0].surely_better(found[1]):
        return None
    best, other = found[:2]
    sentence = (
        f"With propellers that turn the other way the moments of the motors are {best.nats - other.nats:.0f} nats "
        f"likelier, and leave {best.left[2]:.3g} rad/s2 of w_z where they leave {other.left[2]:.3g}"
    )
    return Objection("reading", sentence, f"write system.options.yaw_direction={-system.yaw_direction}")


# ---- the interpretations -------------------------------------------------------------------------------


def _readings(system: System, runs: Sequence[Run]) -> Iterator[Reading]:
    for k, name in enumerate(system.input_names):
        u = np.concatenate([run.u[:, k] for run in runs])
        if min((u > 0).mean(), (u < 0).mean()) > _BOTH_SIGNS:
            read = _changed("u", [k], factor=-1.0)
            yield Reading(f"the opposite sign of {name!r}", f"change the sign of {name!r}", read)
    yield from _axes(system) if system.quaternion is None else _frames(system, system.quaternion)


def _axes(system: System) -> Iterator[Reading]:
    """Signs, origins and units of positions and their rates, one axis at a time."""
    units = dict(zip(system.state_names, system.state_units, strict=True))
    for position, rate, _ in system.position_derivatives:
        i, j = (system.state_names.index(n) for n in (position, rate))
        both = f"{position!r} and {rate!r}"
        if len(system.position_derivatives) > 1:  # of one alone, it is the sign of the inputs
            read = _changed("x", [i, j], factor=-1.0)
            yield Reading(f"the opposite sign of {both}", f"change the signs of {both}", read)
        if units[position] == "rad":
            read = _changed("x", [i], shift=np.pi)
            words = f"{position!r} counted from the other side (pi more)"
            yield Reading(words, f"add pi to {position!r}", read)
            read = _changed("x", [i, j], factor=np.pi / 180.0)
            yield Reading(f"{both} in degrees", f"multiply {both} by pi / 180", read)


def _frames(system: System, q: slice) -> Iterator[Reading]:
    """Axes and units of positions and velocities in the world, and of everything."""
    rates = rate_columns(system)
    groups = [pair for name, pair in derivative_columns(system).items() if "(world" in name]
    if len(groups) != 1 or len(groups[0][0]) != 3:
        return
    moved = groups[0]
    names = ", ".join(system.state_names[c] for pair in moved for c in pair)

    def of_world(x: Array, turn: Array) -> Array:
        for columns in moved:
            x[:, columns] = x[:, columns] @ turn.T
        return x

    def of_body(x: Array) -> Array:
        x[:, q] = multiply(x[:, q], np.tile([0.0, 1.0, 0.0, 0.0], (len(x), 1)))
        if rates is not None:
            x[:, rates] *= [1.0, -1.0, -1.0]
        return x

    def whole(x: Array) -> Array:
        x = of_world(x, ned)
        half = np.sqrt(0.5)
        x[:, q] = multiply(np.tile([0.0, half, half, 0.0], (len(x), 1)), x[:, q])
        return of_body(x)

    def world(turn: Sequence[Sequence[float]] | Array) -> Callable[[Run], Run]:
        return _states(partial(of_world, turn=np.array(turn, dtype=float)))

    east = "write east, north, up (ENU), or an attitude in the same axes"
    for angle, turn in (
        (90, [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        (-90, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        (180, [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]),
    ):
        words = f"the axes of {names} turned by {angle} deg about the vertical against the attitude's"
        yield Reading(words, east, world(turn))
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    yield Reading(f"{names} in NED and the attitude in ENU", "write east, north, up (ENU)", world(ned))
    for axis, name in enumerate("xyz"):
        flip = np.eye(3)
        flip[axis, axis] = -1.0
        pair = " and ".join(repr(system.state_names[columns[axis]]) for columns in moved)
        words = f"the opposite sign of {pair}" + (" (counted downwards)" if name == "z" else "")
        yield Reading(words, f"change the signs of {pair}: axes are ENU", world(flip))
    for unit, size in _METRES.items():
        remedy = f"multiply {names} by {size:g}: metres, SI"
        yield Reading(f"{names} in {unit}", remedy, world(size * np.eye(3)))
    remedy = "write ENU and FLU (`nsde_torch.data.quaternion`)"
    yield Reading("all states in NED and FRD", remedy, _states(whole))
    remedy = "write the attitude and the rates of FLU axes"
    yield Reading("the attitude and the rates of a body in FRD", remedy, _states(of_body))


def _orders(
    system: System, score: Callable[[Callable[[Run], Run]], float], before: float
) -> list[tuple[float, Reading]]:
    """Orders of the inputs of one unit: all pairs exchanged, rotations, the other way round; and on from the best."""
    n = system.nu
    if len(set(system.input_units)) > 1:
        return []
    own = tuple(range(n))
    swaps = list(combinations(range(n), 2))
    first = [_swapped(own, pair) for pair in swaps]
    first += [tuple((k + s) % n for k in range(n)) for s in range(1, n)]
    first.append(tuple(reversed(own)))
    values: dict[tuple[int, ...], float] = {own: before}
    for order in dict.fromkeys(first):
        values[order] = score(_ordered(order))
    for _ in range(_ROUNDS):
        best = min(values, key=lambda order: values[order])
        around = [order for pair in swaps if (order := _swapped(best, pair)) not in values]
        if best == own or not around or values[best] > before - 0.3 * log(LESS):
            break
        for order in around:
            values[order] = score(_ordered(order))
        if min(values, key=lambda order: values[order]) == best:
            break
    return [(value, _in_order(system, order)) for order, value in values.items() if order != own]


def _in_order(system: System, order: tuple[int, ...]) -> Reading:
    names = system.input_names
    moved = [k for k, j in enumerate(order) if j != k]
    if len(moved) == 2:
        words = f"{names[moved[0]]} and {names[moved[1]]} exchanged"
    else:
        words = f"the inputs in the order {' '.join(names[j] for j in order)}"
    remedy = f"check the order of the inputs: {system.name!r} counts its motors as PX4 does"
    return Reading(words, remedy, _ordered(order))


def _swapped(order: tuple[int, ...], pair: tuple[int, int]) -> tuple[int, ...]:
    out = list(order)
    out[pair[0]], out[pair[1]] = out[pair[1]], out[pair[0]]
    return tuple(out)


def _ordered(order: tuple[int, ...]) -> Callable[[Run], Run]:
    n = len(order)
    return lambda run: replace(run, u=np.concatenate([run.u[:, list(order)], run.u[:, n:]], 1))


def _states(change: Callable[[Array], Array]) -> Callable[[Run], Run]:
    return lambda run: replace(run, x=change(np.array(run.x)))


def _changed(key: str, columns: list[int], factor: float = 1.0, shift: float = 0.0) -> Callable[[Run], Run]:
    """Columns of the states `x` or the inputs `u` multiplied and shifted."""

    def read(run: Run) -> Run:
        values = np.array(getattr(run, key))
        values[:, columns] = factor * values[:, columns] + shift
        return replace(run, **{key: values})  # type: ignore[arg-type]

    return read
