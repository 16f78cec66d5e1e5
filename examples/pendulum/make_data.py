"""Writes a CSV data set of a pendulum that the model does not know: three runs, one file each.

The true pendulum (l = 0.5 m, 0.5 kg, damping 0.3 1/s) also rubs in its bearing, feels small random torques
and is measured with noise. None of this is in `pendulum.py`: the residual network and the diffusion are to
find it.

    python make_data.py FOLDER [--seconds 40] [--seed 0]
"""

import argparse
from pathlib import Path

import numpy as np

GRAVITY, DAMPING, TORQUE_GAIN = 9.81 / 0.5, 0.3, 1.0 / (0.5 * 0.5**2)
FRICTION, FRICTION_WIDTH = 0.6, 0.05  # [rad/s2], [rad/s]
GUSTS = 0.3  # [rad/s2 per root Hz], random torque
NOISE = (0.002, 0.01)  # [rad], [rad/s], of the sensors
DT, FINE = 0.01, 10  # step of the log [s] and steps of the simulation in it


def acceleration(theta: float, rate: float, torque: float) -> float:
    """theta'' [rad/s2] of the true pendulum."""
    friction = FRICTION * np.tanh(rate / FRICTION_WIDTH)
    return float(-GRAVITY * np.sin(theta) - DAMPING * rate - friction + TORQUE_GAIN * torque)


def simulate(rows: int, rng: np.random.Generator) -> np.ndarray:
    """A run (rows, 3): measured theta and theta_dot, and the torque that acts until the next row."""
    theta, rate, torque = rng.uniform(-0.5, 0.5), 0.0, 0.0
    out = np.empty((rows, 3))
    h = DT / FINE
    for k in range(rows):
        if k % 25 == 0:  # a new torque every quarter of a second
            torque = rng.uniform(-1.0, 1.0)
        out[k] = theta, rate, torque
        for gust in rng.normal(0.0, GUSTS * np.sqrt(h), FINE):
            rate += h * acceleration(theta, rate, torque) + gust
            theta += h * rate
    out[:, :2] += rng.normal(size=(rows, 2)) * NOISE
    return out


def main() -> None:
    """Writes `run_0.csv` to `run_2.csv`."""
    parser = argparse.ArgumentParser(description="Write the data set of the pendulum example.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=40.0, help="length of each run [s]")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    rows = round(arguments.seconds / DT)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for k in range(3):
        t = DT * np.arange(rows) + k * (arguments.seconds + 10.0)  # one clock for the whole data set
        table = np.column_stack([t, simulate(rows, rng)])
        header = "t,theta,theta_dot,torque"
        np.savetxt(arguments.folder / f"run_{k}.csv", table, "%.6f", ",", header=header, comments="")
    print(f"3 runs of {arguments.seconds:g} s at {1 / DT:g} Hz in {arguments.folder}")


if __name__ == "__main__":
    main()
