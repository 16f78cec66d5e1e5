"""Ties of two members, broken by one designed experiment or by the usual ones of the same length and limits.

    python benchmarks/blind/design_ties.py --machine spring --seed 1 --count 12 --out runs/ties

Every case is another machine: which member is true, its sizes and the runs there are. The runs are made ever smaller
until they do not tell the members apart (less than 3 nats), as ties of a diagnosis are. Then one experiment is
designed from the runs alone, as long as one of them and within `--wider` times what they held, flown once by the
plant of the package, which integrates, delays and measures by itself, and fitted with the runs; the multisine, the
chirp, the doublets and the longest run again are flown beside it, each at the size that its own design judged best.
An experiment breaks the tie where it brings the truth more than 3 nats against the other member. One line of JSON a
case; `--report` sums up a folder.

Some ties nothing breaks within their limits. An oracle says which: a longer search that knows which member is true and
its sizes, and is worth what it tells at these alone. Where it expects less than 3 nats, and nothing that was flown
broke the tie either, no experiment of this length and within these limits is to be had.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from design_oracle import Array, Json, oracle
from study import appended

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import DesignOptions, Experiment, Question, design
from nsde_torch.design.experiment import write_plan
from nsde_torch.design.limits import limits_of
from nsde_torch.design.members import members_of, open_loop
from nsde_torch.design.proposals import Signals
from nsde_torch.design.questions import SURE
from nsde_torch.design.rehearsal import against, fit_all
from nsde_torch.systems import System
from nsde_torch.systems.options import system_options

SYSTEMS = {"spring": "mass_spring_damper", "cart": "cartpole"}
KINDS = ("bias", "late", "drag")
_SMALLER = (
    (1.0, 8.0, 1.0),
    (0.5, 6.0, 1.0),
    (0.25, 4.0, 1.0),
    (0.25, 4.0, 2.0),
    (0.15, 4.0, 4.0),
    (0.15, 3.0, 8.0),
)
LADDER: dict[str, tuple[tuple[float, float, float], ...]] = {
    "bias": (
        (1.0, 8.0, 1.0),
        (1.5, 6.0, 1.0),
        (2.0, 5.0, 1.0),
        (2.0, 4.0, 2.0),
        (3.0, 4.0, 4.0),
        (3.0, 3.0, 8.0),
    ),
    "late": _SMALLER,
    "drag": _SMALLER,
}
"""Size of the forces, length [s] and noise of the runs there are, tried in turn until the members are tied."""
DT = 0.02
ORACLE = (192, 14)
"""Proposals and generations of the oracle's search."""


def case(
    machine: str, kind: str, rng: np.random.Generator
) -> tuple[Json, tuple[Json, Json], tuple[str, ...] | None]:
    """Effects of both members with the sizes that they have where they are true, and the declared physics."""
    at = "" if machine == "spring" else "[cart]"
    size = float(np.exp(rng.uniform(np.log(0.08), np.log(0.3))))
    bias = float(size * rng.uniform(0.2, 0.5) * rng.choice([-1.0, 1.0]))
    late = float(rng.uniform(0.04, 0.1))
    width = float(rng.uniform(0.01, 0.03))
    if kind == "bias":
        dry = {"size": size, "width": width}
        return (
            {},
            (
                {f"coulomb_friction{at}": dry, f"constant_force{at}": {"acceleration": bias}},
                {
                    f"asymmetric_friction{at}": {
                        "size_forward": size - bias,
                        "size_backward": size + bias,
                        "width": width,
                    }
                },
            ),
            None,
        )
    if kind == "late":
        return {}, ({"actuator_lag": {"time_constant": late}}, {"input_delay": {"delay": late}}), None
    drag = float(rng.uniform(0.2, 0.6))
    declared = ("linear_spring",) if machine == "spring" else None
    return (
        {},
        (
            {f"viscous_friction{at}": {"damping": drag}},
            {f"quadratic_damping{at}": {"damping": 2.0 * drag}},
        ),
        declared,
    )


def runs_there_are(
    machine: str,
    truth: Json,
    declared: tuple[str, ...] | None,
    size: float,
    duration: float,
    noise: float,
    seed: int,
) -> Any:
    """Two runs of the true machine under forces `size` times as large as usual."""
    parameters: Json = {}
    if machine == "spring":
        options: Json = {"force_size": 0.5 * size, "region": [[-0.3 * size, 0.3 * size]] * 2}
        if declared is not None and "viscous_friction" not in truth:
            parameters = {"viscous_friction": {"damping": 1e-9}}
    shared: Json = {
        "effects": [{k: v} for k, v in truth.items() if k != "viscous_friction"],
        "parameters": {**parameters, **{k: v for k, v in truth.items() if k == "viscous_friction"}},
        "sensor_noise": noise,
        "dt": DT,
    }
    if machine == "spring":
        return nsde_torch.simulate(
            SYSTEMS[machine], durations=[duration] * 2, seed=seed, options=options, **shared
        ).runs
    runs = []
    rng = np.random.default_rng([seed, 5])
    t = DT * np.arange(round(duration / DT) + 1)
    for i in range(2):
        f = np.exp(rng.uniform(np.log(0.1), np.log(2.0), (6, 1)))
        wave = np.sin(2 * np.pi * (f * t + rng.uniform(size=(6, 1)))).sum(0) / 3.0
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "plan.csv"
            write_plan(file, ("force",), np.column_stack((t, 6.0 * size * wave)))
            hanging = {"start": {"theta": np.pi}}
            made = nsde_torch.simulate(
                SYSTEMS[machine], seed=seed + 500 * i, plan=file, options=hanging, **shared
            )
        runs.append(replace(made.runs[0], name=f"run_{i}"))
    return runs


def flown(
    machine: str,
    truth: Json,
    declared: tuple[str, ...] | None,
    table: Array,
    e: Experiment,
    noise: float,
    seed: int,
) -> Run:
    """A plan flown once by the true machine."""
    parameters: Json = {k: v for k, v in truth.items() if k == "viscous_friction"}
    if declared is not None and not parameters:
        parameters = {"viscous_friction": {"damping": 1e-9}}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.csv"
        write_plan(file, tuple(e.given), replace(e, plan=replace(e.plan, table=table)).rows())
        made = nsde_torch.simulate(
            SYSTEMS[machine],
            effects=[{k: v} for k, v in truth.items() if k != "viscous_friction"],
            parameters=parameters,
            seed=seed,
            sensor_noise=noise,
            dt=DT,
            plan=file,
            options={"start": dict(zip(e.system.state_names, e.start.tolist(), strict=True))},
        )
    raw = made.runs[0]
    return Run(raw.name, raw.t, raw.x, raw.u)


def one(machine: str, kind: str, seed: int, wider: float) -> Json:
    """One case, within limits `wider` times what the runs held."""
    began = time.perf_counter()
    rng = np.random.default_rng([seed, 77])
    _, both, declared = case(machine, kind, rng)
    right = int(rng.integers(2))
    truth = both[right]
    system: System = system_options(SYSTEMS[machine], declared=declared).make()
    question = Question(tuple(tuple(system.effect_key(e) for e in m) for m in both))
    out: Json = {"machine": machine, "kind": kind, "seed": seed, "truth": list(truth), "sizes": truth}
    for size, duration, noise in LADDER[kind]:
        raw = runs_there_are(machine, truth, declared, size, duration, noise, seed)
        runs = [Run(r.name, r.t, r.x, r.u) for r in raw]
        members = members_of(system, runs, question, {}, clock=1.0)
        there = members[right].nats - members[1 - right].nats
        if abs(there) < SURE:
            break
    out |= {
        "size": size,
        "duration_s": duration,
        "noise": noise,
        "nats_there": there,
        "tied": abs(there) < SURE,
    }
    if not out["tied"]:
        return out
    options = DesignOptions(
        limits=_wider(system, runs, wider),
        hertz=(0.2, 5.0),
        samples=3,
        proposals=120,
        generations=12,
        rehearsals=6,
        seed=seed,
    )
    e = design(system, runs, question, options)
    assert e.hertz is not None
    family = Signals(e.limits, DT, round(duration / DT), e.hertz)
    told, plan = oracle(
        e, right, truth, family, open_loop, budget=ORACLE, before=max(runs, key=len).u, seed=seed
    )
    out["designed_s"] = e.seconds
    out |= {"words": list(e.plan.words), "kind_of_plan": e.plan.name, "wider": wider}
    tables = {"the plan" if p is e.plan else p.name: p.table for p in (e.plan, *e.baselines)}
    hoped = {"the plan" if p is e.plan else p.name: p.nats(right) for p in (e.plan, *e.baselines)}
    if plan is not None:
        tables["the oracle's"], hoped["the oracle's"] = plan, {"mean": told}
    out["oracle"] = told
    measured = {
        name: flown(machine, truth, declared, table, e, noise, 1000 * seed + i)
        for i, (name, table) in enumerate(tables.items())
    }
    fits = fit_all(e.members, list(measured.values()))
    plans: Json = {}
    for i, (name, fit) in enumerate(zip(tables, fits, strict=True)):
        seen = flown(machine, truth, declared, tables[name], e, 0.0, 1000 * seed + i)
        plans[name] = {
            "obtained": against(fit.brought, right),
            "expected": hoped[name],
            "use": float(e.limits.use(seen.x).max()),
            "excess": fit.excess,
        }
    out["plans"] = plans
    out["seconds"] = time.perf_counter() - began
    return out


def _wider(system: System, runs: Any, factor: float) -> Json:
    """Limits about the middle of what the runs held."""
    held = limits_of(system, runs, {})
    names = [*held.inputs, *held.states]
    low, high = np.append(held.low, held.floor), np.append(held.high, held.ceiling)
    middle, half = 0.5 * (low + high), 0.5 * factor * (high - low)
    return {n: [m - h, m + h] for n, m, h in zip(names, middle.tolist(), half.tolist(), strict=True)}


def _breakable(row: Json) -> bool:
    """Whether the oracle expects enough, or anything that was flown broke the tie."""
    return bool(row["oracle"] > SURE or max(p["obtained"] for p in row["plans"].values()) > SURE)


def report(folder: Path) -> str:
    """A table of all cases in a folder."""
    rows = [
        json.loads(line) for file in sorted(folder.glob("*.jsonl")) for line in file.read_text().splitlines()
    ]
    tied = [r for r in rows if r["tied"]]
    names = list(dict.fromkeys(n for r in tied for n in r["plans"]))
    out = [f"{len(rows)} cases, {len(tied)} tied by the runs there are"]
    for machine, kind in [("", ""), *sorted({(r["machine"], r["kind"]) for r in tied})]:
        some = [r for r in tied if machine in ("", r["machine"]) and kind in ("", r["kind"])]
        able = [r for r in some if _breakable(r)]
        broken = sum(r["plans"]["the plan"]["obtained"] > SURE for r in able)
        out.append(
            f"{machine or 'all'} {kind}: {len(some)} cases; {len(able)} that something breaks within the limits, "
            f"the plan {broken} of them"
        )
        for name in names:
            # where a usual experiment was the best, it is the plan
            same = [
                r["plans"].get(name) or (r["plans"]["the plan"] if r["kind_of_plan"] == name else None)
                for r in some
            ]
            got = [g for g in same if g is not None]
            if not got:
                continue
            nats = np.array([g["obtained"] for g in got])
            hoped = np.array([g["expected"]["mean"] for g in got])
            near = (nats > 0.5 * hoped) & (nats < 2.0 * hoped)
            out.append(
                f"  {name:24s} breaks {np.sum(nats > SURE)}/{len(some)}, wrong {np.sum(nats < -SURE)}; "
                f"median {np.median(nats):.1f} nats "
                f"(quartiles {np.quantile(nats, 0.25):.1f}, {np.quantile(nats, 0.75):.1f}), "
                f"expected median {np.median(hoped):.1f}; within a factor of two {near.mean():.0%}; left limits "
                f"{sum(g['use'] > 1 for g in got)}"
            )
    return "\n".join(out)


def main() -> None:
    """Run cases, or sum them up."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machine", choices=tuple(SYSTEMS), default="spring")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--wider", type=float, default=2.0, help="limits over what the runs held")
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if not args.report:
        appended(
            args.out / f"{args.machine}_{args.seed}.jsonl",
            (
                partial(one, args.machine, KINDS[i % len(KINDS)], args.seed + i, args.wider)
                for i in range(args.count)
            ),
            lambda found: f"{found['machine']} {found['kind']} {found['seed']}: tied {found['tied']}",
        )
    print(report(args.out))


if __name__ == "__main__":
    main()
