"""Parameters of a multirotor are drawn as far as the cascade can fly them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import nsde_torch
from nsde_torch.design import DesignOptions, question_of
from nsde_torch.design.designing import first_state
from nsde_torch.design.members import Rollouts, members_of
from nsde_torch.design.paths import STEP, flown_paths, flyable
from nsde_torch.systems import Multirotor
from nsde_torch.systems.options import system_options


@pytest.mark.slow
def test_no_parameters_are_drawn_with_which_the_machine_is_lost() -> None:
    system = system_options("quadrotor").make()
    assert isinstance(system, Multirotor)
    drag = [{"linear_drag": {"drag": [0.3, 0.3, 0.1]}}]
    made = nsde_torch.simulate("quadrotor", durations=[4.0], seed=1, declared_only=True, effects=drag)
    data = nsde_torch.read(made, system="quadrotor")
    asked = DesignOptions(parameters=("linear_drag.drag",))
    question = question_of({}, system, asked)
    (member,) = members_of(system, data.runs, question, {}, clock=1.0)
    (only,) = member.branches
    # runs that leave the gains open
    open_, dt = replace(member, branches=(replace(only, known=1e-4 * only.known),)), member.log.dt
    start = first_state(system, data.runs, {})
    drive = partial(flown_paths, system=system, dt=dt)

    def left(thetas: np.ndarray) -> np.ndarray:
        table = np.zeros((len(thetas), 300, 11))
        table[..., :3] = start[:3] + STEP
        begun = np.tile(start, (len(thetas), 1))
        states, _, _ = Rollouts(member.system, dt=dt).run(thetas, begun, drive(table), 300)
        return np.asarray(np.nan_to_num(np.abs(states[:, -1, :3] - start[:3] - STEP).max(1), nan=np.inf))

    wild = left(open_.draws(12, np.random.default_rng(0)))
    assert wild.max() > 0.5
    kept = flyable(open_, 3, np.random.default_rng(0), start=start, drive=drive)
    assert kept.shape == (3, len(member.theta))
    np.testing.assert_array_equal(kept[0], member.theta)
    assert left(kept).max() < 0.5
