"""A mass on a spring that sticks: in each step dry friction takes off what speed there is, up to its size."""

import numpy as np

from nsde_torch.data.raw import RawRun

STICKING = {"force_gain": 1.25, "linear_spring.stiffness": 4.0, "viscous_friction.damping": 0.3}
_STEP, _INNER = 0.02, 40


def sticking_runs(size: float, *, seed: int = 0, runs: int = 3, seconds: float = 30.0) -> list[RawRun]:
    """Runs at 50 Hz under waves of force, in gusts, with noisy position and velocity; `size` of the friction [m/s2]."""
    rng, h = np.random.default_rng(seed), _STEP / _INNER
    gain, stiffness, damping = STICKING.values()
    out = []
    for k in range(runs):
        turn, phase, high = rng.uniform(0.9, 5.7, 4), rng.uniform(0.0, 6.3, 4), rng.uniform(0.5, 1.2, 4)
        count = round(seconds / _STEP)
        force = np.sin(_STEP * np.arange(count)[:, None] * turn + phase) @ high
        gust = 0.15 * rng.normal(size=(count, _INNER)) / (1e3 * h) ** 0.5
        q = v = 0.0
        x = np.empty((count, 2))
        for i in range(count):
            x[i] = q, v
            for j in range(_INNER):
                free = v + h * (gain * force[i] - stiffness * q - damping * v + gust[i, j])
                v = float(np.sign(free)) * max(abs(free) - h * size, 0.0)
                q += h * v
        x += 0.005 * rng.normal(size=x.shape)
        out.append(RawRun(f"run_{k}", 100.0 * k + _STEP * np.arange(count), x, force[:, None]))
    return out
