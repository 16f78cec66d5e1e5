"""How much of what an undeclared law explains the networks of a neural SDE learn beside declared physics.

    python benchmarks/bench_networks.py --seeds 3 --out networks/

Plants are of simulators of their own (`blind/small_machines.py`, `examples/double_pendulum/make_data.py`,
`blind/loop_machine.py`: flights in a closed loop). Each is trained as `nsde train` does, beside it the declared physics
alone and the physics with the law declared (`model=sysid`). The share is that of the logarithm of what
they leave of the rates of a run held out, means over 0.25 s:

    log(without / networks) / log(without / with)

Plants without a law are nulls: the logarithm itself is what is lost there.
"""

from __future__ import annotations

import tempfile
from math import log
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import STATES, options, read_json, save
from law_machines import KINDS, Law, flights, make_data
from loop_machine import Machine
from small_machines import Small, columns, run

import nsde_torch

JOINTS = "double_pendulum:DoublePendulum"
SPRING, CART = {"k": 4.0, "b": 0.5, "g": 1.0}, {"g": 1.0, "s": 0.3, "l": 0.5}
PLANTS: dict[str, tuple[str, dict[str, Any], list[Any]]] = {
    "spring: nothing": ("mass_spring_damper", {}, []),
    "spring: dry friction": ("mass_spring_damper", {"coulomb": {"size": 0.15}}, ["coulomb_friction"]),
    "spring: quadratic damping": ("mass_spring_damper", {"quadratic": {"size": 0.3}}, ["quadratic_damping"]),
    "spring: hardening": ("mass_spring_damper", {"hardening": {"size": 0.8}}, ["cubic_stiffness"]),
    "spring: damping by place": (
        "mass_spring_damper",
        {"damping_by_place": {"size": 0.5}},
        ["force = c1 q^2 q_dot"],
    ),
    "spring: slope": (
        "mass_spring_damper",
        {"slope": {"size": 0.4}},
        [{"force = c1 sin(k1 q)": {"k1": 2.0}}],
    ),
    "cart: nothing": ("cartpole", {}, []),
    "cart: dry friction": ("cartpole", {"coulomb": {"size": 0.4}}, ["coulomb_friction[cart]"]),
    "cart: quadratic damping": ("cartpole", {"quadratic": {"size": 0.5}}, ["quadratic_damping[cart]"]),
    "cart: slope": ("cartpole", {"slope": {"size": 0.4}}, [{"force = c1 sin(k1 x)": {"k1": 2.0}}]),
    "hexacopter: nothing": ("hexacopter", {}, []),
    "hexacopter: ground effect": (
        "hexacopter",
        {"ground_effect": {"area": 0.03, "height": 0.2}},
        ["ground_effect"],
    ),
    "hexacopter: linear drag": ("hexacopter", {"linear_drag": {"drag": [0.15, 0.15, 0.1]}}, ["linear_drag"]),
    "hexacopter: lag": ("hexacopter", {"motor_lag": {"time_constant": 0.05}}, ["motor_lag"]),
    "hexacopter: coupling": ("hexacopter", {"law": {"of": "coupling"}}, ["body_force[y] = c1 v_body_x w_z"]),
    "quadrotor: nothing": ("quadrotor", {}, []),
    "quadrotor: ground effect": (
        "quadrotor",
        {"ground_effect": {"area": 0.03, "height": 0.2}},
        ["ground_effect"],
    ),
    "quadrotor: quadratic drag": (
        "quadrotor",
        {"quadratic_drag": {"drag": [0.08, 0.08, 0.05]}},
        ["quadratic_drag"],
    ),
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


def write_joints(folder: Path, effects: dict[str, Any], seed: int) -> None:
    """Runs of a double pendulum as files."""

    def push(q: np.ndarray, w: np.ndarray) -> np.ndarray:
        return np.array([sum(TORQUES[name](size, q[0], w[0]) for name, size in effects.items()), 0.0])

    make_data.write(folder, push, seed=seed, runs=RUNS, seconds=SECONDS, noise=1.0)


MULTIROTORS = {
    "hexacopter": (4.9, -0.8, (95.0, 90.0, 4.0), (0.55, 0.58)),
    "quadrotor": (6.5, -0.8, (58.0, 56.0, 3.0), (0.52, 0.5)),
}


def write_flights(folder: Path, system: str, effects: dict[str, Any], seed: int) -> None:
    """Flights of a multirotor as files."""
    held = {"law": {"of": Law(KINDS[system][3], 0.8)}} if "law" in effects else effects
    gust = (0.05, 0.05, 0.05, 0.5, 0.5, 0.1)
    machine = Machine(system, *MULTIROTORS[system], held, gust)
    for i, run_of in enumerate(flights(machine, seed, FLIGHT_S, PATHS, 0.5)):
        names = ("t", *STATES["multirotor"], *(f"u_{k + 1}" for k in range(run_of.u.shape[1])))
        save(folder / f"run_{i}.csv", names, [run_of.t + 100.0 * i, run_of.x, run_of.u])


def write(folder: Path, system: str, effects: dict[str, Any], seed: int) -> None:
    """Runs of a plant as files."""
    if system in MULTIROTORS:
        return write_flights(folder, system, effects, seed)
    if system == JOINTS:
        return write_joints(folder, effects, seed)
    values = SPRING if system == "mass_spring_damper" else CART
    noise = (0.001, 0.003) if system == "mass_spring_damper" else (0.0005, 0.005, 0.001, 0.01)
    machine = Small(system, values, effects, noise, gust=0.02)
    for i in range(RUNS):
        t, y, u = run(machine, SECONDS, DT, seed=7919 * seed + i)
        save(folder / f"run_{i}.csv", columns(system), [t + 100 * i, y, u], "%.7f")


def left(
    data: Any, system: str, run_dir: Path, model: str, effects: list[Any]
) -> tuple[float, dict[str, Any]]:
    """Sum of the logarithms of what is left of the rates of the held-out run, and what `metrics.json` holds."""
    nsde_torch.train(data, system=system, model=model, effects=effects, run_dir=run_dir, say=False)
    metrics = read_json(run_dir / "metrics.json")
    return sum(log(channel["residual"]) for channel in metrics["test"]["one_step"].values()), metrics


def main() -> None:
    parser = options(__doc__, seeds=3, out=None)
    parser.add_argument("--plants", nargs="*", default=list(PLANTS), choices=list(PLANTS))
    a = parser.parse_args()
    torch.set_num_threads(1)
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
                learned = {
                    k: n.get("variables") for k, n in metrics["innovations"]["networks"].items() if n["kept"]
                }
                rows.setdefault(name, []).append((declared - networks, declared - whole))
                print(
                    f"{name}, seed {seed}: {declared - networks:.3f} of {declared - whole:.3f}, {learned}",
                    flush=True,
                )
    print("\n| plant | networks | the law itself | share |\n|---|---|---|---|")
    for name, won in rows.items():
        got, most = np.array(won).T
        each = got / most if PLANTS[name][2] else got * np.nan
        share = f"{each.mean():.2f} ({each.min():.2f} to {each.max():.2f})" if PLANTS[name][2] else ""
        print(f"| {name} | {got.mean():.3f} | {most.mean():.3f} | {share} |")


if __name__ == "__main__":
    main()
