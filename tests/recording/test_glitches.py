"""A single sample that is off by far is put back; a motion that is sudden is not touched, and no time is lost."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Finding, RawRun
from nsde_torch.recording import assemble
from tests.helpers.data_systems import CARTPOLE, HEXACOPTER, MSD
from tests.helpers.flights import flight

Array = NDArray[np.float64]
T = np.arange(1500) * 0.01


def swing(noise: float, seed: int = 0) -> Array:
    """States of a spring that swings."""
    x = np.stack((0.4 * np.sin(3 * T), 1.2 * np.cos(3 * T)), 1)
    return x + noise * np.array([1.0, 3.0]) * np.random.default_rng(seed).normal(size=x.shape)


def read(x: Array) -> tuple[DataSet, list[Finding]]:
    """A data set of one run, and its findings but those about inputs."""
    data = assemble(
        [RawRun("run", T[: len(x)].copy(), x, np.sin(7 * T[: len(x)])[:, None])], MSD, kind="test"
    )
    return data, [f for f in data.summary.findings if "input" not in f.kind]


@pytest.mark.parametrize(("column", "name", "size"), [(0, "q", 0.2), (1, "q_dot", 0.6)])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_single_samples_that_are_off_are_put_on_the_curve_and_told_by_column_and_row(
    column: int, name: str, size: float, noise: float
) -> None:
    x = swing(noise)
    spoilt = x.copy()
    spoilt[[300, 340, 900], column] += [size, size, -size]
    data, findings = read(spoilt.copy())
    (finding,) = findings
    assert (finding.kind, finding.action, finding.count) == ("glitch", "interpolated", 3)
    assert finding.values["column"] == name
    assert finding.values["rows"] == [300, 340, 900]
    assert data.runs[0].segments == ((0, len(x)),)
    assert np.abs(data.runs[0].x - x).max() < 15 * noise + 1e-3
    kept = np.delete(np.arange(len(x)), [300, 340, 900])
    assert (data.runs[0].x[kept] == x[kept]).all()


def test_what_moves_suddenly_is_kept() -> None:
    """A blow, a bounce, a force that changes its sign, ringing, and a coarse sensor."""
    blow = swing(0.0)
    blow[700:, 1] -= 1.5
    blow[700:, 0] -= 1.5 * (T[700:] - T[700])
    bounce = np.abs(np.mod(T, 2.0) - 1.0) - 0.5
    ball = np.stack((bounce, np.where(np.mod(T, 2.0) < 1.0, -1.0, 1.0)), 1)
    sawtooth = np.stack((np.cumsum(bounce) * 0.01, bounce), 1)
    ringing = swing(0.0)
    ringing[700:, 1] += (
        0.5 * np.exp(-(T[700:] - T[700]) / 0.03) * np.cos(np.pi * 0.6 * np.arange(len(T) - 700))
    )
    coarse = np.round(swing(0.0) / 0.02) * 0.02
    for name, x in {
        "blow": blow,
        "ball": ball,
        "saw": sawtooth,
        "ringing": ringing,
        "coarse": coarse,
    }.items():
        assert [f.kind for f in read(x)[1] if f.kind in ("glitch", "frozen_rows", "sensor_end")] == [], name


def test_noise_with_heavy_tails_is_no_lost_time() -> None:
    rng = np.random.default_rng(1)
    x = swing(0.0) + np.array([0.002, 0.02]) * rng.standard_t(2.0, (len(T), 2))
    data, findings = read(x)
    assert {f.kind for f in findings} == {"glitch"}
    assert len(data.runs[0].segments) == 1


def test_rows_that_are_lost_are_still_a_hidden_gap() -> None:
    x = np.delete(swing(0.002), slice(700, 740), axis=0)
    _, findings = read(x)
    assert [f.kind for f in findings] == ["hidden_gap"]


def test_a_glitch_of_a_quaternion_and_of_an_angle_leave_unit_norm_and_wraps_in_order() -> None:
    t, x, u = flight(12.0)
    spoilt = x.copy()
    spoilt[400, 6:10] = [0.5, 0.5, -0.5, 0.5]
    data = assemble([RawRun("run", t, spoilt, u)], HEXACOPTER, kind="test")
    assert np.abs(np.abs((data.runs[0].x[:, 6:10] * x[:, 6:10]).sum(1)) - 1).max() < 1e-5
    theta = 8.0 * np.sin(0.7 * T)
    cart = np.stack((np.sin(T), np.cos(T), theta, 5.6 * np.cos(0.7 * T)), 1)
    wrapped = cart.copy()
    wrapped[600, 2] += 1.0
    wrapped[:, 2] = np.mod(wrapped[:, 2] + np.pi, 2 * np.pi) - np.pi
    data = assemble([RawRun("run", T.copy(), wrapped, np.sin(7 * T)[:, None])], CARTPOLE, kind="test")
    assert np.abs(data.runs[0].x[:, 2] - theta).max() < 1e-3
    assert {f.kind for f in data.summary.findings} == {"angle_wrap", "glitch"}
