"""Are parameters right, and do their intervals hold, where positions alone were measured?

Springs with dry friction of 0.2 m/s2 and values of their own in each seed (`blind/small_machines.py`, which
shares no code with the package): the error of each parameter in standard errors, and how many 90 % intervals hold.

    python benchmarks/bench_position_only.py --count 20 --settings white counts full
"""

from typing import Any

import numpy as np
import torch
from common import options
from small_machines import measured, spring

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.systems import make_system

SETTINGS: dict[str, dict[str, Any]] = {
    "full": {"sensor": True},
    "full, rough": {"sensor": True, "noise": 5e-3},
    "white": {},
    "counts": {"counts": True},
    "rough": {"noise": 5e-3},
    "gusty": {"gust": 0.15, "noise": 3e-4},
    "fast": {"dt": 0.004, "noise": 2e-4, "seconds": 12.0},
    "no gust": {"gust": 0.0},
}
FRICTION = 0.2


def identified(
    seed: int,
    *,
    sensor: bool = False,
    noise: float = 1e-3,
    counts: bool = False,
    gust: float = 0.02,
    dt: float = 0.01,
    seconds: float = 20.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Errors in standard errors, and whether 90 % intervals hold: gain, stiffness, damping, friction."""
    rng = np.random.default_rng([77, seed])
    k, b, g, force = rng.uniform(1, 9), rng.uniform(0.1, 0.8), rng.uniform(0.6, 2), rng.uniform(1.5, 3)
    runs = []
    for i in range(3):
        own = np.random.default_rng([100 + seed, i])
        x, u = spring(
            {"k": float(k), "b": float(b), "g": float(g), "force": float(force)},
            lambda q, v: -FRICTION * float(np.tanh(v / 0.01)),
            seconds=seconds,
            dt=dt,
            gust=gust,
            rng=own,
        )
        q = measured(x[:, 0], noise, counts, own)
        v = x[:, 1] + 10.0 * noise * own.standard_normal(len(q)) if sensor else np.full(len(q), np.nan)
        runs.append(RawRun(f"run_{i}", dt * np.arange(len(q)) + 100.0 * i, np.column_stack([q, v]), u))
    data = nsde_torch.read(runs, system="mass_spring_damper")
    found = identify_in_loop(make_system("mass_spring_damper", effects=["coulomb_friction"]), data.runs)
    truth = {
        "force_gain": g,
        "linear_spring.stiffness": k,
        "viscous_friction.damping": b,
        "coulomb_friction.size": FRICTION,
    }
    at = [found.vector.labels.index(name) for name in truth]
    off = found.values[at] - np.array(list(truth.values()))
    return off / found.standard_errors[at], np.abs(off) <= found.half_widths(0.9)[at]


def main() -> None:
    parser = options(__doc__, count=20)
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    a = parser.parse_args()
    torch.set_num_threads(1)
    print("setting: mean and spread of errors in standard errors, 90 % intervals that hold")
    for name in a.settings:
        found = [identified(seed, **SETTINGS[name]) for seed in range(a.count)]
        off = np.array([z for z, _ in found])
        inside = np.array([held for z, held in found if np.isfinite(z).all()])
        means, spread = np.nanmean(off, 0).round(2), np.nanstd(off, 0).round(2)
        print(f"{name}: {means} {spread} {inside.sum()} of {inside.size}", flush=True)


if __name__ == "__main__":
    main()
