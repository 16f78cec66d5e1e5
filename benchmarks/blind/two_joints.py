"""Blind cases on two-joint machines: other masses, lengths, speeds and seeds in each case, truths of known size.

Runs are made by `examples/double_pendulum/make_data.py`, which shares no code with the package; the model is the
user's class beside it. Kinds in turn: one effect in one joint, one in each joint, nothing.

    python benchmarks/blind/two_joints.py --seed 1 --count 20 --out runs/two_joints
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from study import Json, answers, judged, numbered, options, table, written

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "double_pendulum"))
import make_data

SYSTEM = "double_pendulum:DoublePendulum"
KINDS = ("single", "pair", "single", "null")
Law = Callable[[float, float], float]


def laws(rng: np.random.Generator, torque: float, speed: float) -> dict[str, tuple[Law, dict[str, float]]]:
    """Laws of one joint with sizes drawn for a joint of this torque [N m] and speed [rad/s], by catalogue name."""
    c = torque * np.exp(rng.uniform(np.log(0.08), np.log(0.3)))
    v0 = 0.01 * speed
    ratio, vs = rng.uniform(0.3, 0.6), 0.15 * speed
    d1, d2, k = c / speed, c / speed**2, 2.0 * c

    def uneven(q: float, w: float) -> float:
        return -(c if w > 0 else ratio * c) * np.tanh(w / v0)

    def stribeck(q: float, w: float) -> float:
        return -(c + c * np.exp(-((w / vs) ** 2))) * np.tanh(w / v0)

    return {
        "coulomb_friction": (lambda q, w: -c * np.tanh(w / v0), {"size": c}),
        "viscous_friction": (lambda q, w: -d1 * w, {"damping": d1}),
        "quadratic_damping": (lambda q, w: -d2 * abs(w) * w, {"damping": d2}),
        "constant_force": (lambda q, w: c, {"acceleration": c}),
        "cubic_stiffness": (lambda q, w: -k * q**3, {"stiffness": k}),
        "asymmetric_friction": (uneven, {"size_forward": c, "size_backward": ratio * c}),
        "stribeck_friction": (stribeck, {"size": c, "extra": c}),
    }


def drawn(seed: int, i: int) -> tuple[str, dict[str, dict[str, float]], make_data.Push]:
    """Kind, true effects with their parameters, and what they push with; sets the machine's masses and lengths."""
    rng = np.random.default_rng([seed, i])
    scale = np.exp(rng.uniform(np.log(0.6), np.log(1.6), 4))
    make_data.MASS_1, make_data.MASS_2 = 1.0 * scale[0], 0.6 * scale[1]
    make_data.LENGTH_1, make_data.CENTRE_1 = 0.25 * scale[2], 0.12 * scale[2]
    make_data.CENTRE_2 = 0.14 * scale[3]
    make_data.INERTIA_1 = 0.012 * scale[0] * scale[2] ** 2
    make_data.INERTIA_2 = 0.006 * scale[1] * scale[3] ** 2
    torque = (0.6 * scale[0] * scale[2], 0.15 * scale[1] * scale[3])
    make_data.TORQUE = torque
    kind = KINDS[i % len(KINDS)]
    push: list[Law] = [lambda q, w: 0.0, lambda q, w: 0.0]
    truth: dict[str, dict[str, float]] = {}
    joints = {"single": [int(rng.integers(2))], "pair": [0, 1], "null": []}[kind]
    for joint in joints:
        known = laws(rng, torque[joint], (2.0, 4.0)[joint])
        name = list(known)[int(rng.integers(len(known)))]
        push[joint], truth[f"{name}[q{joint + 1}]"] = known[name]
    return kind, truth, lambda q, w: np.array([push[0](q[0], w[0]), push[1](q[1], w[1])])


def case(seed: int, i: int) -> Json:
    kind, truth, push = drawn(seed, i)
    noise = (1.0, 0.3, 3.0)[i % 3]
    how: dict[str, Any] = {"seed": seed * 1000 + i, "runs": 4, "seconds": 12.0, "noise": noise}
    _, _, answer = written(lambda folder: make_data.write(folder, push, **how), SYSTEM)
    right = set(answer["added"]) == set(truth) if kind == "pair" else None  # both, and nothing else
    return {"kind": kind, "noise": noise, **judged(answer, truth, right=right)}


def main() -> None:
    a = options(__doc__, "seed", "out", first=0, count=20).parse_args()
    table(answers(a.out, numbered(a, case)))


if __name__ == "__main__":
    main()
