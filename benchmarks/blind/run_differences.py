"""Springs and carts of which something differs between runs: is it named, alone, and do the intervals hold?

    python benchmarks/blind/run_differences.py --seed 1 --count 32 --out runs/differences

Machines are those of `small_machines`. What differs, by how much and in which of three to six runs is drawn; in a third
of the cases one run alone differs. `--within` lets it change in the middle of runs of 30 s: in one of two runs, in both
at moments of their own, or in a single run. `--unseen` trains on five of fifteen runs, of which what differs is drawn
from one normal law, and scores the intervals on the other ten.
"""

import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from small_machines import Small, run
from study import Json, answers, columns, diagnosed, in_turn, options, save, table

SPRING, CART = "mass_spring_damper", "cartpole"
MACHINES = {
    SPRING: Small(SPRING, {"k": 4.0, "b": 0.5, "g": 1.0}, {}, (0.001, 0.003)),
    CART: Small(CART, {"g": 1.0, "s": 0.2, "l": 0.5}, {}, (0.0005, 0.005, 0.001, 0.01)),
}
TRAINED, UNSEEN = 5, 10


@dataclass(frozen=True)
class Kind:
    system: str
    effect: str  # name of what should be found
    least: float = 0.0  # size of a difference; where it is relative, of the logarithm
    most: float = 0.0
    relative: bool = False  # whether it is a factor
    beside: frozenset[str] = frozenset()  # what is found with it


_DRY = frozenset({"coulomb_friction[cart]"})
FRICTION, WAVE = "run_difference[coulomb_friction{}/size]", "run_periodic_force"
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
    "cart: friction": Kind(CART, FRICTION.format("[cart]"), 0.1, 0.5, False, _DRY),
    "cart: wave": Kind(CART, f"{WAVE}[cart]", 0.08, 0.5),
    "spring: wave": Kind(SPRING, WAVE, 0.05, 0.4),
}
NAMES = list(KINDS)


@dataclass(frozen=True)
class Made:
    kind: Kind
    each: tuple[
        float, ...
    ]  # value of what differs in each run, in its unit; of waves the sines, then the cosines
    machines: tuple[Small, ...] = field(repr=False, default=())
    zeros: tuple[float, ...] = ()
    moments: tuple[float, ...] = ()
    """Of `within`: when each run changes [s]; machines, values and zeros are then those before and after, by turns."""


def _made(kind: Kind, by: Any, moments: tuple[float, ...] = ()) -> Made:
    """Runs of a machine that differ by so much, or by a factor of which this is the logarithm."""
    sizes = [float(np.exp(v)) if kind.relative else v for v in by]
    parts = [changed(MACHINES[kind.system], kind.effect, size) for size in sizes]
    machines, each, zeros = zip(*parts, strict=True)
    return Made(kind, each, machines, zeros, moments)


def made(name: str, seed: int) -> Made:
    kind = KINDS[name]
    rng = np.random.default_rng([seed, NAMES.index(name)])
    count = int(rng.integers(3, 7))
    if WAVE in kind.effect:
        size, hertz = np.exp(rng.uniform(*np.log([(kind.least, 0.4), (kind.most, 8.0)])))
        phases, machine = rng.uniform(0.0, 2.0 * np.pi, count), MACHINES[kind.system]
        each = np.concatenate((size * np.cos(phases), size * np.sin(phases)))
        return Made(
            kind, tuple(each), tuple(replace(machine, wave=(size, hertz, p)) for p in phases), (0.0,) * count
        )
    sizes = np.exp(rng.uniform(np.log(max(kind.least, 1e-9)), np.log(max(kind.most, 1e-9)), count))
    signs = rng.choice((-1.0, 1.0), count)
    alone = np.arange(count) == rng.integers(count) if rng.random() < 1 / 3 else np.ones(count, dtype=bool)
    change = np.where(alone, signs * sizes, 0.0) if kind.effect else np.zeros(count)
    return _made(kind, (abs(change) if "coulomb" in kind.effect else change).tolist())


def unseen(name: str, seed: int) -> Made:
    """Draw the machines of runs of which some train and some are not seen."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, 7, NAMES.index(name)])
    change = rng.normal(0.0, np.sqrt(kind.least * kind.most), TRAINED + UNSEEN)
    return _made(kind, (abs(change) if "coulomb" in kind.effect else change).tolist())


def within(name: str, seed: int) -> Made:
    """Draw the machines of runs that change at a moment."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, NAMES.index(name), 3])
    count, alone = ((1, True), (2, True), (2, False))[rng.integers(3)]
    size = float(np.exp(rng.uniform(np.log(max(kind.least, 0.05)), np.log(max(kind.most, 0.1)))))
    size *= 1.0 if "coulomb" in kind.effect else float(rng.choice((-1.0, 1.0)))
    moments = tuple(float(rng.uniform(8.0, 22.0)) for _ in range(count))
    return _made(kind, [v for r in range(count) for v in (0.0, size if not (alone and r) else 0.0)], moments)


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
    key = {"gain": "g", "stiffness": "k", "damping": "b", "length": "l"}[re.split(r"[/_\]]", effect)[-2]]
    return replace(machine, values={**values, key: values[key] * by}), values[key] * by, 0.0


def write(case: Made, folder: Path, seed: int, seconds: float = 12.0) -> None:
    runs = []
    for r, moment in enumerate(case.moments):
        before, after = case.machines[2 * r : 2 * r + 2]
        t, y, u = run(before, 30.0, 0.01, 1009 * seed + r, after, moment)
        zero = np.where(t < moment, *case.zeros[2 * r : 2 * r + 2])
        runs.append((t, y, u, zero if any(case.zeros) else 0.0))
    for r, machine in enumerate(() if case.moments else case.machines):
        runs.append((*run(machine, seconds, 0.01, seed=1009 * seed + r), case.zeros[r]))
    for r, (t, y, u, zero) in enumerate(runs):
        if np.any(zero):
            y[:, 2] += zero
        start = 0 if WAVE in case.kind.effect else 100 * r  # phases are by the clock of the log
        save(folder / f"run_{r}.csv", columns(case.kind.system), [t + start, y, u], "%.7f")


def answer_of(draw: Callable[[str, int], Made], keep: Path | None, name: str, seed: int) -> Json:
    """Simulate a case and diagnose it; its runs are kept in a folder, if asked for."""
    case = draw(name, seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (keep or Path(temporary)) / f"{name.replace(': ', '_')}_{seed}"
        write(case, folder, seed)
        found, answer = diagnosed(folder, case.kind.system)
    content = found.content()
    sure = {f["name"] for f in content["findings"] if not f["lead"]}
    named = {f["name"] for f in content["findings"]}
    wanted = {case.kind.effect, *case.kind.beside} - {""}
    own_keys = [k for k in answer["parameters"] if k.startswith(f"{case.kind.effect}.")]
    own = [(k, p) for k in own_keys if (p := answer["parameters"][k]).get("run") and p["interval_90"]]
    moments = [(case.moments[int(run[4:])], *times) for run, times in content["data"]["moments"].items()]
    return {
        **{"verdict": answer["verdict"], "seconds": answer["seconds"], "parameters": {}},
        "truth": {name: {} for name in sorted(wanted)},
        "moments": [[round(v % 100, 2) for v in times] for times in moments],
        "each": [round(v, 4) for v in case.each],
        "added": sorted(named),
        "leads": sorted(named - sure),
        "alone": sure == named == wanted,
        "right": case.kind.effect in sure if wanted else not named,
        "wrong": sorted(sure - wanted),
        "inside": [sum(_holds(key, p, case) for key, p in own), len(own)],
    }


def _holds(key: str, p: Mapping[str, Any], case: Made) -> bool:
    """Whether an interval holds the true number of its run."""
    low, high = p["interval_90"]
    if WAVE in key:
        return bool(low <= case.each[int(key.split("[")[-1][:-1])] <= high)
    of = {f"run_{r}": value for r, value in enumerate(case.each)}
    if case.moments:
        of = {f"run_{k // 2} {('before', 'from')[k % 2]}": value for k, value in enumerate(case.each)}
        of |= {f"run_{k // 2}": value for k, value in enumerate(case.each) if k % 2 == 0}
    true, against = (of.get(" ".join((p[key] or "").split()[:2])) for key in ("run", "against"))
    assert true is not None
    if against is not None:
        true = true / against - 1.0 if "mass" in case.kind.effect else true - against
    return bool(low <= true <= high)


def trained(name: str, seed: int) -> Json:
    """Simulate a case, train on the first runs, and score the others."""
    import nsde_torch

    case = unseen(name, seed)
    with tempfile.TemporaryDirectory() as temporary:
        write(case, Path(temporary), seed)
        test = [f"run_{r}" for r in range(TRAINED, TRAINED + UNSEEN)]
        metrics = nsde_torch.train(temporary, system=case.kind.system, test=test, say=False).metrics
    coverage = metrics["test"]["coverage"]["0.9"]
    horizons = sorted({h for by in coverage.values() for h in by}, key=float)
    return {
        "each": [round(v, 4) for v in case.each],
        "found": {k: v["std"] for k, v in metrics.get("between_runs", {}).items()},
        "networks": {k: v["variables"] for k, v in metrics["innovations"]["networks"].items() if v["kept"]},
        "factor": metrics["calibration"]["factor"],
        "coverage": {h: float(np.mean([by[h] for by in coverage.values()])) for h in horizons},
        "nll": float(np.mean([v for by in metrics["test"]["nll"].values() for v in by.values()])),
    }


def line_of_trained(answer: Json) -> str:
    if "error" in answer:
        return str(answer["error"])
    held = ", ".join(f"{h} s {share:.0%}" for h, share in answer["coverage"].items())
    learned = "; ".join(f"{k}: {', '.join(v)}" for k, v in answer["networks"].items())
    return (
        f"{held}; differs: {', '.join(answer['found']) or 'nothing'}; sigma times {answer['factor']:.2f}; "
        f"{answer['nll']:.2f} nats" + (f"; networks of {learned}" if learned else "")
    )


def table_of_trained(rows: list[Json]) -> str:
    horizons = sorted({h for r in rows for h in r["coverage"]}, key=float)
    means = {h: [r["coverage"][h] for r in rows if h in r["coverage"]] for h in horizons}
    text = ", ".join(f"{h} s {np.mean(v):.1%}" for h, v in means.items())
    share = np.mean([0.8 <= v <= 0.97 for of in means.values() for v in of])
    between = f"between 80 and 97 % in {share:.0%} of their horizons"
    return f"\nmean coverage of {len(rows)} cases: {text}; {between}"


def main() -> None:
    parser = options(__doc__, "seed", "out", first=0, count=len(NAMES))
    parser.add_argument("--keep", type=Path, default=None, help="folder that the runs are kept in")
    parser.add_argument("--within", action="store_true", help="let runs change at a moment")
    parser.add_argument("--unseen", action="store_true", help="train, and score runs that were not seen")
    a = parser.parse_args()
    if a.unseen:
        print(table_of_trained(answers(a.out, in_turn(a, NAMES, trained), line_of_trained, {"coverage": {}})))
        return
    make = partial(answer_of, within if a.within else made, a.keep)
    table(answers(a.out, in_turn(a, NAMES, make)))


if __name__ == "__main__":
    main()
