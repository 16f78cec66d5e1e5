"""Inputs and paths of experiments: fine about rest, within their ranges, and no more than the cascade can fly."""

import numpy as np
import pytest
import torch

from nsde_torch.design.limits import ExperimentLimits
from nsde_torch.design.members import Rollouts
from nsde_torch.design.paths import SIDE, UP, Paths, flown_paths
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
