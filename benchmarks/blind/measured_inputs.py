"""Springs whose force was measured: how is it read, and do the values and intervals of the physics hold?

    python benchmarks/blind/measured_inputs.py --seeds 20

The machine is integrated here, all seeds side by side in steps of 1 ms, and shares nothing with the package. Its gain,
stiffness, damping, rate and noises are drawn. `read` lists what the reader said of the force, `held` the 90 % intervals
that hold the true values, of the likelihood of the logs as they were read; `as logged` those of the logs as they are.
"""

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as students
from study import Array, head, line, options

from nsde_torch import read
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError
from nsde_torch.inference import fit
from nsde_torch.systems import make_system

SPRING, FINE_S, RUN_S = make_system("mass_spring_damper"), 0.001, 30.0
LABELS = "force_gain", "linear_spring.stiffness", "viscous_friction.damping"


class Kind(NamedTuple):
    """How a force was made and measured: sizes are shares of its standard deviation, unless they have a unit."""

    levels: int = 0  # that the command steps between; 0: a sum of waves
    noise: tuple[float, float] = (0.0, 0.0)  # of the force's sensor, least and most
    lag_s: float = 0.0  # of the actuator behind the command; then the force is logged as it was at each row
    play: float = 0.0  # behind the logged force
    loop: bool = False  # whether a controller reads noisy states


KINDS = {
    "commands": Kind(),
    "commands of two levels": Kind(levels=2),
    "commands of a controller": Kind(loop=True),
    "commands, and play behind them": Kind(play=0.6),
    "commands of a controller, and play": Kind(loop=True, play=0.3),
    "noise": Kind(noise=(0.05, 0.4)),
    "noise about two levels": Kind(levels=2, noise=(0.02, 0.1)),
    "noise about three levels": Kind(levels=3, noise=(0.02, 0.1)),
    "noise, commands of a controller": Kind(noise=(0.05, 0.3), loop=True),
    "between rows": Kind(levels=2, lag_s=0.03),
    "between rows, and noise": Kind(levels=2, lag_s=0.03, noise=(0.02, 0.1)),
    "between rows, a controller's, and noise": Kind(lag_s=0.03, noise=(0.05, 0.2), loop=True),
}


def logs(kind: Kind, seeds: int, rng: np.random.Generator) -> tuple[list[list[RawRun]], Array]:
    """Two runs of each seed, and gain, stiffness and damping (seeds, 3)."""
    true = np.stack([rng.uniform(*ends, seeds) for ends in ((0.5, 2.0), (1.0, 6.0), (0.1, 0.9))], 1)
    steps = rng.choice([5, 10, 20], seeds)  # fine steps of a row
    noise, sensor = rng.uniform(*kind.noise, seeds), rng.uniform(0.0003, 0.002, seeds)
    of = zip(true, steps.tolist(), noise, sensor, strict=True)
    return [[_run(kind, *one, rng, name) for name in "ab"] for one in of], true


def _run(
    kind: Kind, true: Array, every: int, noise: float, sensor: float, rng: np.random.Generator, name: str
) -> RawRun:
    gain, stiffness, damping = true.tolist()
    n = round(RUN_S / (FINE_S * every))
    t: Array = FINE_S * every * np.arange(n, dtype=np.float64)
    turn, phase = 2.0 * np.pi * rng.uniform(0.1, 1.5, 5), rng.uniform(0.0, 6.3, 5)
    waves = np.sin(np.outer(t, turn) + phase).sum(1) / 2.0
    hold = np.repeat(rng.integers(max(kind.levels, 1), size=n), round(0.3 / (FINE_S * every)))[:n]
    wanted = np.linspace(-0.7, 0.7, kind.levels)[hold] if kind.levels else waves
    x, logged, gap = np.zeros((n, 2)), np.zeros(n), kind.play * wanted.std()
    q, v, force, acts = 0.3, 0.0, wanted[0], 0.0
    pushed = 0.05 * rng.standard_normal(n * every) / FINE_S**0.5
    for k in range(n):
        seen = (q, v) + sensor * np.array([1.0, 3.0]) * rng.standard_normal(2)
        command = 3.0 * (0.6 * wanted[k] - seen[0]) - 1.0 * seen[1] if kind.loop else wanted[k]
        force = force if kind.lag_s else command
        x[k], logged[k] = (q, v), force
        for i in range(every):
            force += FINE_S / kind.lag_s * (command - force) if kind.lag_s else 0.0
            acts = min(max(acts, force - 0.5 * gap), force + 0.5 * gap) if gap else force
            rate = gain * acts - stiffness * q - damping * v + 0.3 * pushed[k * every + i]
            q, v = q + FINE_S * (v + 0.5 * FINE_S * rate), v + FINE_S * rate
    x += sensor * np.array([1.0, 3.0]) * rng.standard_normal(x.shape)
    return RawRun(name, t, x, (logged + noise * logged.std() * rng.standard_normal(n))[:, None])


def values(runs: list[RawRun], **how: Any) -> tuple[Array, Array, str]:
    """Values of gain, stiffness and damping, half widths of their 90 % intervals, and what was said of the force."""
    data = read(runs, system=SPRING, **how)
    best = fit(SPRING, data.runs)
    order = [best.vector.labels.index(name) for name in LABELS]
    half = np.full(len(best.theta), np.nan)
    factor = students.ppf(0.95, best.spread.degrees(np.eye(len(best.free))))
    half[best.free] = best.standard_errors[best.free] * factor
    names = {"input_noise": "noise", "input_between_rows": "between rows", "state_smoothing": "smoothed"}
    said = [names[f.kind] for f in data.summary.findings if f.kind in names]
    return best.theta[order], half[order], " and ".join(said) or "as logged"


def main() -> None:
    given = options(__doc__, seeds=20, seed=1).parse_args()
    head("force", "read", "held", "error of the gain", "as logged: held", "error of the gain")
    for number, (name, kind) in enumerate(KINDS.items()):
        cases, true = logs(kind, given.seeds, np.random.default_rng([given.seed, number]))
        said: Counter[str] = Counter()
        cells = []
        for how in ({}, {"state_smoothing": "keep"}):
            inside, errors = [], []
            for runs, values_of in zip(cases, true, strict=True):
                try:
                    found, half, what = values(runs, **how)
                except DataError as error:
                    said[f"refused ({error})"] += 1
                    continue
                said.update([what] if not how else [])
                inside.append(np.abs(found - values_of) <= half)
                errors.append(abs(found[0] / values_of[0] - 1.0))
            off = f"{np.mean(errors):.1%}, at most {np.max(errors):.1%}"
            cells += [f"{np.sum(inside)} of {np.size(inside)}", off]
        read_as = ", ".join(f"{what} {count}" for what, count in said.most_common())
        print(line([name, read_as, *cells]), flush=True)


if __name__ == "__main__":
    main()
