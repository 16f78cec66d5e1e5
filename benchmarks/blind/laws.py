"""Blind cases with a law that no catalogue has, and nulls: named, value in its interval, error beside an oracle.

    python benchmarks/blind/laws.py --machine spring --seed 1 --count 12 --out runs/laws

Every case has another machine, another size and shape of the law, other noise and other forces. In turn three laws and
none; of seeds from 100000 on all have none. A law counts as named where what was added is the same function of the
logged states (correlation above 0.999) in the same row, in whatever spelling, and nothing else was added. The oracle is
told the law, with its size and shape free, and adds nothing. Surely wrong is what is no such law, no lead and no member
of a tie, where a diagnosis says that it found an effect.
"""

from functools import partial
from pathlib import Path
from typing import Any

import closed_loop
import law_machines as machines
import numpy as np
from law_machines import KINDS, ODD, SYSTEMS, Kind, Law, make_data
from study import (
    Array,
    Json,
    answers,
    columns,
    diagnosed,
    holds,
    judged,
    numbered,
    options,
    save,
    table,
    written,
)

PATHS = {
    "hexacopter": ("waypoints", "circle", "sines", "waypoints"),
    "quadrotor": ("sticks", "sines", "sticks", "waypoints"),
}
"""What multirotors fly; by sticks a pilot's tilts, which a weak hold answers."""
EVERY_NULL = 4
NULLS_ONLY = 100_000
"""Seeds from which all cases are nulls."""
ALIKE = 0.999


def drawn(machine: str, seed: int, i: int) -> tuple[np.random.Generator, Kind | None]:
    """Random numbers and kind of a case; None of a null."""
    order = np.random.default_rng([seed, 77]).permutation(len(KINDS[machine]))
    turn = i - i // EVERY_NULL
    null = seed >= NULLS_ONLY or i % EVERY_NULL == EVERY_NULL - 1
    kind = None if null else KINDS[machine][order[turn % len(order)]]
    return np.random.default_rng([seed, i]), kind


def write(machine: str, seed: int, i: int, folder: Path, weaker: float = 1.0) -> Law | None:
    """Write the runs of a case; returns its law, so many times weaker."""
    rng, kind = drawn(machine, seed, i)
    share, sign = float(np.exp(rng.uniform(np.log(0.05), np.log(0.25)))), float(rng.choice((-1.0, 1.0)))
    own, share = int(rng.integers(2**30)), share / weaker
    if machine in PATHS:
        return _multirotor(machine, kind, share * sign, rng, own, folder)
    runs, seconds = int(rng.integers(4, 9)), float(rng.uniform(10.0, 20.0))
    if machine == "joints":
        return _joints(kind, share * sign, rng, own, folder)
    system, state, how = SYSTEMS[machine], rng.bit_generator.state, (own, runs, seconds)
    plain = machines.small_runs(system, None, rng, *how)
    # what speeds the machine up, from differences over ten rows
    rates = np.concatenate([(x[10:, 1] - x[:-10, 1]) / (t[10] - t[0]) for t, x, _ in plain])
    force = float(np.sqrt(np.mean(np.square(rates))))
    law = _sized(kind, share * sign, [(x, u) for _, x, u in plain], force)
    still = np.concatenate([part for _, part, _ in plain])
    for _ in range(6):
        rng.bit_generator.state = state
        with np.errstate(all="ignore"):
            made = machines.small_runs(system, law, rng, *how)
        x = np.concatenate([part for _, part, _ in made])
        if np.isfinite(x).all() and bool((np.abs(x[:, :2]).max(0) < 2.0 * np.abs(still[:, :2]).max(0)).all()):
            break
        assert law is not None  # it drove the machine off: of the other sign, and smaller
        law = Law(law.kind, -0.7 * law.size, law.shape)
    for r, (t, x, u) in enumerate(made):
        save(folder / f"run_{r}.csv", columns(system), [t, x, u])
    return law


def _sized(kind: Kind | None, share: float, runs: list[tuple[Array, Array]], force: float) -> Law | None:
    """A law whose root mean square is a share of a force, on runs without it."""
    if kind is None:
        return None
    x, u = (np.concatenate(part) for part in zip(*runs, strict=True))
    shape = 0.0 if kind.shape is None else float(np.quantile(x[:, kind.along], kind.shape))
    size = float(np.sqrt(np.mean(np.square(kind.term(x, u, shape)))))
    # a stop pushes back
    share = -abs(share) * 3.0 if kind.shape is not None else share
    return Law(kind, share * force / max(size, 1e-9), shape)


def _joints(kind: Kind | None, share: float, rng: np.random.Generator, seed: int, folder: Path) -> Law | None:
    scale = np.exp(rng.uniform(np.log(0.7), np.log(1.4), 2))
    make_data.MASS_1, make_data.MASS_2 = 1.0 * scale[0], 0.6 * scale[1]
    torque = make_data.TORQUE[0 if kind is None else kind.row]
    swing = np.random.default_rng(seed).normal(size=(4000, 4)) * (0.5, 0.7, 2.0, 4.0)
    law = _sized(kind, 2.0 * share, [(swing, np.zeros((4000, 2)))], torque)
    noise = float(rng.uniform(0.3, 1.5))
    how = {"seed": seed % 100000, "runs": 4, "seconds": 12.0, "noise": noise}
    with np.errstate(all="ignore"):
        for _ in range(12):
            if law is None or _stays(law, seed % 100000):
                break
            law = Law(law.kind, -0.8 * law.size, law.shape)  # it drives the machine off
        make_data.write(folder, machines.joint_push(law), **how)
    return law


def _stays(law: Law, seed: int) -> bool:
    """Whether two joints stay within bounds under half of their torques, in the runs of a seed."""
    rng = np.random.default_rng(seed)
    for own in [int(rng.integers(2**31)) for _ in range(4)]:
        x = make_data.simulate(1200, np.random.default_rng(own), machines.joint_push(law), 0.0, 0.5)
        if not np.abs(x[:, 1]).max() < make_data.WITHIN:
            return False
    return True


def _multirotor(
    machine: str, kind: Kind | None, share: float, rng: np.random.Generator, seed: int, folder: Path
) -> Law | None:
    made = closed_loop._machine(machine, rng)
    law = None
    if kind is not None:
        spread = np.array([1.0, 1.0, 0.4, 0.4, 0.4, 0.5, 1.0, 1.0, 0.4])
        seen = np.random.default_rng(seed).normal(size=(4000, 9)) * spread
        law = _sized(kind, share, [(seen, np.zeros((4000, 6)))], 2.0 if kind.row < 3 else 4.0)
        made = machines.Machine(**{**vars(made), "effects": {"law": {"of": law}}})
    for r, log in enumerate(machines.flights(made, seed, 25.0, PATHS[machine])):
        save(folder / f"flight_{r}.csv", columns("multirotor", log.u.shape[1]), [log.t, log.x, log.u])
    return law


def case(machine: str, weaker: float, seed: int, i: int) -> Json:
    import nsde_torch

    logs = []

    def read(folder: Path) -> Law | None:
        law = write(machine, seed, i, folder, weaker)
        logs.append(nsde_torch.read(folder, system=SYSTEMS[machine]))
        return law

    law, found, answer = written(read, SYSTEMS[machine])
    named = [name for name in answer["added"] if "=" in name]
    if law is None:
        return {"kind": f"{machine}: nothing", "false_law": bool(named), **judged(answer, {})}
    start = {"c1": law.size, **({"k1": law.shape} if law.kind.shape is not None else {})}
    oracle = diagnosed(logs[0], SYSTEMS[machine], effects={law.kind.text: start}, max_effects=0)[0].content()
    same = {name: {} for name in named if _same(found, name, law)}
    held = _held(found, next(iter(same)), law, answer["parameters"]) if same else None
    alone = len(same) == len(answer["added"]) == 1
    return {
        **judged(answer, same, right=alone),
        "alone": alone,
        "truth": {law.kind.text: {"c1": law.size, "k1": law.shape}},
        "there": list(same),
        "moves": _ratio(found.content()["errors"]["before"], oracle["errors"]["after"]),
        "false_law": any(name not in same for name in named),
        "inside": [0, 0] if held is None else [int(held), 1],
    }


def _ratio(mine: Json, told: Json) -> float:
    """Largest ratio of errors on runs left out to those of the oracle, over quantities, at the middle horizon."""
    middle = {name: list(by)[len(by) // 2] for name, by in told.items()}
    pairs = [(mine[name].get(h), told[name][h]) for name, h in middle.items()]
    return float(max((one / two for one, two in pairs if one and two), default=float("nan")))


def _both(found: Any, name: str, law: Law) -> tuple[Array, Array]:
    """What a law of the diagnosis, with its values, and the true law add at the logged states (n,)."""
    import torch

    from nsde_torch.diagnosis.candidates import effect_of
    from nsde_torch.systems.vocabulary import seen_by

    system = found.outcome.system.double()
    effect = effect_of(system, name)
    x, u = (np.concatenate([getattr(run, k) for run in found.recorded.runs]) for k in ("x", "u"))
    states, inputs = torch.from_numpy(x), torch.from_numpy(u)
    with torch.no_grad():
        seen = seen_by(system, effect, 0.0, system.augment(states, inputs), inputs)
        mine = np.asarray(effect(0.0, states, seen, states[:, :0]).sum(1).numpy())
    if law.kind.system in PATHS:
        r = machines.rotation(x[:, 6:10])
        x = np.concatenate([np.einsum("bji,bj->bi", r, x[:, 3:6]), x[:, 10:13], x[:, :3]], 1)
    return mine, law(x, u)


def _same(found: Any, name: str, law: Law) -> bool:
    """Whether a law that was found is the same function in the same row."""
    if name.partition(" = ")[0] != law.kind.text.partition(" = ")[0]:
        return False
    mine, true = _both(found, name, law)
    return bool(abs(mine @ true) / np.sqrt((mine @ mine) * (true @ true)) > ALIKE)


def _held(found: Any, name: str, law: Law, parameters: Json) -> bool | None:
    """Whether the size of the law lies in its interval, in the spelling that was found."""
    said = parameters[f"{name}.c1"]
    if said["interval_90"] is None:
        return None
    mine, true = _both(found, name, law)
    size = said["value"] * float(mine @ true) / float(mine @ mine)
    if law.kind.shape is not None and f"{name}.k1" in parameters:
        size = law.size
    return holds({"interval_90": said["interval_90"]}, size)


def main() -> None:
    parser = options(__doc__, "seed", "out", first=0, count=12)
    parser.add_argument("--machine", choices=[m for m in KINDS if m not in ODD], required=True)
    parser.add_argument("--weaker", type=float, default=1.0, help="how many times weaker laws are made")
    a = parser.parse_args()
    cases = numbered(a, partial(case, a.machine, a.weaker), a.machine)
    table(answers(a.out, cases), also=["there", "false_law"])


if __name__ == "__main__":
    main()
