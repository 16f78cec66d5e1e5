"""Springs that remember: hysteresis, play of the input, a spring behind a damper, a fluid that is dragged along.

    q'' = -k q - b v + g u_eff - f,     Bouc-Wen  f = s z,  z' = (v - w |v| z - (1 - w) v |z|) / d
                                        Dahl      f = s z,  z' = (v - |v| z) / d
                                        Maxwell   f = 6 s z,  z' = v - z / T
                                        fluid     f = 4 s (v - z),  z' = (v - z) / T

beside delays, lags, friction and nothing, by Runge-Kutta 4 at a fifth of the step, with white gusts; play is Tao and
Kokotovic's operator on rows of the input.

    python benchmarks/blind/remembering.py --seed 1 --count 12
"""

from typing import Any

import numpy as np
from small_machines import step, sums_of_sines
from study import Array, Json, answers, diagnosed, judged, numbered, options, table

from nsde_torch.data.raw import RawRun

RIGHT = {
    **{"bouc_wen": "hysteresis", "play": "input_play", "delay": "input_delay", "lag": "actuator_lag"},
    **{"coulomb": "coulomb_friction", "dahl": "hysteresis", "null": "", "maxwell": "viscoelasticity"},
    "fluid": "relaxation",
}
DT, FINE, NOISE, GUST = 0.01, 5, 1e-3, 0.02


def _acting(kind: str, u: Array, size: float) -> Array:
    if kind == "delay":
        rows = max(1, round(size / DT))
        return np.concatenate([np.full(rows, u[0]), u[:-rows]])
    out, acts, stays = u.copy(), u[0], np.exp(-DT / max(size, 1e-9))
    for n, command in enumerate(u):
        if kind == "play":
            acts = min(max(acts, command - size), command + size)
            out[n] = acts
        elif kind == "lag":
            acts = command + (acts - command) * stays
            out[n] = acts
    return out


def run(kind: str, values: dict[str, float], rng: np.random.Generator) -> tuple[Array, Array]:
    """Measured states (n, 2) and commands (n, 1) of one run of 15 s."""
    t = DT * np.arange(1500)
    u = sums_of_sines(t, 2.0, rng, 0.08, 1.5)
    acting, h, y = _acting(kind, u, values["time"]), DT / FINE, [0.0] * 3
    size, reach, slow = values["size"], values["reach"], values["slow"]

    def rate(y: Any, push: float) -> list[float]:
        q, v, z = y
        force = -values["k"] * q - values["b"] * v + values["g"] * push
        turn = 0.0
        if kind in ("bouc_wen", "dahl"):
            force -= size * z
            weight = values["weight"] if kind == "bouc_wen" else 1.0
            turn = (v - weight * abs(v) * z - (1.0 - weight) * v * abs(z)) / reach
        elif kind == "maxwell":
            force -= 6.0 * size * z
            turn = v - z / slow
        elif kind == "fluid":
            force -= 4.0 * size * (v - z)
            turn = (v - z) / slow
        elif kind == "coulomb":
            force -= size * np.tanh(v / 0.01)
        return [v, force, turn]

    out = np.empty((len(t), 2))
    for n, push in enumerate(acting):
        out[n] = y[:2]
        for _ in range(FINE):
            y = step(lambda y, push=push: rate(y, push), y, h)
            y[1] += GUST * np.sqrt(h) * rng.standard_normal()
    return out + rng.standard_normal(out.shape) * [NOISE, 10.0 * NOISE], u[:, None]


def case(seed: int, i: int) -> Json:
    rng = np.random.default_rng([seed, i])
    kind = list(RIGHT)[i % len(RIGHT)]
    values = {"k": rng.uniform(2, 6), "b": rng.uniform(0.2, 0.6), "g": rng.uniform(0.8, 1.6)}
    values |= {"size": rng.uniform(0.25, 0.6), "reach": rng.uniform(0.03, 0.25)}
    values["slow"] = float(np.exp(rng.uniform(np.log(0.15), np.log(2.0))))
    values["time"] = float(rng.uniform(0.1, 0.4) if kind == "play" else rng.uniform(0.02, 0.06))
    values["weight"] = 1.0 if kind == "dahl" else rng.uniform(0.3, 0.9)
    runs = []
    for n in range(4):
        x, u = run(kind, values, np.random.default_rng([seed, i, n]))
        runs.append(RawRun(f"run_{n}", DT * np.arange(len(x)) + 100.0 * n, x, u))
    of_way = {n: values[n] for n in ("size", "reach", "weight")} if kind in ("bouc_wen", "dahl") else {}
    true = {RIGHT[kind]: of_way} if RIGHT[kind] else {}
    return {"kind": kind, "values": values, **judged(diagnosed(runs, "mass_spring_damper")[1], true)}


def main() -> None:
    a = options(__doc__, "seed", first=0, count=12, out=None).parse_args()
    table(answers(a.out, numbered(a, case)))


if __name__ == "__main__":
    main()
