"""Springs and carts of which something differs between runs: is it named, alone, and do the intervals hold?

    python benchmarks/blind/run_differences.py --seed 1 --count 32 --out runs/differences

Machines are those of `small_machines`. What differs, by how much and in which of three to six runs is drawn; in a third
of the cases one run alone differs. Nulls have runs of one machine. `--within` lets it change in the middle of runs of
30 s: in one of two runs, in both at moments of their own, or in a single run.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from small_machines import STATES, Small, run
from study import answers, options, save

Json = dict[str, Any]
Draw: TypeAlias = Callable[[str, int], "Made"]
SPRING, CART = "mass_spring_damper", "cartpole"
VALUES = {SPRING: {"k": 4.0, "b": 0.5, "g": 1.0}, CART: {"g": 1.0, "s": 0.2, "l": 0.5}}
NOISE = {SPRING: (0.001, 0.003), CART: (0.0005, 0.005, 0.001, 0.01)}


@dataclass(frozen=True)
class Kind:
    """What differs between runs.

    Args:
        system: Machine.
        effect: Name of what should be found.
        least, most: Size of a difference; where it is relative, of the logarithm.
        relative: Whether it is a factor.
        beside: What is found with it.
    """

    system: str
    effect: str
    least: float = 0.0
    most: float = 0.0
    relative: bool = False
    beside: frozenset[str] = frozenset()


FRICTION = "run_difference[coulomb_friction{}/size]"
KINDS: dict[str, Kind] = {
    "spring: nothing": Kind(SPRING, ""),
    "spring: mass": Kind(SPRING, "run_difference[mass]", 0.08, 0.5, True),
    "spring: gain": Kind(SPRING, "run_difference[force_gain]", 0.08, 0.4, True),
    "spring: stiffness": Kind(SPRING, "run_difference[linear_spring/stiffness]", 0.05, 0.4, True),
    "spring: damping": Kind(SPRING, "run_difference[viscous_friction/damping]", 0.3, 0.9, True),
    "spring: force": Kind(SPRING, "run_force", 0.06, 0.4),
    "spring: friction": Kind(SPRING, FRICTION.format(""), 0.06, 0.3, beside=frozenset({"coulomb_friction"})),
    "cart: nothing": Kind(CART, ""),
    "cart: mass": Kind(CART, "run_difference[mass]", 0.04, 0.4, True),
    "cart: gain": Kind(CART, "run_difference[force_gain]", 0.04, 0.3, True),
    "cart: length": Kind(CART, "run_difference[half_length]", 0.03, 0.3, True),
    "cart: force": Kind(CART, "run_force[cart]", 0.08, 0.5),
    "cart: zero": Kind(CART, "run_zero[pole]", 0.006, 0.04),
    "cart: friction": Kind(
        CART, FRICTION.format("[cart]"), 0.1, 0.5, beside=frozenset({"coulomb_friction[cart]"})
    ),
}


@dataclass(frozen=True)
class Made:
    """Runs of a case."""

    kind: Kind
    each: tuple[float, ...]  # value of what differs in each run, in its unit
    machines: tuple[Small, ...] = field(repr=False, default=())
    zeros: tuple[float, ...] = ()
    moments: tuple[float, ...] = ()
    """Of `within`: when each run changes [s]; machines, values and zeros are then those before and after, by turns."""


def made(name: str, seed: int) -> Made:
    """Draw the machines of the runs of a case."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, list(KINDS).index(name)])
    count, system = int(rng.integers(3, 7)), kind.system
    sizes = np.exp(rng.uniform(np.log(max(kind.least, 1e-9)), np.log(max(kind.most, 1e-9)), count))
    signs = rng.choice((-1.0, 1.0), count)
    alone = np.arange(count) == rng.integers(count) if rng.random() < 1 / 3 else np.ones(count, dtype=bool)
    change = np.where(alone, signs * sizes, 0.0) if kind.effect else np.zeros(count)
    if "friction" in kind.effect and "viscous" not in kind.effect:
        change = abs(change)
    machine = Small(system, dict(VALUES[system]), {}, NOISE[system])
    machines, each, zeros = [], [], []
    for value in change.tolist():
        one, is_now, zero = changed(machine, kind.effect, float(np.exp(value)) if kind.relative else value)
        machines.append(one)
        each.append(is_now)
        zeros.append(zero)
    return Made(kind, tuple(each), tuple(machines), tuple(zeros))


def within(name: str, seed: int) -> Made:
    """Draw the machines of runs that change at a moment."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, list(KINDS).index(name), 3])
    count, alone = ((1, True), (2, True), (2, False))[rng.integers(3)]
    size = float(np.exp(rng.uniform(np.log(max(kind.least, 0.05)), np.log(max(kind.most, 0.1)))))
    size *= 1.0 if "coulomb" in kind.effect else float(rng.choice((-1.0, 1.0)))
    moments = [float(rng.uniform(8.0, 22.0)) for _ in range(count)]
    machine = Small(kind.system, dict(VALUES[kind.system]), {}, NOISE[kind.system])
    parts = []
    for r in range(count):
        differs = size if kind.effect and not (alone and r) else 0.0
        for by in (0.0, differs):
            parts.append(changed(machine, kind.effect, float(np.exp(by)) if kind.relative else by))
    machines, each, zeros = zip(*parts, strict=True)
    return Made(kind, each, machines, zeros, tuple(moments))


def changed(machine: Small, effect: str, by: float) -> tuple[Small, float, float]:
    """The machine of a run, the value of what differs there, and the zero of its pole."""
    values = machine.values
    if not effect:
        return machine, 0.0, 0.0
    if effect.startswith("run_force"):
        return replace(machine, steady=by), by, 0.0
    if effect.startswith("run_zero"):
        return machine, by, by
    if "coulomb" in effect:
        return replace(machine, effects={"coulomb": {"size": by}} if by else {}), by, 0.0
    if "mass" in effect:
        light = "kbg" if machine.system == SPRING else "gs"
        return replace(machine, values={k: v / by if k in light else v for k, v in values.items()}), by, 0.0
    key = {"gain": "g", "stiffness": "k", "damping": "b", "length": "l"}[
        effect.rpartition("/")[2].rstrip("]").split("_")[-1]
    ]
    return replace(machine, values={**values, key: values[key] * by}), values[key] * by, 0.0


def write(case: Made, folder: Path, seed: int, seconds: float = 12.0) -> None:
    """Write the runs of a case as CSV files."""
    folder.mkdir(parents=True, exist_ok=True)
    for r, moment in enumerate(case.moments):
        before, after = case.machines[2 * r : 2 * r + 2]
        t, y, u = run(before, 30.0, 0.01, 1009 * seed + r, after, moment)
        if any(case.zeros):
            y[:, 2] += np.where(t < moment, *case.zeros[2 * r : 2 * r + 2])
        save(folder / f"run_{r}.csv", ("t", *STATES[before.system], "force"), [t + 100 * r, y, u], "%.7f")
    for r, machine in enumerate(() if case.moments else case.machines):
        t, y, u = run(machine, seconds, 0.01, seed=1009 * seed + r)
        if case.zeros[r]:
            y[:, 2] += case.zeros[r]
        columns = ("t", *STATES[machine.system], "force")
        save(folder / f"run_{r}.csv", columns, [t + 100 * r, y, u], "%.7f")


def diagnosed(name: str, seed: int, keep: Path | None = None, draw: Draw = made) -> Json:
    """Simulate a case and diagnose it; its runs are kept in a folder, if asked for."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    case = draw(name, seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (keep or Path(temporary)) / f"{name.replace(': ', '_')}_{seed}"
        write(case, folder, seed)
        start = time.perf_counter()
        found = nsde_torch.diagnose(folder, system=case.kind.system, say=False)
    content = found.content()
    sure = {f["name"] for f in content["findings"] if not f["lead"]}
    named = {f["name"] for f in content["findings"]}
    wanted = {case.kind.effect, *case.kind.beside} - {""}
    held = [
        _holds(p, case)
        for k, p in content["parameters"].items()
        if k.startswith(f"{case.kind.effect}.") and "run" in p
    ]
    moments = [(case.moments[int(run[4:])], *times) for run, times in content["data"]["moments"].items()]
    return {
        "moments": [[round(v % 100, 2) for v in times] for times in moments],
        "kind": name,
        "seed": seed,
        "verdict": content["verdict"],
        "each": [round(v, 4) for v in case.each],
        "found": sorted(named),
        "leads": sorted(named - sure),
        "exact": sure == named == wanted,
        "right": case.kind.effect in sure or not wanted,
        "wrong": sorted(sure - wanted),
        "held": sum(h for h in held if h is not None),
        "intervals": sum(h is not None for h in held),
        "seconds": round(time.perf_counter() - start, 1),
    }


def _holds(p: Mapping[str, Any], case: Made) -> bool | None:
    """Whether an interval holds the true number of its run; None where there is none."""
    if p["interval_90"] is None:
        return None
    of = {f"run_{r}": value for r, value in enumerate(case.each)}
    if case.moments:
        of = {f"run_{k // 2} {('before', 'from')[k % 2]}": value for k, value in enumerate(case.each)}
        of |= {f"run_{k // 2}": value for k, value in enumerate(case.each) if k % 2 == 0}
    true, against = (of.get(" ".join((p[key] or "").split()[:2])) for key in ("run", "against"))
    assert true is not None
    if against is not None:
        true = true / against - 1.0 if "mass" in case.kind.effect else true - against
    low, high = p["interval_90"]
    return bool(low <= true <= high)


def line(answer: Json) -> str:
    """A line for an answer."""
    if "error" in answer:
        return f"{answer['kind']} {answer['seed']}: {answer['error']}"
    leads = f"; leads {', '.join(answer['leads'])}" if answer["leads"] else ""
    grade = "exact" if answer["exact"] else "right" if answer["right"] else "NOT  "
    found = ", ".join(answer["found"]) or "nothing"
    return (
        f"{answer['kind']:18} {answer['seed']} {grade} {answer['held']}/{answer['intervals']} {answer['verdict']}: "
        f"{found}{leads} {answer['each']} {answer['moments'] or ''} ({answer['seconds']:.0f} s)"
    )


def main() -> None:
    """Diagnose cases, print a line for each, and the counts."""
    names = list(KINDS)
    parser = options(__doc__ or "", count=len(names))
    parser.add_argument("--keep", type=Path, default=None, help="folder that the runs are kept in")
    parser.add_argument("--within", action="store_true", help="let runs change at a moment")
    given = parser.parse_args()
    draw = within if given.within else made
    cases = []
    for i in range(given.first, given.first + given.count):
        name, seed = names[i % len(names)], given.seed + i // len(names)
        wrong = {"kind": name, "seed": seed, "found": [], "exact": False, "right": False, "wrong": []}
        wrong |= {"held": 0, "intervals": 0}
        cases.append(
            (f"{name.replace(': ', '_')}_{seed}", partial(diagnosed, name, seed, given.keep, draw), wrong)
        )
    rows = answers(given.out, cases, line)
    some = [r for r in rows if KINDS[r["kind"]].effect]
    nulls = [r for r in rows if not KINDS[r["kind"]].effect]
    held, count = (sum(r[k] for r in some) for k in ("held", "intervals"))
    exact, right = (sum(r[k] for r in some) for k in ("exact", "right"))
    print(
        f"\nnamed and nothing else {exact} of {len(some)}, named {right}; nothing named of nulls "
        f"{sum(not r['found'] for r in nulls)} of {len(nulls)}; surely wrong "
        f"{sum(bool(r['wrong']) for r in rows)}; intervals that hold {held} of {count}"
    )


if __name__ == "__main__":
    main()
