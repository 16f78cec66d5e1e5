"""How much of what an undeclared law explains the networks of a neural SDE learn beside declared physics.

    python benchmarks/bench_networks.py --seeds 3 --out networks/

Plants are of simulators of their own. Each is trained as `nsde train` does, beside it the declared physics alone and
the physics with the law declared (`model=sysid`). The share is that of the logarithm of what they leave of the rates of
a run held out, log(without / networks) / log(without / with); for plants without a law the logarithm is what is lost.
"""

import tempfile
from math import log
from pathlib import Path
from typing import Any

import numpy as np
from common import columns, head, line, options, read_json, save
from law_machines import KINDS, Law, flights, make_data
from loop_machine import Machine
from small_machines import Small, run

import nsde_torch

JOINTS = "double_pendulum:DoublePendulum"
SPRING, CART = "mass_spring_damper", "cartpole"
VALUES = {SPRING: {"k": 4.0, "b": 0.5, "g": 1.0}, CART: {"g": 1.0, "s": 0.3, "l": 0.5}}
NOISE = {SPRING: (0.001, 0.003), CART: (0.0005, 0.005, 0.001, 0.01)}
GROUND, SQUARE = {"area": 0.03, "height": 0.2}, {"drag": [0.08, 0.08, 0.05]}
PLANTS: dict[str, tuple[str, dict[str, Any], list[Any]]] = {
    "spring: nothing": (SPRING, {}, []),
    "spring: dry friction": (SPRING, {"coulomb": {"size": 0.15}}, ["coulomb_friction"]),
    "spring: quadratic damping": (SPRING, {"quadratic": {"size": 0.3}}, ["quadratic_damping"]),
    "spring: hardening": (SPRING, {"hardening": {"size": 0.8}}, ["cubic_stiffness"]),
    "spring: damping by place": (SPRING, {"damping_by_place": {"size": 0.5}}, ["force = c1 q^2 q_dot"]),
    "spring: slope": (SPRING, {"slope": {"size": 0.4}}, [{"force = c1 sin(k1 q)": {"k1": 2.0}}]),
    "cart: nothing": (CART, {}, []),
    "cart: dry friction": (CART, {"coulomb": {"size": 0.4}}, ["coulomb_friction[cart]"]),
    "cart: quadratic damping": (CART, {"quadratic": {"size": 0.5}}, ["quadratic_damping[cart]"]),
    "cart: slope": (CART, {"slope": {"size": 0.4}}, [{"force = c1 sin(k1 x)": {"k1": 2.0}}]),
    "hexacopter: nothing": ("hexacopter", {}, []),
    "hexacopter: ground effect": ("hexacopter", {"ground_effect": GROUND}, ["ground_effect"]),
    "hexacopter: linear drag": ("hexacopter", {"linear_drag": {"drag": [0.15, 0.15, 0.1]}}, ["linear_drag"]),
    "hexacopter: lag": ("hexacopter", {"motor_lag": {"time_constant": 0.05}}, ["motor_lag"]),
    "hexacopter: coupling": ("hexacopter", {"law": {"of": "coupling"}}, ["body_force[y] = c1 v_body_x w_z"]),
    "quadrotor: nothing": ("quadrotor", {}, []),
    "quadrotor: ground effect": ("quadrotor", {"ground_effect": GROUND}, ["ground_effect"]),
    "quadrotor: quadratic drag": ("quadrotor", {"quadratic_drag": SQUARE}, ["quadratic_drag"]),
    "quadrotor: flapping": ("quadrotor", {"flapping_moment": {"gain": [1.5, 1.5]}}, ["flapping_moment"]),
    "joints: nothing": (JOINTS, {}, []),
    "joints: dry friction": (JOINTS, {"dry": 0.1}, ["coulomb_friction[q1]"]),
    "joints: quadratic damping": (JOINTS, {"quadratic": 0.03}, ["quadratic_damping[q1]"]),
    "joints: damping by place": (JOINTS, {"by_place": 0.15}, ["torque[q1] = c1 q1^2 q1_dot"]),
}
"""Machine, what it holds, and the law of the catalogue that this is."""
SECONDS, RUNS, DT = 12.0, 5, 0.01
FLIGHT_S, PATHS = 30.0, ("waypoints", "circle", "sines", "waypoints", "sines")


TORQUES = {
    "dry": lambda size, q, w: -size * np.tanh(w / 0.02),
    "quadratic": lambda size, q, w: -size * abs(w) * w,
    "by_place": lambda size, q, w: -size * q * q * w,
}
"""What acts on the first joint [N m]."""


MULTIROTORS = {
    "hexacopter": (4.9, -0.8, (95.0, 90.0, 4.0), (0.55, 0.58)),
    "quadrotor": (6.5, -0.8, (58.0, 56.0, 3.0), (0.52, 0.5)),
}


def write(folder: Path, system: str, effects: dict[str, Any], seed: int) -> None:
    if system in MULTIROTORS:
        held = {"law": {"of": Law(KINDS[system][3], 0.8)}} if "law" in effects else effects
        machine = Machine(system, *MULTIROTORS[system], held, (0.05, 0.05, 0.05, 0.5, 0.5, 0.1))
        for i, flight in enumerate(flights(machine, seed, FLIGHT_S, PATHS, 0.5)):
            names = columns("multirotor", flight.u.shape[1])
            save(folder / f"run_{i}.csv", names, [flight.t + 100.0 * i, flight.x, flight.u])
        return
    if system == JOINTS:

        def push(q: np.ndarray, w: np.ndarray) -> np.ndarray:
            return np.array([sum(TORQUES[name](size, q[0], w[0]) for name, size in effects.items()), 0.0])

        make_data.write(folder, push, seed=seed, runs=RUNS, seconds=SECONDS, noise=1.0)
        return
    small = Small(system, VALUES[system], effects, NOISE[system], gust=0.02)
    for i in range(RUNS):
        t, y, u = run(small, SECONDS, DT, seed=7919 * seed + i)
        save(folder / f"run_{i}.csv", columns(system), [t + 100 * i, y, u], "%.7f")


def left(data: Any, system: str, run_dir: Path, model: str, effects: list[Any]) -> tuple[float, Any]:
    """Sum of the logarithms of what is left of the rates of the held-out run, and what `metrics.json` holds."""
    nsde_torch.train(data, system=system, model=model, effects=effects, run_dir=run_dir, say=False)
    metrics = read_json(run_dir / "metrics.json")
    return sum(log(channel["residual"]) for channel in metrics["test"]["one_step"].values()), metrics


def main() -> None:
    parser = options(__doc__, seeds=3, out=None)
    parser.add_argument("--plants", nargs="*", default=list(PLANTS), choices=list(PLANTS))
    a = parser.parse_args()
    rows: dict[str, list[tuple[float, float]]] = {}
    for name in a.plants:
        system, effects, law = PLANTS[name]
        for seed in range(1, a.seeds + 1):
            with tempfile.TemporaryDirectory() as at:
                folder = Path(at)
                write(folder, system, effects, seed)
                data = nsde_torch.read(folder, system=system)
                out = a.out or folder / "models"
                place = out / f"{name.replace(': ', '_').replace(' ', '_')}_{seed}"
                declared, _ = left(data, system, place / "declared", "sysid", [])
                networks, metrics = left(data, system, place / "networks", "nsde", [])
                whole = left(data, system, place / "whole", "sysid", law)[0] if law else declared
                kept = {k: n for k, n in metrics["innovations"]["networks"].items() if n["kept"]}
                learned = {k: n.get("variables") for k, n in kept.items()}
                won = declared - networks, declared - whole
                rows.setdefault(name, []).append(won)
                print(f"{name}, seed {seed}: {won[0]:.3f} of {won[1]:.3f}, {learned}", flush=True)
    print()
    head("plant", "networks", "the law itself", "share")
    for name, won in rows.items():
        got, most = np.array(won).T
        each = got / most if PLANTS[name][2] else got * np.nan
        share = f"{each.mean():.2f} ({each.min():.2f} to {each.max():.2f})" if PLANTS[name][2] else ""
        print(line([name, f"{got.mean():.3f}", f"{most.mean():.3f}", share]))


if __name__ == "__main__":
    main()
