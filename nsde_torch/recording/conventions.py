"""Conventions of a log that kinematics tell apart: order and direction of a quaternion, axes of a velocity.

    log(q(t)^-1 q(t + dt)) = omega dt           for a quaternion w x y z, body to world
    p(t + dt) - p(t) = v dt                     for a velocity in the world, R(q) v dt for one in the body's axes

Each way to read the columns is judged by what it leaves of these over intervals of a quarter of a second, summed over
all runs. A log is refused where the expected way leaves much of the motion and at least ten times as much as another
one: in sound data the expected way leaves least, whatever the noise, and a wrong unit or clock spoils all alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.mapping.misread import percent
from nsde_torch.data.quaternion import conjugate, increments, rotate
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns
from nsde_torch.errors import DataError
from nsde_torch.recording.noise import white

Array = NDArray[np.float64]
_OWN_S = 1.0
_OWN, _NOISE, _OTHERS = 0.5, 6.0, 0.1
"""Of a position's changes over a second in one run: share that its rate leaves of a column that is of another run,
times the noise of both, and share that the rates of the other runs leave at most."""
_Way = Callable[[Array], tuple[Array, Array]]  # changes over steps and means of their rates, from states

INTERVAL_S = 0.25
_FEWEST = 20
_LEFT_ATTITUDE, _LEFT_VELOCITY = 0.25, 0.02
"""Shares of the motion that a sound log leaves never."""
_BETTER = 10.0

_QUATERNIONS: dict[str, Callable[[Array], Array]] = {
    "": lambda q: q,
    "the quaternion turns the world into the body: change the signs of its last three columns": conjugate,
    "the quaternion has its scalar last: write w before x y z": lambda q: q[:, [3, 0, 1, 2]],
    "the quaternion has its scalar last and turns the world into the body: write w before x y z, and change the "
    "signs of these three": lambda q: conjugate(q[:, [3, 0, 1, 2]]),
}


def check(system: SystemInfo, runs: Sequence[Run]) -> None:
    """Refuses columns that another convention explains.

    Raises:
        DataError: a quaternion or a velocity follows another convention; the message says how to write it.
    """
    q = system.quaternion
    if q is None or not runs:
        return
    parts = [run.x[a:b] for run in runs for a, b in run.segments]
    rates = rate_columns(system)
    if rates is not None:
        turned = {remedy: _turned(q, rates, read) for remedy, read in _QUATERNIONS.items()}
        _refuse(parts, turned, runs[0].dt, _LEFT_ATTITUDE, "attitude and body rates disagree")
    for group, (i, j) in derivative_columns(system).items():
        if len(i) == 3 and "(world" in group:
            names = [system.state_names[k] for k in j]
            ways = {remedy: _moved(q, i, j, read) for remedy, read in _velocities(names).items()}
            _refuse(parts, ways, runs[0].dt, _LEFT_VELOCITY, "position and velocity disagree")


def check_runs(system: SystemInfo, runs: Sequence[Run]) -> None:
    """Refuses a run whose position and rate do not belong together, where those of the other runs do.

    Raises:
        DataError: a column that is of another run or another time.
    """
    pairs = [(i, j) for a, b in derivative_columns(system).values() for i, j in zip(a, b, strict=True)]
    for i, j in pairs:
        left = [_own_share(run, i, j) for run in runs]
        for k, run in enumerate(runs):
            share, beyond = left[k]
            others = [s for n, (s, _) in enumerate(left) if n != k]
            if others and share > _OWN and beyond > _NOISE and float(np.median(others)) < _OTHERS:
                a, b = system.state_names[i], system.state_names[j]
                much = f"{share:.0%}" if share < 10.0 else "more than ten times"
                raise DataError(
                    f"run {run.name!r}: {a!r} and {b!r} do not belong together: {b!r} leaves {much} of what {a!r} "
                    f"changes by over {_OWN_S:g} s, and {np.median(others):.1%} in the other runs. One of the columns "
                    "is of another run or another time: write the right one, or leave the run out."
                )


def _own_share(run: Run, i: int, j: int) -> tuple[float, float]:
    """Share of a position's changes that the integral of its rate leaves, and its size over that of the noise."""
    n = max(4, round(_OWN_S / run.dt))
    gaps, moves, noise = [], [], 0.0
    for a, b in run.segments:
        p, v = run.x[a:b, i], run.x[a:b, j]
        if len(p) <= 2 * n:
            continue
        whole = np.concatenate([[0.0], np.cumsum(0.5 * run.dt * (v[1:] + v[:-1]))])
        change = np.diff(p[::n])
        gaps.append(change - np.diff(whole[::n]))
        moves.append(change)
        noise = max(noise, (2.0 * white(p) ** 2 + n * (run.dt * white(v)) ** 2) ** 0.5)
    if sum(map(len, gaps)) < 5:
        return 0.0, 0.0
    gap, move = np.concatenate(gaps), np.concatenate(moves)
    gap = gap - gap.mean()  # a biased rate is another fault
    size = float(np.sqrt(np.square(gap).mean()))
    return size / max(float(np.sqrt(np.square(move).mean())), 1e-300), size / max(noise, 1e-300)


def _velocities(names: Sequence[str]) -> dict[str, Callable[[Array, Array], Array]]:
    """Ways to read a velocity, from the quaternion and the columns of these names, by their remedies."""

    def ordered(order: tuple[int, ...]) -> Callable[[Array, Array], Array]:
        return lambda q, v: v[:, order]

    out: dict[str, Callable[[Array, Array], Array]] = {"": lambda q, v: v}
    for order in permutations(range(3)):
        if order != (0, 1, 2):
            wanted = " ".join(names[k] for k in order)
            out[f"the columns {wanted} are {' '.join(names)}: rename them"] = ordered(order)
    out["the velocity is NED: write east, north, up"] = lambda q, v: v[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    out[
        "the velocity is along the body's axes: turn it into the world with the attitude, v_world = R(q) v"
    ] = rotate
    return out


def _turned(q: slice, rates: slice, read: Callable[[Array], Array]) -> _Way:
    return lambda x: (increments(read(x[:, q])), _means(x[:, rates]))


def _moved(q: slice, i: list[int], j: list[int], read: Callable[[Array, Array], Array]) -> _Way:
    return lambda x: (np.diff(x[:, i], axis=0), _means(read(x[:, q], x[:, j])))


def _means(rate: Array) -> Array:
    return 0.5 * (rate[1:] + rate[:-1])


def _refuse(parts: Iterable[Array], ways: Mapping[str, _Way], dt: float, most: float, what: str) -> None:
    """Refuses if the first way to read the columns leaves more than `most` of the motion, and another one much less."""
    length = max(1, round(INTERVAL_S / dt))
    left, whole, count = dict.fromkeys(ways, 0.0), dict.fromkeys(ways, 0.0), 0
    for x in parts:
        n = (len(x) - 1) // length
        count += n
        for remedy, read in ways.items() if n else ():
            change, rate = (v[: n * length].reshape(n, length, 3).sum(1) for v in read(x[: n * length + 1]))
            left[remedy] += float(np.square(change - dt * rate).sum())
            whole[remedy] += float(np.square(change).sum())
    if count < _FEWEST:
        return
    share = {remedy: left[remedy] / max(whole[remedy], 1e-300) for remedy in ways}
    best = min(share, key=lambda remedy: share[remedy])
    if best and share[""] > most and _BETTER * share[best] < share[""]:
        raise DataError(
            f"{what}: as the columns are expected (w x y z, body to world; velocities in the world), "
            f"{percent(share[''])} of the motion over {INTERVAL_S:g} s is left unexplained, and "
            f"{share[best]:.1%} if {best}."
        )
