"""Springs with dry friction by SciPy-free Runge and Kutta, and what encoders and users make of them."""

import numpy as np
from numpy.typing import NDArray
from small_machines import measured, rates, spring

from nsde_torch.data.raw import RawRun

Array = NDArray[np.float64]
DT = 0.01
SPRING = {"k": 4.0, "b": 0.3, "g": 1.3, "force": 2.0}
TRUTH = {
    "force_gain": SPRING["g"],
    "linear_spring.stiffness": SPRING["k"],
    "viscous_friction.damping": SPRING["b"],
}


def encoder_runs(
    rate: str,
    *,
    seed: int = 0,
    friction: float = 0.2,
    noise: float = 1e-3,
    counts: bool = False,
    runs: int = 3,
    seconds: float = 15.0,
    gust: float = 0.02,
) -> list[RawRun]:
    """Runs whose position an encoder measures, under dry friction [m/s2] and a white gust [m/s1.5].

    The rate is from a "sensor" with ten times the encoder's noise [m], the "truth", "none", or one of
    `small_machines.RATES`.
    """
    out = []
    for i in range(runs):
        rng = np.random.default_rng([seed, i])
        how = {"seconds": seconds, "dt": DT, "gust": gust, "rng": rng}
        x, u = spring(SPRING, lambda q, v: -friction * np.tanh(v / 0.01), **how)
        q = measured(x[:, 0], noise, counts, rng)
        if rate == "sensor":
            v = x[:, 1] + 10.0 * noise * rng.standard_normal(len(q))
        elif rate == "truth":
            q, v = x[:, 0], x[:, 1]
        else:
            v = np.full(len(q), np.nan) if rate == "none" else rates(q, DT, rate)
        t = DT * np.arange(len(q)) + 100.0 * i
        out.append(RawRun(f"run_{i}", t, np.column_stack([q, v]), u))
    return out
