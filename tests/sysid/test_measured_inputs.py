"""Inputs as a sensor measured them: machines that NumPy integrates."""

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.api.reading import read
from nsde_torch.data import DataSet
from nsde_torch.data.raw import RawRun
from nsde_torch.systems import make_system
from tests.helpers.machines import Array, simulated
from tests.helpers.own_machines import Rotor

DT, STIFFNESS, DAMPING = 0.01, 2.0, 0.4
SPRING = make_system("mass_spring_damper")


def spring(x: Array, u: Array) -> list[float]:
    return [x[1], u[0] - STIFFNESS * x[0] - DAMPING * x[1]]


def thrown(seed: int, *, levels: tuple[float, ...], noise: float, acts: bool = False) -> list[RawRun]:
    """A spring under a force that changes its level at random, 20 s, logged every 10 ms with noise."""
    rng = np.random.default_rng(seed)
    out = []
    for number in range(2):
        force = np.array(levels)[np.repeat(rng.integers(len(levels), size=50), 40), None]
        logged = force + noise * rng.standard_normal(force.shape)
        run = simulated(number, spring, [0.3, 0.0], logged if acts else force, DT, noise=0.0003, rng=rng)
        out.append(replace(run, u=logged))
    return out


@pytest.mark.parametrize(
    "levels",
    [(-0.7, 0.0, 0.7), *(pytest.param(two, marks=pytest.mark.slow) for two in ((-0.6, 0.6), (0.0, 0.9)))],
)
def test_noise_of_a_measured_force_is_taken_out(levels: tuple[float, ...]) -> None:
    data = read(thrown(1, levels=levels, noise=0.03), system=SPRING)
    (found,) = [f for f in data.summary.findings if f.kind == "input_noise"]
    assert np.allclose(found.values["levels"], levels, atol=0.003)
    assert "force holds noise of 0.03 N about the levels" in found.message
    u = np.concatenate([run.u[:, 0] for run in data.runs])
    assert np.mean(np.abs(u[:, None] - np.array(levels)).min(1) < 0.003) > 0.99


def test_a_wobble_that_moves_the_machine_stays() -> None:
    runs = thrown(2, levels=(-0.6, 0.6), noise=0.03, acts=True)
    data = read(runs, system=SPRING)
    assert "input_noise" not in {f.kind for f in data.summary.findings}
    assert np.allclose(data.runs[0].u, runs[0].u)


def test_noise_stays_where_the_log_is_kept_as_it_is() -> None:
    data = read(thrown(1, levels=(-0.6, 0.6), noise=0.03), system=SPRING, state_smoothing="keep")
    assert "input_noise" not in {f.kind for f in data.summary.findings}


def driven(seed: int, *, lag_s: float = 0.0, noise: float = 0.0, gap: float = 0.0) -> list[RawRun]:
    """A spring under a force of many waves, or steps behind an actuator, 20 s, logged every 10 ms.

    The force is held over 10 ms, but behind an actuator's lag. It is logged as it was at each row, with noise that does
    not move the spring. `gap` is that of play behind the logged force [N].
    """
    rng, out, rows = np.random.default_rng(seed), [], 2000

    def rates(x: Array, u: Array) -> list[float]:
        force, rise = (x[2], (u[0] - x[2]) / lag_s) if lag_s else (u[0], 0.0)
        return [*spring(x, np.array([force])), rise]

    for number in range(2):
        t, waves = DT * np.arange(rows), 2.0 * np.pi * rng.uniform(0.1, 2.0, 6)
        wanted = 0.4 * np.sin(np.outer(t, waves) + rng.uniform(0.0, 6.0, 6)).sum(1)
        if lag_s:
            wanted = np.where(np.repeat(rng.integers(2, size=rows // 20), 20) > 0, 0.6, -0.6)
        moved = wanted.copy()
        for k in range(1, rows):
            moved[k] = min(max(moved[k - 1], wanted[k] - 0.5 * gap), wanted[k] + 0.5 * gap)
        start, errors = [0.3, 0.0, wanted[0]], (0.0003, 0.001, 0.0)
        run = simulated(number, rates, start, moved[:, None], DT, noise=errors, rng=rng)
        logged = (run.x[:, 2] if lag_s else wanted) + noise * rng.standard_normal(rows)
        out.append(replace(run, x=run.x[:, :2], u=logged[:, None]))
    return out


def inputs_of(runs: list[RawRun]) -> tuple[DataSet, list[str]]:
    data = read(runs, system=SPRING)
    return data, [f.kind for f in data.summary.findings if f.kind.startswith("input_")]


@pytest.mark.slow
def test_a_force_that_moves_between_rows_acts_as_the_mean_of_both() -> None:
    runs = driven(3, lag_s=0.03)
    data, kinds = inputs_of(runs)
    assert kinds == ["input_between_rows"]
    assert np.allclose(data.runs[0].u[:-1, 0], 0.5 * (runs[0].u[:-1, 0] + runs[0].u[1:, 0]))


@pytest.mark.slow
def test_white_noise_of_a_measured_force_is_taken_out_as_far_as_it_is_known() -> None:
    runs, true = driven(4, noise=0.1), driven(4)
    data, kinds = inputs_of(runs)
    assert kinds == ["input_noise"]
    errors = [
        np.std(np.concatenate([a.u[:, 0] - b.u[:, 0] for a, b in zip(some, true, strict=True)]))
        for some in (runs, data.runs)
    ]
    assert errors[1] < 0.6 * errors[0]
    (found,) = [f for f in data.summary.findings if f.kind == "input_noise"]
    assert found.values["noise"] == pytest.approx([0.1], rel=0.5)


@pytest.mark.parametrize("gap", [0.0, 0.3])
def test_a_force_that_acts_as_it_is_logged_or_through_play_stays(gap: float) -> None:
    runs = driven(5, gap=gap)
    data, kinds = inputs_of(runs)
    assert kinds == []
    assert np.allclose(data.runs[0].u, runs[0].u)


def test_a_measured_input_moves_between_rows_beside_a_command_that_is_held() -> None:
    """The command is another one in each row, as a controller's is; the wind is sampled."""
    rng, dt, rows = np.random.default_rng(6), 0.05, 400
    pulses, phases = 2.0 * np.pi * rng.uniform(0.2, 2.0, 8), rng.uniform(0.0, 6.0, 8)

    def wind(t: float) -> float:
        return float(np.sin(pulses * t + phases).sum())

    runs = []
    for number in range(2):
        torque = rng.standard_normal((rows, 1))

        def rates(x: Array, u: Array) -> list[float]:
            return [2.0 * u[0] + 0.7 * wind(x[1]) - 0.5 * x[0], 1.0]

        run = simulated(number, rates, [0.0, 50.0 * number], torque, dt, noise=(0.003, 0.0), rng=rng)
        blows = [wind(clock) for clock in run.x[:, 1]]
        runs.append(replace(run, x=run.x[:, :1], u=np.column_stack((torque, blows))))
    data = read(runs, system=Rotor())
    assert [f.values["inputs"] for f in data.summary.findings if f.kind == "input_between_rows"] == [["wind"]]
    assert np.allclose(data.runs[0].u[:, 0], runs[0].u[:, 0])
    assert np.allclose(data.runs[0].u[:-1, 1], 0.5 * (runs[0].u[:-1, 1] + runs[0].u[1:, 1]))
