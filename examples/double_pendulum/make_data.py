"""Writes runs of a double pendulum with known frictions, to try a diagnosis on.

The equations of motion are written from masses and lengths, integrated by Runge and Kutta's method, and share no code
with `double_pendulum.py` or the package. Each run has torques of its own, sums of sines; angles and rates are
measured with noise.

    python make_data.py FOLDER [--dry 0.15 0.1] [--viscous 0 0] [--seed 0] [--runs 4] [--seconds 20]
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

MASS_1, MASS_2 = 1.0, 0.6  # [kg], links with their motors
LENGTH_1 = 0.25  # [m], joint to joint
CENTRE_1, CENTRE_2 = 0.12, 0.14  # [m], joint to centre of mass
INERTIA_1, INERTIA_2 = 0.012, 0.006  # [kg m2], about the centres
GRAVITY = 9.81
DT, FINE = 0.01, 5  # step of the log [s] and steps of the integration in it
WITHIN = 2.0  # [rad], which the second joint does not leave
NOISE = (0.001, 0.001, 0.01, 0.01)  # [rad], [rad/s], of the sensors
TORQUE = (0.6, 0.15)  # [N m], standard deviation of each motor's torque

Array = np.ndarray
Push = Callable[[Array, Array], Array]


def accelerations(q: Array, w: Array, torque: Array) -> Array:
    """q'' [rad/s2] of both joints under the torques on them [N m]."""
    c2, s2 = np.cos(q[1]), np.sin(q[1])
    far = MASS_2 * LENGTH_1 * CENTRE_2
    low = INERTIA_2 + MASS_2 * CENTRE_2**2
    mixed = low + far * c2
    top = INERTIA_1 + MASS_1 * CENTRE_1**2 + MASS_2 * LENGTH_1**2 + low + 2.0 * far * c2
    weight_2 = MASS_2 * GRAVITY * CENTRE_2 * np.sin(q[0] + q[1])
    weight_1 = (MASS_1 * CENTRE_1 + MASS_2 * LENGTH_1) * GRAVITY * np.sin(q[0]) + weight_2
    swing = np.array([-far * s2 * w[1] * (2.0 * w[0] + w[1]), far * s2 * w[0] ** 2])
    return np.linalg.solve(
        np.array([[top, mixed], [mixed, low]]), torque - swing - np.array([weight_1, weight_2])
    )


def friction(dry: Array, viscous: Array, width: float = 0.02) -> Push:
    """Torques of dry and viscous friction in both joints [N m]."""
    return lambda q, w: -dry * np.tanh(w / width) - viscous * w


def torques(rows: int, rng: np.random.Generator) -> Array:
    """Torques of both motors (rows, 2) [N m], each a sum of sines."""
    t = DT * np.arange(rows)
    out = np.zeros((rows, 2))
    for k, size in enumerate(TORQUE):
        hertz = np.exp(rng.uniform(np.log(0.1), np.log(2.0), 8))
        phase = rng.uniform(0.0, 2.0 * np.pi, 8)
        out[:, k] = size / 2.0 * np.sin(2.0 * np.pi * hertz * t[:, None] + phase).sum(1)
    return out


def simulate(
    rows: int, rng: np.random.Generator, push: Push, noise: float = 1.0, share: float = 1.0
) -> Array:
    """A run (rows, 6): measured angles and rates, and the torques that act until the next row."""
    u = share * torques(rows, rng)
    x = np.concatenate([rng.uniform(-0.5, 0.5, 2), np.zeros(2)])
    out, h = np.empty((rows, 6)), DT / FINE

    def rate(x: Array, torque: Array) -> Array:
        return np.concatenate([x[2:], accelerations(x[:2], x[2:], torque + push(x[:2], x[2:]))])

    for k in range(rows):
        out[k] = np.concatenate([x, u[k]])
        for _ in range(FINE):
            k1 = rate(x, u[k])
            k2 = rate(x + 0.5 * h * k1, u[k])
            k3 = rate(x + 0.5 * h * k2, u[k])
            k4 = rate(x + h * k3, u[k])
            x = x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    out[:, :4] += noise * rng.normal(size=(rows, 4)) * NOISE
    return out


def kept(rows: int, rng: np.random.Generator, push: Push, noise: float) -> Array:
    """A run whose second joint stays within `WITHIN`: the torques are made smaller until it does."""
    seed, share = int(rng.integers(2**31)), 1.0
    while True:
        run = simulate(rows, np.random.default_rng(seed), push, noise, share)
        if np.abs(run[:, 1]).max() < WITHIN:
            return run
        share *= 0.8


def write(
    folder: Path, push: Push, *, seed: int, runs: int = 4, seconds: float = 20.0, noise: float = 1.0
) -> None:
    """Writes `run_0.csv`, ..."""
    rng, rows = np.random.default_rng(seed), round(seconds / DT)
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(runs):
        t = DT * np.arange(rows) + k * (seconds + 10.0)  # one clock for the whole data set
        table = np.column_stack([t, kept(rows, rng, push, noise)])
        header = "t,q1,q2,q1_dot,q2_dot,tau1,tau2"
        np.savetxt(folder / f"run_{k}.csv", table, "%.6f", ",", header=header, comments="")


def main() -> None:
    """Writes what the arguments say."""
    parser = argparse.ArgumentParser(description="Write runs of a double pendulum with known frictions.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--dry", type=float, nargs=2, default=(0.15, 0.1), help="of each joint [N m]")
    parser.add_argument(
        "--viscous", type=float, nargs=2, default=(0.0, 0.0), help="of each joint [N m s/rad]"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each run [s]")
    a = parser.parse_args()
    push = friction(np.array(a.dry), np.array(a.viscous))
    write(a.folder, push, seed=a.seed, runs=a.runs, seconds=a.seconds)
    print(f"{a.runs} runs of {a.seconds:g} s at {1 / DT:g} Hz in {a.folder}")


if __name__ == "__main__":
    main()
