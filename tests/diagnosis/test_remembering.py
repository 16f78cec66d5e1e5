"""What remembers is named as such, and never as a delay; what is late or rubs is not named as what remembers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data.raw import RawRun

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "blind"))
from remembering import DT, RIGHT, run


@pytest.mark.parametrize(
    ("kind", "own", "true"),
    [("bouc_wen", "reach", 0.08), ("play", "gap", 0.25), ("delay", "delay", 0.04), ("coulomb", "size", 0.4)],
)
@pytest.mark.slow
def test_it_is_named_for_what_it_is(kind: str, own: str, true: float) -> None:
    late = 0.25 if kind == "play" else 0.04
    values = {"k": 3.0, "b": 0.4, "g": 1.1, "size": 0.4, "reach": 0.08, "time": late}
    runs = []
    for n in range(3):
        x, u = run(kind, values, np.random.default_rng([9, n]))
        runs.append(RawRun(f"run_{n}", DT * np.arange(len(x)) + 100.0 * n, x, u))
    found = nsde_torch.diagnose(runs, system="mass_spring_damper").content()
    assert found["added"] == [RIGHT[kind]]
    assert found["parameters"][f"{RIGHT[kind]}.{own}"]["value"] == pytest.approx(true, rel=0.1)
