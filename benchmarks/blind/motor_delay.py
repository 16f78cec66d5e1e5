"""Question: how well is the lag of a quadrotor's motors found, beside the method of sysid.tools?

    python benchmarks/blind/motor_delay.py --seeds 6            # needs mujoco

Quadrotors of MuJoCo on paths. The other method is that of Eschmann, Albani, Loianno, "Data-Driven System Identification
of Quadrotors Subject to Motor Delays" (IROS 2024), which https://sysid.tools runs, written here from its equations:

    x' = (u - x) / T,        f = sum_i c_0 + c_1 x_i + c_2 x_i^2   along body z,

with f the specific force, here from differences of the logged velocity, c by least squares, and T that of 200 between 1
and 200 ms whose rms error of f is least. It asks for flights that move the throttle; these do so as far as a path does.
"""

from __future__ import annotations

from pathlib import Path

import mujoco_machines as machines
import numpy as np
from scipy.signal import lfilter
from study import Array, Json, head, line, options, written

import nsde_torch

GRID = np.linspace(0.001, 0.2, 200)
GRAVITY = np.array([0.0, 0.0, 9.81])


def by_thrust(data: nsde_torch.data.DataSet) -> float:
    """The time constant [s] whose filtered commands explain the specific force along body z best."""
    force, commands, dt = [], [], data.dt
    for run in data.runs:
        x, (w, a, b, c) = run.x, run.x[:, 6:10].T
        pull = np.gradient(x[:, 3:6], dt, axis=0) + GRAVITY
        up = np.stack((2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)), 1)
        force.append((pull * up).sum(1))
        commands.append(run.u)
    wanted = np.concatenate(force)

    def error(lag: float) -> float:
        keep = float(np.exp(-dt / lag))
        rows = [lfilter([0.0, 1.0 - keep], [1.0, -keep], u - u[0], axis=0) + u[0] for u in commands]
        x: Array = np.concatenate(rows)
        table = np.stack((np.ones(len(x)), x.sum(1), (x * x).sum(1)), 1)
        return float(np.square(wanted - table @ np.linalg.lstsq(table, wanted)[0]).mean())

    return float(min(GRID, key=error))


def judged(seed: int) -> Json:
    logs = []

    def write(folder: Path) -> float:
        truth = machines.write("quadrotor_lag", seed, folder)["motor_lag"]["time_constant"]
        logs.append(nsde_torch.read(folder, system="quadrotor"))
        return truth

    truth, _, answer = written(write, "quadrotor")
    own = answer["parameters"].get("motor_lag.time_constant", {"value": np.nan, "interval_90": None})
    return {"truth": truth, "thrust": by_thrust(logs[0]), "own": own, "added": answer["added"]}


def main() -> None:
    given = options(__doc__, seeds=6).parse_args()
    rows = []
    head("true lag", "sysid.tools' method", "diagnosis", "90 % interval", "named")
    for seed in range(given.seeds):
        r = judged(seed)
        ms = [f"{1e3 * v:.1f}" for v in (r["truth"], r["thrust"], r["own"]["value"])]
        ends = ", ".join(f"{1e3 * e:.1f}" for e in r["own"]["interval_90"] or ())
        print(line([f"{ms[0]} ms", *ms[1:], ends, ", ".join(r["added"])]), flush=True)
        rows.append([abs(r["thrust"] / r["truth"] - 1), abs(r["own"]["value"] / r["truth"] - 1)])
    thrust, own = 100 * np.median(rows, axis=0)
    print(f"error of the lag, median: {thrust:.1f} % and {own:.1f} %")


if __name__ == "__main__":
    main()
