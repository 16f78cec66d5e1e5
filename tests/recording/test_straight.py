"""Columns that were interpolated are told; sensors with noise, coarse ones, and those at rest are not."""

from __future__ import annotations

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.data.findings import Finding
from nsde_torch.recording import straight
from nsde_torch.systems import make_system

SYSTEM = make_system("mass_spring_damper")


def log() -> list[RawRun]:
    return list(nsde_torch.simulate("mass_spring_damper", durations=[10.0, 10.0], seed=5).runs)


def found(runs: list[RawRun]) -> list[Finding]:
    out: list[Finding] = []
    straight.check(SYSTEM, runs, 0.01, out.append)
    return out


@pytest.mark.parametrize("every", [3, 5, 10])
def test_lines_between_every_few_rows_are_told_with_their_rate(every: int) -> None:
    runs = log()
    for run in runs:
        k = np.arange(len(run.t))
        run.x = np.stack([np.interp(k, k[::every], c[::every]) for c in run.x.T], 1)
    (finding,) = found(runs)
    assert finding.values["states"] == ["q", "q_dot"]
    assert finding.values["rows"] == pytest.approx(every, rel=0.15)
    assert "interpolated" in finding.message


def test_raw_coarse_and_resting_sensors_are_not_told() -> None:
    runs = log()
    assert not found(runs)
    for run in runs:
        run.x = np.round(run.x, 2)
    assert not found(runs)
    for run in runs:
        run.x[:] = 0.0
    assert not found(runs)
