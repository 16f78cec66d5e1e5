"""What drifts, differs between runs or remembers is structure, though no function of the present state shows it."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data.raw import RawRun
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system

Array = NDArray[np.float64]
Factor = Callable[[int, float], float]
SPRING = make_system("mass_spring_damper")
DT, FINE, ROWS, RUNS = 0.01, 5, 800, 6


def one(number: int, factor_of_stiffness: Factor, factor_of_mass: Factor, memory: float) -> RawRun:
    """A spring under a random force that is held over rows, logged behind a filter of time constant `memory` [s]."""
    rng = np.random.default_rng(number)
    t = DT * np.arange(ROWS)
    waves = rng.normal(size=8) @ np.sin(np.outer(rng.uniform(1, 16, 8), t) + rng.uniform(0, 6.28, 8)[:, None])
    force = waves + 0.3 * rng.normal(size=ROWS)
    x = np.zeros((ROWS, 2))
    q, v = 0.3 * rng.normal(size=2)
    for k in range(ROWS):
        x[k] = q, v
        for j in range(FINE):
            at, h = t[k] + j * DT / FINE, DT / FINE
            stiffness, mass = 6.0 * factor_of_stiffness(number, at), 1.2 * factor_of_mass(number, at)

            def pull(q: float, v: float, f: float = force[k], c: float = stiffness, m: float = mass) -> float:
                return (f - c * q - 0.5 * v) / m

            middle = q + 0.5 * h * v, v + 0.5 * h * pull(q, v)
            q, v = q + h * middle[1], v + h * pull(*middle)
    logged = force.copy()
    if memory:
        for k in range(1, ROWS):
            logged[k] = logged[k - 1] + (force[k] - logged[k - 1]) * DT / (memory + DT)
    return RawRun(
        f"run_{number}", t, x + 5e-4 * np.array([0.3, 1.0]) * rng.normal(size=x.shape), logged[:, None]
    )


def same(number: int, at: float) -> float:
    return 1.0


@pytest.mark.parametrize(
    ("stiffness", "mass", "memory", "variable", "words"),
    [
        (lambda n, at: 1.0 - 0.03 * at, same, 0.0, "q over time", "something drifts"),
        (same, lambda n, at: 1.2 if n % 2 else 1.0, 0.0, "force by run", "something differs between runs"),
        (same, same, 0.04, "force before", "something has a memory"),
    ],
    ids=["stiffness falls", "mass differs", "filtered force"],
)
@pytest.mark.slow
def test_it_is_said_and_told_apart(
    stiffness: Factor, mass: Factor, memory: float, variable: str, words: str
) -> None:
    made = [one(k, stiffness, mass, memory) for k in range(RUNS)]
    data = assemble(made, SPRING, kind="test")
    spec = SysidSpec(SPRING.name, dt=data.dt, horizon=SPRING.defaults.horizon)
    content = diagnose(SPRING, spec, data, data.runs, Options(max_effects=0)).content()
    assert content["verdict"] == "unexplained"
    assert content["structure"]["after"][0]["variable"] == variable
    assert words in content["unexplained"][0]["sentence"]


@pytest.mark.slow
def test_a_sound_spring_has_none_of_it() -> None:
    data = assemble([one(k, same, same, 0.0) for k in range(RUNS)], SPRING, kind="test")
    spec = SysidSpec(SPRING.name, dt=data.dt, horizon=SPRING.defaults.horizon)
    assert diagnose(SPRING, spec, data, data.runs, Options(max_effects=0)).content()["verdict"] == "no_effect"
