"""A longer step hides nothing of what the recording did: it is looked for at the rate of the log."""

import numpy as np
import pytest
from scipy.signal import butter, filtfilt

import nsde_torch
from nsde_torch.data import DataSet, RawRun
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from tests.helpers.machines import simulated

SPRING = "mass_spring_damper"


def logged(seed: int, *, hz: int, late: float = 0.0, sensor: tuple[float, float] = (2e-4, 2e-3)) -> RawRun:
    """A spring under random steps of its force, with a rate that is logged late."""
    rng, n = np.random.default_rng(seed), 16 * hz
    force = np.repeat(rng.normal(size=n // 50 + 8), 50)[:, None]
    run = simulated(
        seed, lambda x, u: [x[1], u[0] - 16.0 * x[0] - 0.6 * x[1]], [0.0, 0.0], force, 1 / hz, rng=rng, fine=1
    )
    run.x[:, 1] = np.interp(run.t - late, run.t, run.x[:, 1])
    run.x += rng.normal(size=run.x.shape) * sensor
    rows = slice(200, 200 + n)
    return RawRun(run.name, run.t[rows], run.x[rows], run.u[rows])


def kinds(data: DataSet) -> dict[str, str]:
    return {finding.kind: finding.action for finding in data.summary.findings}


def test_a_rate_that_is_late_by_less_than_the_step_is_found_and_taken_out() -> None:
    def read(late: float, **options: str) -> DataSet:
        run = logged(0, hz=500, late=late, sensor=(1e-4, 3e-4))
        return nsde_torch.read([run], system=SPRING, dt=0.02, **options)

    on_time, late = read(0.0), read(0.004)
    assert (late.dt, late.runs[0].dt) == (0.02, 0.02)
    assert kinds(on_time) == {}
    assert kinds(late) == {"late_sensor": "taken out"}
    rows = slice(10, 700)
    left = late.runs[0].x[rows, 1] - on_time.runs[0].x[rows, 1]
    assert left.std() < 0.1 * (0.004 * np.gradient(on_time.runs[0].x[:, 1], 0.02)).std()
    assert kinds(read(0.004, stream_offsets="keep")) == {"late_sensor": "reported"}


@pytest.mark.parametrize("dt", [0.02, pytest.param(0.05, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_smoother_above_half_the_new_rate_is_found(dt: float) -> None:
    def smoothed() -> list[RawRun]:
        runs = [logged(seed, hz=200) for seed in range(2)]
        for run in runs:
            run.x = filtfilt(*butter(2, 30.0, fs=200), run.x, axis=0)
        return runs

    data = nsde_torch.read(smoothed(), system=SPRING, dt=dt)
    assert kinds(data) == {"state_smoothing": "restored"}
    plain = nsde_torch.read(smoothed(), system=SPRING, dt=dt, state_smoothing="keep")
    first = round((data.runs[0].t[0] - plain.runs[0].t[0]) / dt)
    a, b = data.runs[0].segments[0]
    off = data.runs[0].x[a:b] - plain.runs[0].x[first + a : first + b]
    assert (off.std(axis=0) < 0.02 * plain.runs[0].x.std(axis=0)).all()


def test_rows_on_a_longer_step_are_those_of_the_log_with_means_of_inputs() -> None:
    system = make_system(SPRING)
    run, raw = logged(1, hz=100), logged(1, hz=100)
    keep = np.ones(len(run.t), dtype=bool)
    keep[500:520] = False
    run.rows(keep)
    run.extra["voltage"] = np.arange(len(run.t), dtype=np.float64)
    data = assemble([run], system, kind="arrays", dt=0.04)
    assert [b - a for a, b in data.runs[0].segments] == [125, 270]
    np.testing.assert_allclose(data.runs[0].x[:125], raw.x[:500:4], atol=1e-12)
    np.testing.assert_allclose(data.runs[0].u[:124, 0], raw.u[:496, 0].reshape(-1, 4).mean(axis=1))
    np.testing.assert_allclose(data.runs[0].extra["voltage"][:125], np.arange(0, 500, 4))
    assert data.summary.dt == 0.04
    assert sum(one["rows"] for one in data.summary.runs) == 395
