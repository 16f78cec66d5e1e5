"""Ties of two members, broken by one designed experiment or by the usual ones of the same length and limits.

    python benchmarks/blind/design_ties.py --machine spring --seed 1 --count 12 --out runs/ties
    python benchmarks/blind/design_ties.py --machine quadrotor --seed 1 --count 5 --out runs/flights

Every case is another machine: which member is true, its sizes and the runs there are. The runs are made ever smaller
until they do not tell the members apart (less than 3 nats), as ties of a diagnosis are. Then one experiment is
designed from the runs alone, as long as one of them and within `--wider` times what they held, flown once by the
plant of the package, and fitted with the runs; the usual ones are flown beside it, each at the size that its own design
judged best. An experiment breaks the tie where it brings the truth more than 3 nats against the other member. An
oracle, a longer search that knows the truth, says which ties nothing breaks. `--count 0` sums up a folder.

Kinds of springs and carts are `bias` (dry friction with a force, or of unequal size), `late` (a lag or a delay) and
`drag` (in proportion to speed, or its square). Quadrotors fly in closed loop, in gusts of their own, by a cascade that
knows the declared physics alone. Their kinds are `drag`, `late`, `weak` (one weak motor, or an offset mass) and `wind`
(drag with a steady wind, or drag and a tilted thrust).
"""

import contextlib
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from study import Array, Json, answers, labelled, options

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import DesignOptions, Experiment, Question, design
from nsde_torch.design.experiment import write_plan
from nsde_torch.design.flown import evidence
from nsde_torch.design.limits import limits_of
from nsde_torch.design.members import Drive, Rollouts, members_of, open_loop
from nsde_torch.design.paths import Paths, flown_paths, point_times
from nsde_torch.design.proposals import Family, Judged, Separation, Signals, best_of_each, search
from nsde_torch.design.questions import SURE
from nsde_torch.design.rehearsal import against, fit_all
from nsde_torch.errors import ConfigError
from nsde_torch.systems import System
from nsde_torch.systems.options import system_options

Effects = dict[str, dict[str, Any]]
DT = 0.02


class Oracle:
    """Judges experiments at the truth, by a design's members, limits and start."""

    def __init__(self, e: Experiment, right: int, truth: Effects, drive: Callable[[Array], Drive]) -> None:
        member, self._theta = e.members[right], e.members[right].theta.copy()
        self.limits, self._start, self._drive = e.limits, e.start, drive
        self._rollouts = Rollouts(member.system, dt=member.log.dt)
        self._pair = Separation(member, e.members[1 - right])
        known = dict(labelled(truth))
        for i, label in enumerate(member.vector.labels):
            self._theta[i] = known.get(label, self._theta[i])

    def judge(self, tables: Array) -> Judged:
        c = len(tables)
        starts = (np.tile(one, (c, 1)) for one in (self._theta, self._start))
        x, _, u = self._rollouts.run(*starts, self._drive(tables), tables.shape[1])
        use = self.limits.use(x)
        fine = np.nan_to_num(use, nan=np.inf).max(1) <= 1.0
        nats = np.full(c, -np.inf)
        if fine.any():
            nats[fine] = self._pair.nats(x[None, fine], u[None, fine], self._theta[None])[0]
        return Judged(nats, nats, use)

    def best(
        self, family: Family, budget: tuple[int, int], before: Array, seed: int
    ) -> tuple[float, Array | None]:
        """The most that an experiment is worth [nats] to one who knows the truth, and its rows.

        A longer search (`budget`: proposals and generations) than a design's, with the same proposals; `before` are
        inputs or places of a run there is.
        """
        rng = np.random.default_rng([seed, 13])
        plans = best_of_each(self, family.baselines(rng, before))
        how: Json = {"proposals": budget[0], "generations": budget[1], "keep": 1, "rng": rng}
        with contextlib.suppress(ConfigError):
            plans += search(self, family, say=lambda stage, done, total: None, **how)[0]
        best = max(plans, key=lambda p: p.worth, default=None)
        return (0.0, None) if best is None else (best.worth, best.table)


def planned(system: str, names: tuple[str, ...], rows: Array, seed: int, **how: Any) -> Run:
    """A plan run once by the plant of the package."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.csv"
        write_plan(file, names, rows)
        raw = nsde_torch.simulate(system, seed=seed, plan=file, **how).runs[0]
    return Run(raw.name, raw.t, raw.x, raw.u)


class Small:
    seed = 77
    kinds: Sequence[str] = ("bias", "late", "drag")
    oracle = (192, 14)
    quiet = True  # whether the states that limits are of are simulated again without noise of the sensors
    smaller = ((1, 8, 1), (0.5, 6, 1), (0.25, 4, 1), (0.25, 4, 2), (0.15, 4, 4), (0.15, 3, 8))
    larger = ((1, 8, 1), (1.5, 6, 1), (2, 5, 1), (2, 4, 2), (3, 4, 4), (3, 3, 8))
    """Size of the forces, length [s] and noise of the runs there are, tried in turn until the members are tied."""

    def __init__(self, name: str) -> None:
        self.spring = name == "spring"
        self.name = "mass_spring_damper" if self.spring else "cartpole"

    def case(self, kind: str, rng: np.random.Generator) -> tuple[Effects, Effects]:
        """Effects of both members with the sizes that they have where they are true."""
        self.ladder = self.larger if kind == "bias" else self.smaller
        self.declared = ("linear_spring",) if kind == "drag" and self.spring else None
        at = "" if self.spring else "[cart]"
        size = float(np.exp(rng.uniform(np.log(0.08), np.log(0.3))))
        bias = float(size * rng.uniform(0.2, 0.5) * rng.choice([-1.0, 1.0]))
        late, width = float(rng.uniform(0.04, 0.1)), float(rng.uniform(0.01, 0.03))
        if kind == "bias":
            dry = {f"coulomb_friction{at}": {"size": size, "width": width}}
            unequal = {"size_forward": size - bias, "size_backward": size + bias, "width": width}
            push = {f"constant_force{at}": {"acceleration": bias}}
            return dry | push, {f"asymmetric_friction{at}": unequal}
        if kind == "late":
            return {"actuator_lag": {"time_constant": late}}, {"input_delay": {"delay": late}}
        drag = float(rng.uniform(0.2, 0.6))
        linear, square = {"damping": drag}, {"damping": 2.0 * drag}
        return {f"viscous_friction{at}": linear}, {f"quadratic_damping{at}": square}

    def plant(self, truth: Effects, noise: float) -> Json:
        """The true machine; viscous friction is a parameter of the spring, next to nothing where it is not declared."""
        parameters: Effects = {k: v for k, v in truth.items() if k == "viscous_friction"}
        if self.declared is not None and not parameters:
            parameters = {"viscous_friction": {"damping": 1e-9}}
        effects = [{k: v} for k, v in truth.items() if k != "viscous_friction"]
        return {"effects": effects, "parameters": parameters, "sensor_noise": noise, "dt": DT}

    def runs(self, truth: Effects, size: float, duration: float, noise: float, seed: int) -> list[Run]:
        """Two runs under forces `size` times as large as usual."""
        self.noise, plant = noise, self.plant(truth, noise)
        if self.spring:
            more: Json = {"force_size": 0.5 * size, "region": [[-0.3 * size, 0.3 * size]] * 2}
            made = nsde_torch.simulate(self.name, durations=[duration] * 2, seed=seed, options=more, **plant)
            return [Run(r.name, r.t, r.x, r.u) for r in made.runs]
        runs, rng = [], np.random.default_rng([seed, 5])
        t = DT * np.arange(round(duration / DT) + 1)
        for i in range(2):
            f = np.exp(rng.uniform(np.log(0.1), np.log(2.0), (6, 1)))
            wave = np.sin(2 * np.pi * (f * t + rng.uniform(size=(6, 1)))).sum(0) / 3.0
            rows, hanging = np.column_stack((t, 6.0 * size * wave)), {"start": {"theta": np.pi}}
            run = planned(self.name, ("force",), rows, seed + 500 * i, options=hanging, **plant)
            runs.append(replace(run, name=f"run_{i}"))
        return runs

    def options(self, system: System, runs: Sequence[Run], duration: float, wider: float) -> Json:
        """Limits about the middle of what the runs held, and what is searched."""
        held = limits_of(system, runs, {})
        names = [*held.inputs, *held.states]
        low, high = np.append(held.low, held.floor), np.append(held.high, held.ceiling)
        middle, half = 0.5 * (low + high), 0.5 * wider * (high - low)
        ends = {n: [m - h, m + h] for n, m, h in zip(names, middle.tolist(), half.tolist(), strict=True)}
        return {"limits": ends, "hertz": (0.2, 5.0), "proposals": 120, "generations": 12}

    def family(self, e: Experiment, runs: Sequence[Run], duration: float) -> tuple[Family, Any, Array]:
        """What an oracle proposes, how it is driven, and what a run held."""
        assert e.hertz is not None
        return Signals(e.limits, DT, round(duration / DT), e.hertz), open_loop, max(runs, key=len).u

    def flown(self, truth: Effects, e: Experiment, rows: Array, seed: int, noise: float | None = None) -> Run:
        start = {"start": dict(zip(e.system.state_names, e.start.tolist(), strict=True))}
        plant = self.plant(truth, self.noise if noise is None else noise)
        return planned(self.name, tuple(e.given), rows, seed, options=start, **plant)

    def judged(
        self, e: Experiment, runs: Any, question: Question, flown: Mapping[str, Run], right: int
    ) -> Json:
        fits = zip(flown, fit_all(e.members, list(flown.values())), strict=True)
        return {name: {"obtained": against(fit.brought, right)} for name, fit in fits}


class Quadrotor(Small):
    seed = 78
    kinds = ("drag", "late", "weak", "wind")
    oracle = (40, 4)
    quiet = False
    declared = None
    ladder = ((1.2, 8, 1), (0.6, 8, 1), (0.3, 8, 1), (0.1, 8, 1), (0.1, 5, 1), (0.1, 3, 1))
    """Half-width of the room [m], length [s] and noise of the flights there are."""
    limits: Json = {
        **{"p_x": [-3.0, 3.0], "p_y": [-3.0, 3.0], "p_z": [0.5, 3.5]},
        **{f"v_{axis}": [-5.0, 5.0] for axis in "xyz"},
        **{f"w_{axis}": [-4.0, 4.0] for axis in "xyz"},
    }

    def __init__(self, name: str) -> None:
        self.name = name

    def case(self, kind: str, rng: np.random.Generator) -> tuple[Effects, Effects]:
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
            offset = (float(rng.uniform(0.05, 0.2)) * way).tolist()
            return {"motor_efficiency_loss": {"loss": loss.tolist()}}, {"com_offset": {"offset": offset}}
        wind = float(rng.uniform(1.0, 3.0))
        tilt = (size * wind / 9.81 * way).tolist()
        tilted = {"linear_drag": {"drag": drag}, "thrust_misalignment": {"tilt": tilt}}
        return {"constant_wind": {"drag": drag, "wind": (wind * way).tolist()}}, tilted

    def _flight(self, truth: Effects, rows: Array, seed: int) -> Run:
        how: Json = {"effects": [{k: v} for k, v in truth.items()], "declared_only": True}
        return planned(self.name, ("p_x", "p_y", "p_z", "yaw"), rows, seed, **how)

    def runs(self, truth: Effects, room: float, duration: float, noise: float, seed: int) -> list[Run]:
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
            run = self._flight(truth, np.column_stack((t, points)), 1000 * seed + 500 + i)
            runs.append(replace(run, name=f"run_{i}"))
        return runs

    def options(self, system: System, runs: Sequence[Run], duration: float, wider: float) -> Json:
        return {"limits": self.limits, "duration": duration, "proposals": 20, "generations": 4}

    def family(self, e: Experiment, runs: Sequence[Run], duration: float) -> tuple[Family, Any, Array]:
        drive = partial(flown_paths, system=e.system, dt=e.dt)
        return Paths(e.limits, e.dt, len(e.plan.table), e.start), drive, max(runs, key=len).x[:, :3]

    def flown(self, truth: Effects, e: Experiment, rows: Array, seed: int, noise: float | None = None) -> Run:
        return self._flight(truth, rows, seed)

    def judged(
        self, e: Experiment, runs: Any, question: Question, flown: Mapping[str, Run], right: int
    ) -> Json:
        out = {}
        for name, run in flown.items():
            fit = fit_all(e.members, [run])[0]
            told = evidence(e.system, e.members, [fit], runs, [run], question, {}, clock=1.0)
            by_quadratics = against(fit.brought, right)
            out[name] = {"obtained": against(told, right), "obtained_by_quadratics": by_quadratics}
        return out


MACHINES: dict[str, type[Small]] = {"spring": Small, "cart": Small, "quadrotor": Quadrotor}


def one(name: str, kind: str, seed: int, wider: float) -> Json:
    """One case, within limits `wider` times what the runs held."""
    began = time.perf_counter()
    machine = MACHINES[name](name)
    rng = np.random.default_rng([seed, machine.seed])
    both = machine.case(kind, rng)
    right = int(rng.integers(2))
    truth = both[right]
    system = system_options(machine.name, declared=machine.declared).make()
    question = Question(tuple(tuple(system.effect_key(e) for e in m) for m in both))
    out: Json = {"machine": name, "seed": seed, "truth": list(truth), "sizes": truth}
    for size, duration, noise in np.array(machine.ladder, dtype=float).tolist():
        runs = machine.runs(truth, size, duration, noise, seed)
        members = members_of(system, runs, question, {}, clock=1.0)
        there = members[right].nats - members[1 - right].nats
        if abs(there) < SURE:
            break
    out |= {"size": size, "duration_s": duration, "noise": noise, "nats_there": there}
    out["tied"] = abs(there) < SURE
    if not out["tied"]:
        return out
    how = machine.options(system, runs, duration, wider)
    e = design(system, runs, question, DesignOptions(samples=3, rehearsals=6, seed=seed, **how))
    family, drive, before = machine.family(e, runs, duration)
    told, best = Oracle(e, right, truth, drive).best(family, machine.oracle, before, seed)
    out |= {"designed_s": e.seconds, "kind_of_plan": e.plan.name, "oracle": told, "wider": wider}
    named = {"the plan" if p is e.plan else p.name: p for p in (e.plan, *e.baselines)}
    tables, hoped = {n: p.table for n, p in named.items()}, {n: p.nats(right) for n, p in named.items()}
    if best is not None:
        tables["the oracle's"], hoped["the oracle's"] = best, {"mean": told}
    rows = {n: replace(e, plan=replace(e.plan, table=table)).rows() for n, table in tables.items()}
    flown = {n: machine.flown(truth, e, own, 1000 * seed + i) for i, (n, own) in enumerate(rows.items())}
    plans = machine.judged(e, runs, question, flown, right)
    for i, (n, own) in enumerate(rows.items()):
        seen = machine.flown(truth, e, own, 1000 * seed + i, 0.0) if machine.quiet else flown[n]
        plans[n] |= {"expected": hoped[n], "use": float(np.nanmax(e.limits.use(seen.x)))}
    return out | {"plans": plans, "seconds": time.perf_counter() - began}


def report(rows: Sequence[Json]) -> None:
    tied = [r for r in rows if r.get("tied")]
    names = list(dict.fromkeys(n for r in tied for n in r["plans"]))
    print(f"{len(rows)} cases, {len(tied)} tied by the runs there are")
    for machine, kind in [("", ""), *sorted({(r["machine"], r["kind"]) for r in tied})]:
        some = [r for r in tied if machine in ("", r["machine"]) and kind in ("", r["kind"])]
        able = [r for r in some if max(r["oracle"], *(p["obtained"] for p in r["plans"].values())) > SURE]
        broken = sum(r["plans"]["the plan"]["obtained"] > SURE for r in able)
        within = f"{len(able)} that something breaks within the limits, the plan {broken} of them"
        print(f"{machine or 'all'} {kind}: {len(some)} cases; {within}")
        for name in names:
            # where a usual experiment was the best, it is the plan
            plans = [{r["kind_of_plan"]: r["plans"]["the plan"], **r["plans"]} for r in some]
            got = [p[name] for p in plans if name in p]
            if not got:
                continue
            nats = np.array([g["obtained"] for g in got])
            hoped = np.array([g["expected"]["mean"] for g in got])
            near = (nats > 0.5 * hoped) & (nats < 2.0 * hoped)
            low, middle, high = np.quantile(nats, (0.25, 0.5, 0.75))
            print(
                f"  {name:24s} breaks {np.sum(nats > SURE)}/{len(some)}, wrong {np.sum(nats < -SURE)}; median "
                f"{middle:.1f} nats (quartiles {low:.1f}, {high:.1f}), expected median {np.median(hoped):.1f}; "
                f"within a factor of two {near.mean():.0%}; left limits {sum(g['use'] > 1 for g in got)}"
            )


def main() -> None:
    parser = options(__doc__, "out", seed=1, count=3)
    parser.add_argument("--machine", choices=MACHINES, default="spring")
    parser.add_argument("--wider", type=float, default=2.0, help="limits over what the runs held")
    a = parser.parse_args()
    kinds, cases = MACHINES[a.machine].kinds, []
    for i in range(a.count):
        kind, seed = kinds[i % len(kinds)], a.seed + i
        cases.append((f"{a.machine}_{seed}", partial(one, a.machine, kind, seed, a.wider), {"kind": kind}))
    report(answers(a.out, cases, lambda found: f"{found['kind']}: {found.get('error', found.get('tied'))}"))


if __name__ == "__main__":
    main()
