"""Diagnoses of simulated data sets that take a few seconds each."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from nsde_torch.data import DataSet
from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions, Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording import Recording, assemble
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system

Diagnosed = tuple[Diagnosis, dict[str, Any]]
"""A diagnosis, and the content of `diagnosis.json`."""

SHORT: Mapping[str, tuple[tuple[float, ...], float]] = {
    "mass_spring_damper": ((8.0,) * 3, 0.02),
    "cartpole": ((4.0,) * 5, 0.02),
}
"""Lengths of runs and the step [s], where a test asks for nothing else."""


def recorded(
    system: str,
    *effects: Any,
    seed: int = 1,
    durations: Sequence[float] | None = None,
    recording: Recording | None = None,
    plant: Mapping[str, Any] | None = None,
    sensor_noise: float = 1.0,
    dt: float | None = None,
) -> DataSet:
    """Runs of a plant with these effects, as `nsde simulate` and `data=csv` would bring them."""
    if durations is None:
        durations, short = SHORT[system]
        dt = short if dt is None else dt
    how: dict[str, Any] = {"seed": seed, "dt": dt, "recording": recording, "options": plant}
    made = simulate(system, effects=list(effects), durations=durations, sensor_noise=sensor_noise, **how)
    return assemble(list(made.runs), make_system(system), kind="simulated")


def diagnosed(
    system: str,
    *effects: Any,
    options: Options | None = None,
    decisions: Decisions = DECISIONS,
    budgets: Budgets = BUDGETS,
    **making: Any,
) -> Diagnosed:
    """A diagnosis of such runs."""
    data = recorded(system, *effects, **making)
    declared = make_system(system)
    spec = SysidSpec(system, dt=data.dt, horizon=declared.defaults.horizon)
    how: dict[str, Any] = {"decisions": decisions, "budgets": budgets}
    found = diagnose(declared, spec, data, data.runs, options or Options(), **how)
    return found, found.content()


@cache
def sound_spring() -> Diagnosed:
    """Of a spring of which nothing is missing."""
    return diagnosed("mass_spring_damper")


@cache
def pushed_spring() -> Diagnosed:
    """Of a spring that a steady force pushes."""
    return diagnosed("mass_spring_damper", {"constant_force": {"acceleration": 0.2}})


def assert_interval(
    parameters: Mapping[str, Any], name: str, truth: float, *, slack: float = 0.0, width: float = math.inf
) -> None:
    """The interval of 90 % holds the truth, but for some slack, and is narrower than this."""
    low, high = parameters[name]["interval_90"]
    assert low - slack < truth < high + slack
    assert high - low < width
