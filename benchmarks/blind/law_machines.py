"""Machines with a law that no catalogue has: simulators of their own, in NumPy, that share no code with `nsde_torch`.

Springs and carts are those of `small_machines`, multirotors those of `loop_machine`, with a further force that is any
function of the true state; two joints are those of `examples/double_pendulum`. The size of a law is drawn as a share
of what moves the machine anyway.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import loop_flight
import numpy as np
import small_machines
from law_kinds import Array, Kind
from loop_machine import Bodies, Machine, rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "double_pendulum"))
import make_data


@dataclass(frozen=True)
class Law:
    """A law of a machine: kind, size and shape."""

    kind: Kind
    size: float
    shape: float = 0.0

    def __call__(self, x: Array, u: Array) -> Array:
        """What it adds (n,) at states (n, nx) and inputs (n, nu)."""
        return self.size * self.kind.term(x, u, self.shape)


def small_runs(
    system: str, law: Law | None, rng: np.random.Generator, seed: int, runs: int, seconds: float
) -> tuple[list[tuple[Array, Array, Array]], small_machines.Small]:
    """Runs of a spring or a cart with a law: times, measured states and forces."""
    machine = small_machines.small(system, rng, False)
    return [_small_run(machine, law, seconds, seed + r) for r in range(runs)], machine


def _small_run(
    machine: small_machines.Small, law: Law | None, seconds: float, seed: int
) -> tuple[Array, Array, Array]:
    plain, geometry = small_machines._rate, machine.values

    def rate(own: small_machines.Small, y: Array, u: float, white: Array) -> Array:
        if law is None:
            return plain(own, y, u, white)
        more = float(law(y[None], np.array([[u]]))[0])
        if own.system == "mass_spring_damper" or law.kind.row == 0:
            return plain(own, y, u, white + np.array([more, 0.0]))
        inertia = 4 / 3 - geometry["s"] * np.cos(y[2]) ** 2
        return plain(own, y, u, white + np.array([0.0, 4.0 / 3.0 * more / inertia]))

    small_machines._rate = rate
    try:
        return small_machines.run(machine, seconds, 0.01 if machine.system != "cartpole" else 0.02, seed)
    finally:
        small_machines._rate = plain


class LawBodies(Bodies):
    """A batch of multirotors, each with the law that its machine's `effects` hold under `law`."""

    def __init__(self, machines: list[Machine], t0: Array, noise: object = None, step: float = 0.001) -> None:
        super().__init__(machines, t0, noise, step)
        self.laws = [m.effects.get("law", {}).get("of") for m in machines]

    def rates(
        self, p: Array, v: Array, q: Array, w: Array, m: Array, t: Array, push: Array
    ) -> tuple[Array, Array, Array, Array]:
        """See `Bodies.rates`."""
        r = rotation(q)
        seen = np.concatenate([np.einsum("bji,bj->bi", r, v), w, p], 1)
        pushed = push.copy()
        for b, law in enumerate(self.laws):
            if law is None:
                continue
            more = float(law(seen[b : b + 1], m[b : b + 1])[0])
            if law.kind.row < 3:
                pushed[b, :3] += r[b][:, law.kind.row] * more
            else:
                pushed[b, law.kind.row] += more
        return super().rates(p, v, q, w, m, t, pushed)


def flights(
    machine: Machine, seed: int, seconds: float, paths: tuple[str, ...], noise: float = 1.0
) -> list[loop_flight.Logged]:
    """Flights of a machine whose `effects` may hold a law, one for each path."""
    rng = np.random.default_rng([seed, 9])
    asked = [
        loop_flight.Flight(machine, path, "a", seconds, 0.0, int(rng.integers(2**31)), noise, 1.2)
        for path in paths
    ]
    plain, loop_flight.Bodies = loop_flight.Bodies, LawBodies
    try:
        return loop_flight.fly(asked)
    finally:
        loop_flight.Bodies = plain


def joint_push(law: Law | None) -> make_data.Push:
    """The torques of a law on two joints."""

    def push(q: Array, w: Array) -> Array:
        out = np.zeros(2)
        if law is not None:
            out[law.kind.row] = law(np.concatenate([q, w])[None], np.zeros((1, 2)))[0]
        return out

    return push
