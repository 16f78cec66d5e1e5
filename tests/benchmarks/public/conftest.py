"""Tiny files in the layouts of the public sets, made by steppers of their own; no public data."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import savemat

from nsde_benchmarks.public import named
from nsde_benchmarks.public.nanobench import COLUMNS, FLIGHTS
from nsde_torch.data.raw import RawRun

Array = NDArray[np.float64]


@pytest.fixture
def diagnosed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[RawRun]]:
    """Names an effect in the place of a diagnosis; returns the list that will hold the runs that it is given."""

    def name(added: str, **content: Any) -> list[RawRun]:
        logs: list[RawRun] = []
        told = {"declared_parameters": {}, "parameters": {}, **content}
        seen = SimpleNamespace(added=(added,), effects=(), verdict="effect_found", content=lambda: told)
        seen.finished = lambda: seen
        monkeypatch.setattr(named, "diagnose", lambda runs, **_: logs.extend(runs) or seen)
        return logs

    return name


def drive(
    force: Array, *, mass: float = 90.0, viscous: float = 180.0, dry: float = 20.0, dt: float = 1e-3
) -> Array:
    """Positions of a carriage under a force that is held, in steps of dt / 10."""
    q = v = 0.0
    out = np.empty(len(force))
    for k, f in enumerate(force):
        out[k] = q
        for _ in range(10):
            v += 0.1 * dt * (f - viscous * v - dry * np.tanh(v / 1e-3)) / mass
            q += 0.1 * dt * v
    return out


@pytest.fixture(scope="session")
def emps_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("emps")
    rng = np.random.default_rng(1)
    for name, shift in (("DATA_EMPS", 0.0), ("DATA_EMPS_PULSES", 0.4)):
        t = 1e-3 * np.arange(3000)
        force = 70.0 * np.sin(2.0 * t + shift) + 30.0 * np.sin(7.1 * t) + rng.standard_normal(len(t))
        column = {"t": t, "qm": drive(force) + 1e-7 * rng.standard_normal(len(t)), "vir": force / 35.0}
        savemat(folder / f"{name}.mat", {k: v[:, None] for k, v in column.items()} | {"gtau": 35.0})
    return folder


def flight_on_a_battery(seed: int, rows: int = 1500) -> Array:
    """Rows of a flight that bobs under commands times the voltage, in NanoBench's columns; no true flight moves so."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(rows)
    voltage = 3.9 - 0.05 * seed - 0.02 * t + 0.02 * rng.standard_normal(rows).cumsum() / np.sqrt(rows)
    asked = 9.81 + 0.8 * np.sin(2.1 * t + seed) + 0.5 * np.sin(5.3 * t)
    height = 1.0 + np.cumsum(np.cumsum(asked - 9.81 - (asked - 9.81).mean())) * 1e-4
    height += 1.0 - np.linspace(height[0], height[-1], rows)
    squares = asked / (11.0 * (1.0 + 0.5 * (voltage - 4.0)))
    out = np.zeros((rows, 19))
    out[:, 0], out[:, 3], out[:, 7], out[:, 18] = t, height, 1.0, voltage
    out[:, 6] = np.gradient(height, 0.01)
    out[:, 11:14] = 0.01 * rng.standard_normal((rows, 3))
    out[:, 14:18] = 65535.0 * np.sqrt(squares / 4)[:, None]
    return out


@pytest.fixture(scope="session")
def nanobench_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nanobench")
    for seed, name in enumerate(FLIGHTS[:3]):
        path = folder / f"{name}.csv"
        np.savetxt(path, flight_on_a_battery(seed), delimiter=",", header=",".join(COLUMNS), comments="")
    return folder
