"""Ten drives with dry friction, an offset and a controller: names, parameters and intervals against the truth.

    m a = F - b v - c(v) sign(v) + o        sticks at v = 0 while |F + o| is below the friction

by its own stepper at 20 kHz (no code of the package): the carriage stands still exactly while it sticks. A controller
at 1 kHz follows ramps of position (proportional on position, proportional on speed from differences of the encoder);
its force is held. Logged are encoder and force at 1 kHz; the log is then treated as a user would: zero-phase
Butterworth filter at 100 Hz, central differences, and every `--step` the states and the mean of the force until then.

    python benchmarks/bench_friction_drive.py --seed 1 --count 10
"""

from typing import Any, NamedTuple

import numpy as np
from common import Array, head, line, options

import nsde_torch
from nsde_benchmarks.public.emps import PositioningDrive, filtered_log
from nsde_torch.recording import assemble

STEP, CONTROL = 5e-5, 1e-3
WITHIN = 0.02
NONE = {"value": np.nan, "interval_90": None}


class Truth(NamedTuple):
    mass: float  # [kg]
    viscous: float  # b [N s/m]
    dry: float  # c [N]
    offset: float  # o [N]
    speed: float  # largest of the ramps [m/s]
    ripple: float  # standard deviation of the force that nobody logs, new every millisecond [N]
    tick: float  # of the encoder [m]


def drawn(rng: np.random.Generator) -> Truth:
    """A drive from 2 to 200 kg whose friction matters at its speeds."""
    mass, speed = np.exp(rng.uniform(np.log((2.0, 0.05)), np.log((200.0, 0.5))))
    dry = mass * rng.uniform(0.1, 0.6)
    viscous = mass * rng.uniform(1.0, 4.0)
    offset = dry * rng.choice((-1.0, 1.0)) * rng.uniform(0.05, 0.4)
    return Truth(mass, viscous, dry, offset, speed, 0.02 * dry, 10.0 ** rng.uniform(-7, -5.5))


def recorded(truth: Truth, rng: np.random.Generator, seconds: float = 25.0) -> tuple[Array, Array, Array]:
    """Time, encoder and force at 1 kHz of a drive that follows ramps to and fro."""
    steps, inner = round(seconds / CONTROL), round(CONTROL / STEP)
    legs = rng.uniform(0.3, 1.0, 4 * round(seconds)) * truth.speed * np.tile((1, 1, -1, -1), round(seconds))
    wanted = np.cumsum(np.repeat(legs, round(0.5 / CONTROL))[:steps]) * CONTROL
    stiff, damp = 30.0, 60.0 * truth.mass
    q = v = seen = speed = 0.0
    log = np.empty((steps, 2))
    push = truth.ripple * rng.standard_normal(steps)
    for k in range(steps):
        before, seen = seen, round(q / truth.tick) * truth.tick
        speed += 0.2 * ((seen - before) / CONTROL - speed)
        force = damp * (stiff * (wanted[k] - seen) - speed)
        log[k] = seen, force
        drive = force + push[k] + truth.offset
        for _ in range(inner):
            if v == 0.0 and abs(drive) <= truth.dry:
                continue
            way = np.sign(v) if v != 0.0 else np.sign(drive)
            after = v + STEP * (drive - truth.viscous * v - truth.dry * way) / truth.mass
            if v != 0.0 and after * v < 0.0:
                after = 0.0  # it stops, and goes on where the force is larger than the friction
            q += 0.5 * STEP * (v + after)
            v = after
    t: Array = CONTROL * np.arange(steps, dtype=np.float64)
    return t, log[:, 0], log[:, 1]


def readings(found: Any) -> dict[str, tuple[float, float, float]]:
    """Value and ends of its interval of gain, viscous, dry friction and offset, over mass; nan where not named."""
    declared = found.content()["declared_parameters"]
    out = {name: _ends(declared[name]) for name in ("force_gain", "viscous_friction.damping")}
    named = found.parameters
    two = [named.get(f"asymmetric_friction.size_{way}") for way in ("forward", "backward")]
    if two[0] and two[1]:
        (f, b), ends = (p["value"] for p in two), [p["interval_90"] for p in two]
        wide = 0.5 * sum(0.5 * (e[1] - e[0]) if e else np.inf for e in ends)
        return out | {
            k: (v, v - wide, v + wide) for k, v in (("dry", 0.5 * (f + b)), ("offset", 0.5 * (b - f)))
        }
    dry = named.get("coulomb_friction.size", named.get("stribeck_friction.size", NONE))
    push = named.get("constant_force.acceleration", NONE)
    return out | {"dry": _ends(dry), "offset": _ends(push)}


def _ends(p: Any) -> tuple[float, float, float]:
    return p["value"], *(p["interval_90"] or (-np.inf, np.inf))


def main() -> None:
    parser = options(__doc__, seed=1, count=10)
    parser.add_argument("--step", type=float, default=0.005, help="of the log that is diagnosed [s]")
    arguments = parser.parse_args()
    right = within = held = told = 0
    head("drive", "mass [kg]", "found", "1/m", "viscous", "dry", "offset", "intervals that hold")
    for number in range(arguments.count):
        rng = np.random.default_rng((arguments.seed, number))
        truth = drawn(rng)
        run = filtered_log(*recorded(truth, rng), step=arguments.step)
        log = assemble([run], PositioningDrive(), kind="simulated")
        found = nsde_torch.diagnose(log, system=PositioningDrive)
        m = truth.mass
        own = {"viscous_friction.damping": truth.viscous, "dry": truth.dry, "offset": truth.offset}
        true = {"force_gain": 1 / m, **{name: value / m for name, value in own.items()}}
        read = readings(found)
        off = {k: read[k][0] / v - 1 for k, v in true.items()}
        holds = [read[k][1] <= v <= read[k][2] for k, v in true.items() if np.isfinite(read[k][0])]
        right += set(found.added) in ({"asymmetric_friction"}, {"coulomb_friction", "constant_force"})
        within += sum(abs(e) <= WITHIN for e in off.values())
        told, held = told + len(holds), held + sum(holds)
        cells = [f"{e:+.1%}" if np.isfinite(e) else "not named" for e in off.values()]
        cells += [f"{sum(holds)} of {len(holds)}"]
        print(line([number, f"{m:.3g}", ", ".join(found.added), *cells]), flush=True)
    parameters = f"{within} of {4 * arguments.count} parameters within {WITHIN:.0%}"
    print(
        f"\n{right} of {arguments.count} drives named in full and nothing else; {parameters}; {held} of {told} hold"
    )


if __name__ == "__main__":
    main()
