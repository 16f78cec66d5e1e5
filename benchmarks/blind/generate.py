"""Blind cases: data sets of machines that hold something, or nothing, and the truth in another folder.

    python benchmarks/blind/generate.py --seed 1 --count 300 --out blind/

by the code of `nsde simulate`: one effect of the catalogue (21 of 36 cases), two that are not special cases of each
other, a fault of the recording chain, an effect that no catalogue has (`outside`), or nothing. Every system and every
effect that its plant can hold takes its turn, at both levels of noise; sizes are log-uniform shares of what moves the
machine (see `sizes`). Machines hold nothing else that is undeclared.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from outside import OUTSIDE
from run import KINDS
from sizes import Values, amplitudes, shapes
from study import missing, options, pooled

from nsde_torch.diagnosis.candidates import why_not
from nsde_torch.effects import Effect, effect_class, effects_of
from nsde_torch.effects.law import split_name
from nsde_torch.errors import ConfigError, NsdeError
from nsde_torch.recording import Recording
from nsde_torch.simulation import simulate
from nsde_torch.simulation import write as write_data
from nsde_torch.systems import make_system

SYSTEMS = ("mass_spring_damper", "cartpole", "hexacopter")
PERIOD = ("single",) * 21 + ("pair",) * 5 + ("recording",) * 2 + ("outside",) * 4 + ("null",) * 4
"""Kinds in 36 cases."""
NOISE = {"quiet": 0.5, "noisy": 1.5}
"""Factor on sensor noise and, where the machine has any, gusts."""
SHARES: dict[str, tuple[float, float]] = {
    "mass_spring_damper": (0.0005, 0.2),
    "cartpole": (0.001, 0.25),
    "hexacopter": (0.01, 0.35),
}
"""Least and largest share of what moves the machine, from barely visible to strong: the spring has no gusts."""
CLEAR = 6.0
"""Factor on the least share of effects in pairs and outside the catalogue."""
DURATIONS = {"mass_spring_damper": [20.0] * 6, "cartpole": [4.0] * 20, "hexacopter": [45.0] * 4}
FAULTS = ("input_smoothing", "input_delay", "clock_scale", "sensor_bias")
_TURNED = "frame_misalignment"
_LATER = {  # than the committed seeds, whose draws stay what they were; of every coordinate
    *("drift_velocity", "exchange", "relaxation", "viscoelasticity", "added_inertia", "gravity_torque"),
    *("axial_inflow", "rotor_drag", "translational_lift", "asymmetric_lag", "actuator_rate_limit"),
    *("tracked_point", "supply_sag", "slung_load", "link_weight", "hidden_mass", "stop_above", "stop_below"),
    *("run_periodic_force", "actuator_resonance"),
}
TIES = (
    {"input_delay", "actuator_lag", "motor_lag"},
    {"thrust_sag", "battery_voltage"},
    {"coulomb_friction", "asymmetric_friction", "stribeck_friction", "position_dependent_friction"},
    {"linear_drag", "constant_wind", "constant_world_force"},
)
"""Effects that a pair does not hold two of: hardly any data could tell them apart."""
_WEAKER = 4
"""How often a case that the machine cannot survive is made half as strong."""


@dataclass(frozen=True)
class Case:
    name: str  # of its files; tells nothing
    system: str
    kind: str  # one of `KINDS`
    effects: dict[str, Values]  # what it holds, `name` or `module:Class` -> parameters
    recording: dict[str, Any]  # faults of the recording chain, keys of `Recording`
    noise: str  # one of `NOISE`
    seed: int
    shares: dict[str, float] = field(default_factory=dict)
    """Share of what moves the machine, by effect; none where a time or a level is its size."""


def holdable(system: str) -> list[str]:
    """Effects of the catalogue that a plant can hold, beyond those declared, and that are no fault of the log."""
    machine = make_system(system)
    found = effects_of(system, machine.ports, machine.bound_coordinates())
    later = {name for name in found if split_name(name)[0] in _LATER}
    never = {_TURNED, "position_bias[pole]", *later}
    return [name for name in found if not why_not(machine, name) and name not in never]


def cases(seed: int, n: int, *, systems: Sequence[str] = SYSTEMS, kinds: Sequence[str] = KINDS) -> list[Case]:
    """Blind cases; the first of a longer list are those of a shorter one."""
    order = np.random.default_rng([seed, 0])
    turns: dict[tuple[str, str], Iterator[Any]] = {}
    for system in systems:
        every = {
            "single": holdable(system),
            "outside": OUTSIDE[system],
            "recording": [*FAULTS, *([_TURNED] if system == "hexacopter" else [])],
        }
        for kind, some in every.items():
            turns[system, kind] = cycle([some[i] for i in order.permutation(len(some))])
    period = [k for k in (PERIOD[i] for i in order.permutation(len(PERIOD))) if k in kinds]
    made = []
    digits = max(3, len(str(n - 1)))
    seen: dict[tuple[str, str], int] = {}
    for i in range(n):
        system, kind = systems[i % len(systems)], period[(i // len(systems)) % len(period)]
        rng = np.random.default_rng([seed, 1, i])
        count = seen[system, kind] = seen.get((system, kind), -1) + 1
        rounds, turn = divmod(count, max(1, len(holdable(system)))) if kind == "single" else (0, count)
        noise = tuple(NOISE)[(turn + rounds) % 2]
        case = Case(f"case_{i:0{digits}d}", system, kind, {}, {}, noise, int(rng.integers(2**31)))
        made.append(_filled(case, turns, rng))
    return made


def _filled(case: Case, turns: dict[tuple[str, str], Iterator[Any]], rng: np.random.Generator) -> Case:
    system, kind = case.system, case.kind
    if kind == "null":
        return case
    if kind == "recording":
        return replace(case, recording=_fault(next(turns[system, kind]), system, rng))
    if kind == "single":
        chosen: list[tuple[str, type[Effect]]] = [(name := next(turns[system, kind]), effect_class(name))]
    elif kind == "outside":
        cls = next(turns[system, kind])
        chosen = [(f"outside:{cls.__name__}", cls)]
    else:
        chosen = _pair(system, rng)
    effects, shares = {}, {}
    for key, cls in chosen:
        low, high = SHARES[system]
        low *= CLEAR if kind in ("pair", "outside") else 1.0
        share = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        shape = shapes(cls, system, rng)
        effects[key] = {**shape, **amplitudes(cls, system, shape, share, rng)} if cls.amplitudes else shape
        if cls.amplitudes:
            shares[cls.name] = share
    return replace(case, effects=effects, shares=shares)


def _pair(system: str, rng: np.random.Generator) -> list[tuple[str, type[Effect]]]:
    names = holdable(system)
    while True:
        a, b = (names[i] for i in rng.choice(len(names), 2, replace=False))
        contained = b in effect_class(a).includes or a in effect_class(b).includes
        (one, of), (other, of_other) = split_name(a), split_name(b)
        tied = of == of_other and any({one, other} <= tie for tie in TIES)
        if not contained and not tied:
            return [(name, effect_class(name)) for name in (a, b)]


def _fault(name: str, system: str, rng: np.random.Generator) -> dict[str, Any]:
    dt = {"mass_spring_damper": 0.01, "cartpole": 0.02, "hexacopter": 0.01}[system]
    if name == "input_smoothing":
        return {name: float(rng.integers(4, 16 if system == "cartpole" else 40)) * dt}
    if name == "input_delay":
        return {name: float(rng.integers(2, 8)) * dt}
    if name == "clock_scale":
        return {name: float(np.exp(rng.choice((-1.0, 1.0)) * rng.uniform(0.02, 0.1)))}
    if name == "frame_misalignment":
        v = rng.standard_normal(3)
        return {name: [float(w) for w in rng.uniform(1.0, 8.0) * v / np.linalg.norm(v)]}
    state, size = {
        "mass_spring_damper": ("q_dot", 0.1),
        "cartpole": ("theta", 0.1),
        "hexacopter": (("v_x", "v_y", "w_x", "w_y")[int(rng.integers(4))], 0.2),
    }[system]
    return {name: {state: float(size * rng.choice((-1.0, 1.0)) * rng.uniform(0.3, 1.5))}}


def write(case: Case, folder: str | Path) -> Path:
    """Write the data of a case to `folder/data/NAME` and its truth to `folder/truth/NAME.json`.

    Effects that the machine cannot survive are made half as strong, a few times (NsdeError: it does not survive the
    weakest); the truth has what was held. Returns the folder of the data.
    """
    factor, flying = NOISE[case.noise], case.system == "hexacopter"
    for attempt in range(_WEAKER + 1):
        try:
            made = simulate(
                case.system,
                effects=case.effects,
                durations=DURATIONS[case.system],
                seed=case.seed,
                process_noise=1.0 if case.system == "mass_spring_damper" else factor,
                sensor_noise=factor,
                declared_only=True,
                battery=flying,
                recording=Recording(**case.recording),
                options={"variants": 8, "rounds": 1} if flying else {},
            )
            break
        except ConfigError:
            if attempt == _WEAKER:
                raise
            case = _halved(case)
    about = {"kind": case.kind, "noise": case.noise, "shares": case.shares}
    data = Path(folder) / "data" / case.name
    made = replace(made, truth={**made.truth, "case": about})
    write_data(made, data, truth=Path(folder) / "truth" / f"{case.name}.json", overwrite=True)
    return data


def _halved(case: Case) -> Case:
    effects: dict[str, Values] = {}
    for key, values in case.effects.items():
        cls = effect_class(key)
        weak = cls.amplitudes or ("delay", "time_constant", "width")
        effects[key] = {
            k: v if k not in weak else [0.5 * w for w in v] if isinstance(v, list) else 0.5 * v
            for k, v in values.items()
        }
        if "level" in values:
            effects[key]["level"] = 1.3 * float(values["level"])  # type: ignore[arg-type]
    return replace(case, effects=effects, shares={k: 0.5 * v for k, v in case.shares.items()})


def _job(case: Case, folder: Path) -> str:
    try:
        write(case, folder)
    except NsdeError as error:
        return f"not made: {error}"
    return "written"


def main() -> None:
    parser = options(__doc__, "seed", "out", count=300, jobs=1)
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=SYSTEMS, help="machines")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS, help="kinds of cases")
    given = parser.parse_args()
    every = {c.name: c for c in cases(given.seed, given.count, systems=given.systems, kinds=given.kinds)}
    pooled(given.jobs, {n: partial(_job, every[n], given.out) for n in missing(given.out, "truth", every)})


if __name__ == "__main__":
    main()
