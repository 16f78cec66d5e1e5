"""Rows in which a sensor repeats itself though the machine moves are cut out; rest and slow sensors are kept."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Finding, RawRun
from nsde_torch.recording import assemble
from tests.helpers.data_systems import HEXACOPTER, MSD
from tests.helpers.flights import flight

Array = NDArray[np.float64]
T = np.arange(2000) * 0.01


def swing(noise: float = 0.003) -> Array:
    """States of a spring that swings."""
    x = np.stack(
        (0.4 * np.sin(2 * T) + 0.1 * np.sin(3.3 * T), 0.8 * np.cos(2 * T) + 0.33 * np.cos(3.3 * T)), 1
    )
    return x + noise * np.array([1.0, 3.0]) * np.random.default_rng(0).normal(size=x.shape)


def read(x: Array) -> tuple[DataSet, list[Finding]]:
    """A data set of one run, and what was found about rows that repeat."""
    data = assemble([RawRun("run", T.copy(), x, np.sin(7 * T)[:, None])], MSD, kind="test")
    return data, [f for f in data.summary.findings if f.kind in ("frozen_rows", "sensor_end", "glitch")]


@pytest.mark.parametrize("at", [500, 620, 740])
def test_rows_of_a_log_that_froze_are_cut_out(at: int) -> None:
    x = swing()
    x[at : at + 30] = x[at]
    data, (finding,) = read(x)
    assert (finding.kind, finding.action, finding.count) == ("frozen_rows", "dropped", 29)
    assert data.runs[0].segments == ((0, at + 1), (at + 1, len(x) - 29))


@pytest.mark.parametrize(("column", "name"), [(0, "q"), (1, "q_dot")])
def test_one_sensor_that_repeats_itself_while_the_other_moves_is_cut_out_by_name(
    column: int, name: str
) -> None:
    x = swing()
    x[500:600, column] = x[500, column]
    _, (finding,) = read(x)
    assert (finding.kind, finding.values["column"]) == ("frozen_rows", repr(name))
    assert finding.count == 99


@pytest.mark.parametrize(("column", "end"), [(0, 0.3), (1, 0.7)])
def test_a_sensor_at_its_end_is_cut_out_with_column_and_value(column: int, end: float) -> None:
    x = swing()
    beyond = np.abs(x[:, column]) > end
    x[:, column] = np.clip(x[:, column], -end, end)
    data, findings = read(x)
    assert {(f.kind, f.values["value"]) for f in findings} == {("sensor_end", -end), ("sensor_end", end)}
    assert sum(f.count for f in findings) == pytest.approx(beyond.sum(), rel=0.1)
    kept = np.concatenate([data.runs[0].x[a:b, column] for a, b in data.runs[0].segments])
    assert (np.abs(kept) == end).mean() < 0.005


def test_a_gyroscope_at_its_end_is_found_against_the_attitude() -> None:
    t, x, u = flight(20.0)
    end = float(np.quantile(np.abs(x[:, 11]), 0.8))
    x[:, 11] = np.clip(x[:, 11], -end, end)
    data = assemble([RawRun("run", t, x, u)], HEXACOPTER, kind="test")
    found = [f for f in data.summary.findings if f.kind == "sensor_end"]
    assert {f.values["column"] for f in found} == {"'w_y'"}


def test_rest_coarse_sensors_and_slow_ones_are_kept() -> None:
    """Machines at rest before exact and coarse sensors, a rate with a bias there, a stop, and a sample that is held."""
    rng = np.random.default_rng(2)
    still = np.clip(np.mod(T, 5.0) - 1.0, 0.0, None)
    moves = np.stack(
        (1.0 - np.cos(2 * np.pi * still / 4.0), 0.5 * np.pi * np.sin(2 * np.pi * still / 4.0)), 1
    )
    noisy = moves + np.array([0.003, 0.01]) * rng.normal(size=moves.shape)
    coarse = np.round(noisy / [0.02, 0.05]) * [0.02, 0.05]
    biased = moves + np.array([0.0, 0.03])
    biased[:, 1] += 0.02 * rng.normal(size=len(T))
    stop = swing(0.0)
    at_end = stop[:, 0] > 0.3
    stop[at_end] = [0.3, 0.0]
    fine = swing(0.0)
    slow = fine.copy()
    slow[:, 0] = np.repeat(fine[::20, 0], 20)
    tooth = np.round(fine / 0.05) * 0.05
    cases = {
        "rest": moves,
        "noisy": noisy,
        "coarse": coarse,
        "biased": biased,
        "stop": stop,
        "slow": slow,
        "tooth": tooth,
    }
    for name, x in cases.items():
        assert read(x)[1] == [], name


def test_a_log_in_which_nothing_moves_has_no_clock_of_nothing() -> None:
    x = np.stack((np.zeros(len(T)), 1e-7 * np.sin(np.arange(len(T)))), 1)
    x[700, 0] = 1e-9
    assert read(x)[0].clock_scale == 1.0
