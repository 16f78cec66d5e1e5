"""Blind cases with a law that no catalogue has, and nulls: named, value in its interval, error beside an oracle.

    python benchmarks/blind/laws.py --machine spring --seed 1 --count 12 --out runs/laws

Every case has another machine, another size and shape of the law, other noise and other forces. In turn three laws and
none; of seeds from 100000 on all have none. A law counts as named where what was added is the same function of the
logged states (correlation above 0.999) in the same row, in whatever spelling, and nothing else was added. The oracle is
told the law, with its size and shape free, and adds nothing. Surely wrong is what is no such law, no lead and no member
of a tie, where a diagnosis says that it found an effect.
"""

from __future__ import annotations

import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
import closed_loop
import law_kinds as kinds
import law_machines as machines
from study import answers, options, save

KINDS = {
    "spring": kinds.SPRING,
    "cart": kinds.CART,
    "joints": kinds.JOINTS,
    "hexacopter": kinds.HEXACOPTER,
    "quadrotor": kinds.QUADROTOR,
    "odd_spring": kinds.ODD_SPRING,
    "odd_cart": kinds.ODD_CART,
}
SYSTEMS = {
    "odd_spring": "mass_spring_damper",
    "odd_cart": "cartpole",
    "spring": "mass_spring_damper",
    "cart": "cartpole",
    "joints": "double_pendulum:DoublePendulum",
    "hexacopter": "hexacopter",
    "quadrotor": "quadrotor",
}
PATHS = {
    "hexacopter": ("waypoints", "circle", "sines", "waypoints"),
    "quadrotor": ("sticks", "sines", "sticks", "waypoints"),
}
"""What multirotors fly; by sticks a pilot's tilts, which a weak hold answers."""
COLUMNS = {
    "spring": ("t", "q", "q_dot", "force"),
    "cart": ("t", "x", "x_dot", "theta", "theta_dot", "force"),
}
ODD = "odd_"
"""What machines begin with whose laws cannot be written (`flexible_cases`)."""
EVERY_NULL = 4
NULLS_ONLY = 100_000
"""Seeds from which all cases are nulls."""
ALIKE = 0.999
NEAR = 1.1
"""Ratio of errors to those of the oracle up to which the law is as good as told."""
Json = dict[str, Any]
Array = np.ndarray


def drawn(machine: str, seed: int, i: int) -> tuple[np.random.Generator, kinds.Kind | None]:
    """Random numbers and kind of a case; None of a null."""
    order = np.random.default_rng([seed, 77]).permutation(len(KINDS[machine]))
    turn = i - i // EVERY_NULL
    null = seed >= NULLS_ONLY or i % EVERY_NULL == EVERY_NULL - 1
    kind = None if null else KINDS[machine][order[turn % len(order)]]
    return np.random.default_rng([seed, i]), kind


def write(machine: str, seed: int, i: int, folder: Path, weaker: float = 1.0) -> machines.Law | None:
    """Write the runs of a case; returns its law, so many times weaker."""
    rng, kind = drawn(machine, seed, i)
    share, sign = float(np.exp(rng.uniform(np.log(0.05), np.log(0.25)))), float(rng.choice((-1.0, 1.0)))
    own, share = int(rng.integers(2**30)), share / weaker
    if machine in PATHS:
        return _multirotor(machine, kind, share * sign, rng, own, folder)
    runs, seconds = int(rng.integers(4, 9)), float(rng.uniform(10.0, 20.0))
    if machine == "joints":
        return _joints(kind, share * sign, rng, own, folder)
    state = rng.bit_generator.state
    plain, _ = machines.small_runs(SYSTEMS[machine], None, rng, own, runs, seconds)
    law = _sized(kind, share * sign, [(x, u) for _, x, u in plain], _force(plain))
    for _ in range(6):
        rng.bit_generator.state = state
        with np.errstate(all="ignore"):
            made, _ = machines.small_runs(SYSTEMS[machine], law, rng, own, runs, seconds)
        x = np.concatenate([part for _, part, _ in made])
        still = np.concatenate([part for _, part, _ in plain])
        if np.isfinite(x).all() and bool((np.abs(x[:, :2]).max(0) < 2.0 * np.abs(still[:, :2]).max(0)).all()):
            break
        assert law is not None  # it drove the machine off: of the other sign, and smaller
        law = machines.Law(law.kind, -0.7 * law.size, law.shape)
    for r, (t, x, u) in enumerate(made):
        save(folder / f"run_{r}.csv", COLUMNS[machine.removeprefix(ODD)], [t, x, u])
    return law


def _force(runs: list[tuple[Array, Array, Array]]) -> float:
    """Root mean square of what speeds the machine up, from differences over ten rows."""
    rates = [(x[10:, 1] - x[:-10, 1]) / (t[10] - t[0]) for t, x, _ in runs]
    return float(np.sqrt(np.mean(np.square(np.concatenate(rates)))))


def _sized(
    kind: kinds.Kind | None, share: float, runs: list[tuple[Array, Array]], force: float
) -> machines.Law | None:
    """A law whose root mean square is a share of a force, on runs without it."""
    if kind is None:
        return None
    x, u = (np.concatenate(part) for part in zip(*runs, strict=True))
    shape = 0.0 if kind.shape is None else float(np.quantile(x[:, kind.along], kind.shape))
    size = float(np.sqrt(np.mean(np.square(kind.term(x, u, shape)))))
    # a stop pushes back
    share = -abs(share) * 3.0 if kind.shape is not None else share
    return machines.Law(kind, share * force / max(size, 1e-9), shape)


def _joints(
    kind: kinds.Kind | None, share: float, rng: np.random.Generator, seed: int, folder: Path
) -> machines.Law | None:
    make_data = machines.make_data
    scale = np.exp(rng.uniform(np.log(0.7), np.log(1.4), 2))
    make_data.MASS_1, make_data.MASS_2 = 1.0 * scale[0], 0.6 * scale[1]
    torque = make_data.TORQUE[0 if kind is None else kind.row]
    swing = np.random.default_rng(seed).normal(size=(4000, 4)) * (0.5, 0.7, 2.0, 4.0)
    law = _sized(kind, 2.0 * share, [(swing, np.zeros((4000, 2)))], torque)
    noise = float(rng.uniform(0.3, 1.5))
    with np.errstate(all="ignore"):
        for _ in range(12):
            if law is None or _stays(law, seed % 100000):
                break
            law = machines.Law(law.kind, -0.8 * law.size, law.shape)  # it drives the machine off
        make_data.write(
            folder, machines.joint_push(law), seed=seed % 100000, runs=4, seconds=12.0, noise=noise
        )
    return law


def _stays(law: machines.Law, seed: int) -> bool:
    """Whether two joints stay within bounds under half of their torques, in the runs of a seed."""
    make_data = machines.make_data
    rng = np.random.default_rng(seed)
    for own in [int(rng.integers(2**31)) for _ in range(4)]:
        x = make_data.simulate(1200, np.random.default_rng(own), machines.joint_push(law), 0.0, 0.5)
        if not np.abs(x[:, 1]).max() < make_data.WITHIN:
            return False
    return True


def _multirotor(
    machine: str, kind: kinds.Kind | None, share: float, rng: np.random.Generator, seed: int, folder: Path
) -> machines.Law | None:
    made = closed_loop._machine(machine, rng)
    law = None
    if kind is not None:
        seen = np.random.default_rng(seed).normal(size=(4000, 9)) * (
            1.0,
            1.0,
            0.4,
            0.4,
            0.4,
            0.5,
            1.0,
            1.0,
            0.4,
        )
        law = _sized(kind, share, [(seen, np.zeros((4000, 6)))], 2.0 if kind.row < 3 else 4.0)
        made = machines.Machine(**{**vars(made), "effects": {"law": {"of": law}}})
    names = (
        *("t", "p_x", "p_y", "p_z", "v_x", "v_y", "v_z", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z"),
        *(f"u_{k + 1}" for k in range(closed_loop.SIGNS[machine].shape[1])),
    )
    for r, log in enumerate(machines.flights(made, seed, 25.0, PATHS[machine])):
        save(folder / f"flight_{r}.csv", names, [log.t, log.x, log.u])
    return law


def case(machine: str, seed: int, i: int, weaker: float = 1.0) -> Json:
    """Make, diagnose and judge one case."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    system = SYSTEMS[machine]
    with tempfile.TemporaryDirectory() as folder:
        law = write(machine, seed, i, Path(folder), weaker)
        data = nsde_torch.read(folder, system=system)
        started = time.perf_counter()
        found = nsde_torch.diagnose(data, system=system)
        seconds = time.perf_counter() - started
        oracle = found
        if law is not None:
            start = {"c1": law.size, **({"k1": law.shape} if law.kind.shape is not None else {})}
            oracle = nsde_torch.diagnose(data, system=system, effects={law.kind.text: start}, max_effects=0)
    content = found.content()
    out: Json = {
        "case": i,
        "machine": machine,
        "truth": None if law is None else {"law": law.kind.text, "c1": law.size, "k1": law.shape},
        "seconds": seconds,
        "verdict": content["verdict"],
        "added": content["added"],
        "leads": [f["name"] for f in content["findings"] if f["lead"]],
        "ties": content["ties"],
        "parameters": {k: [v["value"], v["interval_90"]] for k, v in content["parameters"].items()},
    }
    out["laws"] = [name for name in content["added"] if "=" in name]
    out["sure"] = sure(content)
    if law is None:
        out |= {"named": not out["added"], "false_law": bool(out["laws"]), "surely_wrong": out["sure"]}
        return out
    channel = max(content["residual"], key=lambda c: _change(oracle.content()["residual"][c], content, c))
    told = oracle.content()["errors"]
    same = [name for name in out["laws"] if _same(found, name, law)]
    out |= {
        "moves": _ratio(content["errors"], told, "before"),
        "beside_oracle": _ratio(content["errors"], told, "after"),
        "channel": channel,
        "there": bool(same),
        "named": len(same) == 1 and len(out["added"]) == 1,
        "false_law": any(name not in same for name in out["laws"]),
        "surely_wrong": [name for name in out["sure"] if name not in same],
        "held": None if not same else _held(found, same[0], law, out["parameters"]),
    }
    return out


def sure(content: Json) -> list[str]:
    """Effects that a diagnosis is sure of: no leads, no members of a tie, and nothing where most is unexplained."""
    if content["verdict"] != "effect_found":
        return []
    tied = {name for tie in content["ties"] or () for name in tie["effects"]}
    leads = {f["name"] for f in content["findings"] if f["lead"]}
    return [name for name in content["added"] if name not in leads | tied]


def _change(told: Json, content: Json, channel: str) -> float:
    return float(content["residual"][channel]["before"] / max(told["after"], 1e-12))


def _ratio(mine: Json, told: Json, when: str) -> float:
    """Largest ratio of errors on runs left out to those of the oracle, over quantities, at the middle horizon."""
    out = []
    for name, by_horizon in told["after"].items():
        h = list(by_horizon)[len(by_horizon) // 2]
        if by_horizon[h] and mine[when][name].get(h):
            out.append(mine[when][name][h] / by_horizon[h])
    return float(max(out, default=float("nan")))


def _values(found: Any, name: str) -> Array:
    """What a law of the diagnosis adds at the logged states (n,), with its values."""
    import torch

    from nsde_torch.diagnosis.candidates import effect_of
    from nsde_torch.systems.vocabulary import seen_by

    system = found.outcome.system.double()
    effect = effect_of(system, name)
    runs = found.recorded.runs
    x, u = (torch.from_numpy(np.concatenate([getattr(run, k) for run in runs])) for k in ("x", "u"))
    with torch.no_grad():
        seen = seen_by(system, effect, 0.0, system.augment(x, u), u)
        return np.asarray(effect(0.0, x, seen, x[:, :0]).sum(1).numpy())


def _true(found: Any, law: machines.Law) -> Array:
    """What the true law adds at the logged states (n,)."""
    runs = found.recorded.runs
    x, u = (np.concatenate([getattr(run, k) for run in runs]) for k in ("x", "u"))
    if law.kind.system in PATHS:
        r = machines.rotation(x[:, 6:10])
        x = np.concatenate([np.einsum("bji,bj->bi", r, x[:, 3:6]), x[:, 10:13], x[:, :3]], 1)
    return law(x, u)


def _same(found: Any, name: str, law: machines.Law) -> bool:
    """Whether a law that was found is the same function in the same row."""
    if name.partition(" = ")[0] != law.kind.text.partition(" = ")[0]:
        return False
    mine, true = _values(found, name), _true(found, law)
    return bool(abs(mine @ true) / np.sqrt((mine @ mine) * (true @ true)) > ALIKE)


def _held(found: Any, name: str, law: machines.Law, parameters: Json) -> bool | None:
    """Whether the size of the law lies in its interval, in the spelling that was found."""
    value, interval = parameters[f"{name}.c1"]
    if interval is None:
        return None
    mine, true = _values(found, name), _true(found, law)
    size = value * float(mine @ true) / float(mine @ mine)
    if law.kind.shape is not None and f"{name}.k1" in parameters:
        size = law.size
    return bool(interval[0] <= size <= interval[1])


def table(done: list[Json]) -> list[str]:
    """Counts by machine."""
    out = []
    for machine in dict.fromkeys(d["machine"] for d in done):
        own = [d for d in done if d["machine"] == machine]
        laws, nulls = [d for d in own if d["truth"]], [d for d in own if not d["truth"] and "error" not in d]
        there = [d for d in laws if d.get("there")]
        held = [d["held"] for d in there if d["held"] is not None]
        near = [d for d in laws if d.get("beside_oracle", np.inf) <= NEAR]
        out.append(
            f"{machine}: {sum(bool(d.get('named')) for d in laws)} of {len(laws)} laws named alone, "
            f"{len(there)} named, {sum(held)} of {len(held)} sizes in their interval, "
            f"{len(near)} within 10 % of the oracle, "
            f"{sum(bool(d.get('false_law')) for d in laws)} with a false law, "
            f"{sum(bool(d.get('surely_wrong')) for d in laws)} with anything wrong that is no lead; "
            f"{sum(bool(d['laws']) for d in nulls)} of {len(nulls)} nulls with a law, "
            f"{sum(bool(d['added']) for d in nulls)} with any effect; "
            f"median {np.median([d['seconds'] for d in own if 'seconds' in d]):.0f} s"
        )
    return out


def main() -> None:
    """Diagnoses cases one after another, and counts."""
    parser = options("Blind cases with laws that no catalogue has.", count=12)
    parser.add_argument("--machine", choices=[m for m in KINDS if not m.startswith(ODD)], required=True)
    parser.add_argument("--weaker", type=float, default=1.0, help="how many times weaker laws are made")
    a = parser.parse_args()

    def wrong(i: int) -> Json:
        kind = drawn(a.machine, a.seed, i)[1]
        truth = None if kind is None else {"law": kind.text}
        return {"case": i, "machine": a.machine, "truth": truth, "added": [], "laws": []}

    def line(answer: Json) -> str:
        keys = (
            "named",
            "leads",
            "surely_wrong",
            "held",
            "moves",
            "beside_oracle",
            "seconds",
            "error",
            "lead",
        )
        return f"{answer['case']} {answer['truth']} -> {answer['added']} { {k: answer.get(k) for k in keys} }"

    numbers = range(a.first, a.first + a.count)
    cases = [
        (f"{a.machine}_{a.seed}_{i:03d}", partial(case, a.machine, a.seed, i, a.weaker), wrong(i))
        for i in numbers
    ]
    print("\n".join(table(answers(a.out, cases, line))))


if __name__ == "__main__":
    main()
