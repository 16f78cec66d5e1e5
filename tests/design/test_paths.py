"""Inputs and paths of experiments: fine about rest, within their ranges, and no more than the cascade can fly."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from nsde_torch.control.shapes import from_csv
from nsde_torch.design.experiment import write_plan
from nsde_torch.design.limits import ExperimentLimits
from nsde_torch.design.members import Rollouts
from nsde_torch.design.paths import SIDE, UP, Paths, flown_paths, point_times
from nsde_torch.systems import Multirotor, make_system

DT = 0.02
START = np.array([0.2, -0.1, 1.0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0], dtype=np.float64)


@pytest.fixture(scope="module")
def paths() -> Paths:
    system = make_system("hexacopter")
    room = np.full(13, 2.0)
    inputs, states = (np.zeros(6), np.ones(6)), (np.append([-2, -2, 0.5], -room[3:]), room)
    limits = ExperimentLimits(system.input_names, *inputs, system.state_names, *states)
    return Paths(limits, DT, 400, START)


def test_paths_start_where_the_experiment_begins_and_ask_for_no_more_than_they_may(paths: Paths) -> None:
    rng = np.random.default_rng(0)
    genes = paths.mutated(np.concatenate((paths.random(20, rng), paths.gentle(5, rng))), rng)
    table = paths.inputs(genes)
    assert table.shape == (25, 400, 11)
    np.testing.assert_allclose(table[:, 0, :3], np.tile(START[:3], (25, 1)), atol=1e-9)
    np.testing.assert_allclose(table[:, 0, 3:9], 0.0, atol=1e-6)
    assert np.linalg.norm(table[..., 6:8], axis=-1).max() <= SIDE * 1.0001
    assert np.abs(table[..., 8]).max() <= UP * 1.0001
    assert np.linalg.norm(table[..., 6:8], axis=-1).max() > 0.9 * SIDE  # and some go as far as they may


def test_a_written_plan_is_read_back_as_the_path_that_was_judged(paths: Paths, tmp_path: Path) -> None:
    table = paths.inputs(paths.random(3, np.random.default_rng(1)))[2]
    times = point_times(400 * DT)
    at = np.minimum((times / DT).round().astype(int), 399)
    rows = np.column_stack((times, table[at][:, [0, 1, 2, 9]]))
    write_plan(tmp_path / "plan.csv", ("p_x", "p_y", "p_z", "yaw"), rows)
    with (tmp_path / "plan.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(times)
    read = from_csv(tmp_path / "plan.csv")
    there = (DT / read.dt * np.arange(400)).round().astype(int)
    np.testing.assert_allclose(read.p[there], table[:, :3], atol=2e-3)
    np.testing.assert_allclose(read.v[there], table[:, 3:6], atol=2e-2)


def test_the_cascade_flies_a_path(paths: Paths) -> None:
    system = make_system("hexacopter")
    assert isinstance(system, Multirotor)
    table = paths.baselines(np.random.default_rng(0), np.zeros((1, 3)))["lemniscate"][0][:1, :150]
    own = Rollouts(system, dt=DT)
    drive = flown_paths(table, system=own.system, dt=DT)  # type: ignore[arg-type]
    states, _, inputs = own.run(own.vector.start[None], START[None], drive, 150)
    assert torch.isfinite(torch.as_tensor(states)).all()
    assert np.abs(states[0, 1:, :3] - table[0, :, :3]).max() < 0.5
    assert ((inputs >= 0) & (inputs <= 1)).all()
