"""Springs for the tests of the likelihood, in NumPy: exact linear ones, and those of the broken-log study."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import expm
from small_machines import Small, run

from nsde_torch.data import Run
from nsde_torch.inference import MaximumLikelihood
from nsde_torch.inference.levels import Levels
from nsde_torch.systems import System, make_system

Array = NDArray[np.float64]
K, B, G = "linear_spring.stiffness", "viscous_friction.damping", "force_gain"
TRUTH: Mapping[str, float] = {G: 1.3, K: 4.0, B: 0.3}
SENSOR, WHITE, GUST, LASTS = (0.004, 0.01), 0.02, 0.3, 0.4


def spring(*effects: str, values: Mapping[str, float] = TRUTH) -> System:
    return make_system("mass_spring_damper", effects=list(effects), values=dict(values))


def moved(by: Mapping[str, float]) -> System:
    return spring(values={name: value + by.get(name, 0.0) for name, value in TRUTH.items()})


def levels_of(
    sensor: Sequence[float] = SENSOR, white: float = WHITE, gust: float = GUST, lasts: float = LASTS
) -> Levels:
    """Noise levels from sizes."""
    return Levels(*(torch.tensor(v, dtype=torch.float64).log() for v in (sensor, [white], [gust], [lasts])))


def exact_step(values: Mapping[str, float], h: float) -> tuple[Array, Array]:
    """Transition (2, 2) of position and rate over a step, and what a held acceleration does in it (2,)."""
    rate = np.zeros((3, 3))
    rate[0, 1], rate[1] = 1.0, (-values[K], -values[B], 1.0)
    whole = expm(h * rate)
    return whole[:2, :2], whole[:2, 2]


def linear_runs(
    count: int,
    seconds: float,
    *,
    seed: int = 0,
    dt: float = 0.02,
    values: Mapping[str, float] = TRUTH,
    sensor: Sequence[float] = SENSOR,
    white: float = WHITE,
    gust: float = GUST,
    lasts: float = LASTS,
    lag: float = 0.0,
) -> list[Run]:
    """Runs of a linear spring whose disturbances are held over each step, as the filter has them.

    `sensor` are standard deviations of the sensors of position and rate, `white` the density of a white disturbance,
    `gust` the standard deviation of an Ornstein-Uhlenbeck one that `lasts` so long [s]; the force follows the command
    with a `lag` [s].
    """
    n, rng, out = round(seconds / dt) + 1, np.random.default_rng([seed, 3]), []
    fine = 20 if lag else 1
    forward, push = exact_step(values, dt / fine)
    keep = np.exp(-dt / lasts)
    for number in range(count):
        u = np.repeat(rng.uniform(-2.0, 2.0, n // 10 + 1), 10)[:n]
        x, d, m = 0.3 * rng.standard_normal(2), gust * rng.standard_normal(), float(u[0])
        rows = np.empty((n, 2))
        for k in range(n):
            rows[k] = x + sensor * rng.standard_normal(2)
            struck = d + white / np.sqrt(dt) * rng.standard_normal()
            for _ in range(fine):
                # the mean of a lagged force over the fine step
                mean = u[k]
                if lag:
                    share = np.exp(-dt / fine / lag)
                    mean = u[k] + (m - u[k]) * (1.0 - share) * lag * fine / dt
                    m = u[k] + (m - u[k]) * share
                x = forward @ x + push * (values[G] * mean + struck)
            d = keep * d + gust * np.sqrt(1.0 - keep**2) * rng.standard_normal()
        t = 100.0 * number + dt * np.arange(n, dtype=np.float64)
        out.append(Run(f"run_{number}", t, rows, u[:, None]))
    return out


def small_runs(machine: Small, count: int, seconds: float, *, dt: float = 0.02, seed: int = 0) -> list[Run]:
    """Runs of a machine of the broken-log study."""
    made = [run(machine, seconds, dt, 100 * seed + k) for k in range(count)]
    return [Run(f"run_{k}", 100.0 * k + t, x, u) for k, (t, x, u) in enumerate(made)]


def rubbing(size: float, *, gust: float = 0.02) -> Small:
    """A spring with dry friction (none where the size is 0)."""
    held: dict[str, dict[str, Any]] = {"coulomb": {"size": size}} if size else {}
    return Small("mass_spring_damper", {"k": TRUTH[K], "b": TRUTH[B], "g": TRUTH[G]}, held, SENSOR, gust)


def value(found: MaximumLikelihood, label: str) -> tuple[float, float]:
    """A parameter and its standard error."""
    j = found.vector.labels.index(label)
    return float(found.theta[j]), float(found.standard_errors[j])


def assert_near(
    found: MaximumLikelihood, truth: Mapping[str, float] = TRUTH, *, share: float = np.inf
) -> None:
    """Every parameter lies within three standard errors of the truth, which are less than this share of it."""
    for label, true in truth.items():
        got, error = value(found, label)
        assert abs(got - true) < 3.0 * error, label
        assert error < share * true, label
