"""Ties of multirotors, broken by one designed flight or by the usual ones of the same length and limits.

    python benchmarks/blind/design_flights.py --seed 1 --count 5 --out runs/flights

As `design_ties`, in closed loop: every case is a quadrotor with one of two members true, its sizes and two gentle
flights of constant heading, made ever smaller until they do not tell the members apart. One flight is designed from
them, as long as one of them, within a room of 6 x 6 x 3 m, 5 m/s and 4 rad/s. It and the usual flights are flown once
by the plant of the package, in gusts of their own, by a cascade that knows the declared physics alone.

    drag    drag in proportion to speed against its square
    late    motors that lag against a delay
    weak    one weak motor against an offset mass
    wind    drag with a steady wind against drag and a tilted thrust

Payload against thrust is none: the physics of a multirotor is per mass, so both are the one number `thrust_gain`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from design_oracle import Array, Json, oracle
from design_ties import report
from study import appended

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import DesignOptions, Question, design
from nsde_torch.design.experiment import write_plan
from nsde_torch.design.flown import evidence
from nsde_torch.design.members import members_of
from nsde_torch.design.paths import Paths, flown_paths, point_times
from nsde_torch.design.questions import SURE
from nsde_torch.design.rehearsal import against, fit_all
from nsde_torch.systems import Multirotor
from nsde_torch.systems.options import system_options

MACHINE = "quadrotor"
KINDS = ("drag", "late", "weak", "wind")
LADDER = ((1.2, 8.0), (0.6, 8.0), (0.3, 8.0), (0.1, 8.0), (0.1, 5.0), (0.1, 3.0))
"""Half-width of the room [m] and length [s] of the flights there are, tried in turn until the members are tied."""
LIMITS: Json = {
    **{"p_x": [-3.0, 3.0], "p_y": [-3.0, 3.0], "p_z": [0.5, 3.5]},
    **{f"v_{axis}": [-5.0, 5.0] for axis in "xyz"},
    **{f"w_{axis}": [-4.0, 4.0] for axis in "xyz"},
}
ORACLE = (40, 4)
"""Proposals and generations of the oracle's search."""
COLUMNS = ("p_x", "p_y", "p_z", "yaw")


def case(kind: str, rng: np.random.Generator) -> tuple[Json, Json]:
    """Effects of both members with the sizes that they have where they are true."""
    size = float(rng.uniform(0.2, 0.6))
    drag = [size, size, 0.4 * size]
    angle = float(rng.uniform(0.0, 2.0 * np.pi))
    way = np.array([np.cos(angle), np.sin(angle)])
    if kind == "drag":
        return {"linear_drag": {"drag": drag}}, {"quadratic_drag": {"drag": drag}}
    if kind == "late":
        late = float(rng.uniform(0.02, 0.05))
        return {"motor_lag": {"time_constant": late}}, {"input_delay": {"delay": late}}
    if kind == "weak":
        loss = np.zeros(4)
        loss[rng.integers(4)] = rng.uniform(0.04, 0.12)
        return (
            {"motor_efficiency_loss": {"loss": loss.tolist()}},
            {"com_offset": {"offset": (float(rng.uniform(0.05, 0.2)) * way).tolist()}},
        )
    wind = float(rng.uniform(1.0, 3.0))
    return (
        {"constant_wind": {"drag": drag, "wind": (wind * way).tolist()}},
        {
            "linear_drag": {"drag": drag},
            "thrust_misalignment": {"tilt": (size * wind / 9.81 * way).tolist()},
        },
    )


def flown(truth: Json, rows: Array, seed: int) -> Run:
    """A path through points (K, 5), flown once by the true machine."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.csv"
        write_plan(file, COLUMNS, rows)
        made = nsde_torch.simulate(
            MACHINE, effects=[{k: v} for k, v in truth.items()], declared_only=True, seed=seed, plan=file
        )
    raw = made.runs[0]
    return Run(raw.name, raw.t, raw.x, raw.u)


def runs_there_are(truth: Json, room: float, duration: float, seed: int) -> list[Run]:
    """Two gentle flights through a room, nose forward."""
    rng = np.random.default_rng([seed, 5])
    t = point_times(duration)
    runs = []
    for i in range(2):
        points = np.zeros((len(t), 4))
        for axis, most in enumerate((room, room, 0.5 * room)):
            f = rng.uniform(0.08, 0.2, 2)[:, None]
            points[:, axis] = most * np.sin(2 * np.pi * (f * t + rng.uniform(size=(2, 1)))).mean(0)
        points[:, 2] += 2.0
        run = flown(truth, np.column_stack((t, points)), 1000 * seed + 500 + i)
        runs.append(replace(run, name=f"run_{i}"))
    return runs


def one(kind: str, seed: int) -> Json:
    """One case."""
    began = time.perf_counter()
    rng = np.random.default_rng([seed, 78])
    both = case(kind, rng)
    right = int(rng.integers(2))
    truth = both[right]
    system = system_options(MACHINE).make()
    assert isinstance(system, Multirotor)
    question = Question(tuple(tuple(system.effect_key(e) for e in m) for m in both))
    out: Json = {"machine": MACHINE, "kind": kind, "seed": seed, "truth": list(truth), "sizes": truth}
    for room, duration in LADDER:
        runs = runs_there_are(truth, room, duration, seed)
        members = members_of(system, runs, question, {}, clock=1.0)
        there = members[right].nats - members[1 - right].nats
        if abs(there) < SURE:
            break
    out |= {"room": room, "duration_s": duration, "nats_there": there, "tied": abs(there) < SURE}
    if not out["tied"]:
        return out
    options = DesignOptions(
        limits=LIMITS, duration=duration, samples=3, proposals=20, generations=4, rehearsals=6, seed=seed
    )
    e = design(system, runs, question, options)
    out |= {"designed_s": e.seconds, "words": list(e.plan.words), "kind_of_plan": e.plan.name}
    tables = {"the plan" if p is e.plan else p.name: p.table for p in (e.plan, *e.baselines)}
    hoped = {"the plan" if p is e.plan else p.name: p.nats(right) for p in (e.plan, *e.baselines)}
    family = Paths(e.limits, e.dt, len(e.plan.table), e.start)
    told, best = oracle(
        e,
        right,
        truth,
        family,
        partial(flown_paths, system=system, dt=e.dt),
        budget=ORACLE,
        before=max(runs, key=len).x[:, :3],
        seed=seed,
    )
    out["oracle"] = told
    if best is not None:
        tables["the oracle's"], hoped["the oracle's"] = best, {"mean": told}
    plans: Json = {}
    for i, (name, table) in enumerate(tables.items()):
        run = flown(truth, replace(e, plan=replace(e.plan, table=table)).rows(), 1000 * seed + i)
        fit = fit_all(e.members, [run])[0]
        told = evidence(system, e.members, [fit], runs, [run], question, {}, clock=1.0)
        plans[name] = {
            "obtained": against(told, right),
            "obtained_by_quadratics": against(fit.brought, right),
            "expected": hoped[name],
            "use": float(np.nanmax(e.limits.use(run.x))),
            "excess": fit.excess,
        }
    return out | {"plans": plans, "seconds": time.perf_counter() - began}


def main() -> None:
    """Run cases, or sum them up."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if not args.report:
        appended(
            args.out / f"flights_{args.seed}.jsonl",
            (partial(one, args.kinds[i % len(args.kinds)], args.seed + i) for i in range(args.count)),
            lambda found: f"{found['kind']} {found['seed']}: tied {found['tied']}",
        )
    print(report(args.out))


if __name__ == "__main__":
    main()
