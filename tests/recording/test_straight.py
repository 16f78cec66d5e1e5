"""Columns that were interpolated are told; sensors with noise, coarse ones, and those at rest are not."""

from __future__ import annotations

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import RawRun
from nsde_torch.data.raw import Finding
from nsde_torch.recording.noise import check_interpolated
from nsde_torch.systems import make_system

SYSTEM = make_system("mass_spring_damper")


def log() -> list[RawRun]:
    return list(nsde_torch.simulate("mass_spring_damper", durations=[10.0, 10.0], seed=5).runs)


def found(runs: list[RawRun]) -> list[Finding]:
    out: list[Finding] = []
    check_interpolated(SYSTEM, runs, 0.01, out.append)
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


def swinging(noise: float, seed: int = 1) -> RawRun:
    """A pole that goes round and about its lower rest at pi, 50 Hz, its angle wrapped."""
    rng = np.random.default_rng(seed)
    t = 0.02 * np.arange(1500)
    angle = np.pi + 0.9 * np.sin(2.0 * t) + noise * rng.standard_normal(len(t))
    rate = 1.8 * np.cos(2.0 * t) + noise * rng.standard_normal(len(t))
    still = noise * rng.standard_normal((2, len(t)))
    x = np.stack([*still, np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi, rate], 1)
    return RawRun("a", t, x, np.zeros((len(t), 1)))


@pytest.mark.parametrize("noise", [0.001, 0.03])
def test_wraps_of_an_angle_are_no_knots(noise: float) -> None:
    run, out = swinging(noise), list[Finding]()
    assert (np.abs(np.diff(run.x[:, 2])) > np.pi).sum() > 10
    check_interpolated(make_system("cartpole"), [run], 0.02, out.append)
    assert not out
    run.x[5::50, 2] = np.nan
    check_interpolated(make_system("cartpole"), [run], 0.02, out.append)
    assert not out


def test_a_wrapped_angle_that_was_interpolated_is_told() -> None:
    run, out = swinging(0.01), list[Finding]()
    k, angle = np.arange(len(run.t)), np.unwrap(run.x[:, 2])
    angle = np.interp(k, k[::4], angle[::4])
    run.x[:, 2] = np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
    check_interpolated(make_system("cartpole"), [run], 0.02, out.append)
    assert out[0].values["states"] == ["theta"]


def test_the_kinks_that_held_forces_make_in_a_motion_without_noise_are_no_knots() -> None:
    rng = np.random.default_rng(3)
    dt, n = 0.05, 600
    force = np.repeat(rng.choice((-1.2, 1.2), n // 4 + 1), 4)[:n]
    x = np.zeros((n, 2))
    for row in range(1, n):
        q, v = x[row - 1]
        for _ in range(50):
            v += 0.001 * (force[row - 1] - 0.7 * q - 0.4 * v)
            q += 0.001 * v
        x[row] = q, v
    bends = np.abs(np.diff(x[:, 1], 2))
    assert (bends < 0.05 * np.quantile(bends, 0.95)).mean() > 0.4  # as flat as they look
    assert not found([RawRun("a", dt * np.arange(n), x, force[:, None])])


def test_values_of_some_significant_digits_are_straight_only_to_the_last_of_them() -> None:
    rng = np.random.default_rng(4)
    t = 0.002 * np.arange(8000)
    q = 1.5 * np.sin(1.3 * t) + 0.2 * np.sin(7.0 * t)
    x = np.stack([q, np.gradient(q, t) + 1e-3 * rng.standard_normal(len(t))], 1)
    written = np.array([[float(f"{v:.4g}") for v in row] for row in x])
    assert not found([RawRun("a", t, written, np.zeros((len(t), 1)))])
