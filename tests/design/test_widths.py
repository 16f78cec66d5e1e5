"""Widths of frictions that the runs leave open are followed, and those that they show are not."""

import numpy as np
import pytest

import nsde_torch
from nsde_torch.design import Question
from nsde_torch.design.members import Member, members_of, width_columns
from nsde_torch.design.proposals import nearest
from nsde_torch.systems.options import system_options
from tests.helpers.ties import BIASED, DT, SIDED

NARROW = 0.005


@pytest.fixture(scope="module")
def fast() -> Member:
    """Fitted to runs that mostly move much faster than friction takes to develop."""
    effects = [{"coulomb_friction": {"size": 0.2, "width": NARROW}}, {"constant_force": {}}]
    how = {"durations": [5.0] * 2, "seed": 3, "dt": DT, "options": {"force_size": 4.0}}
    made = nsde_torch.simulate("mass_spring_damper", effects=effects, **how)
    system = system_options("mass_spring_damper").make()
    runs = nsde_torch.read(made, system=system).runs
    return members_of(system, runs, Question((BIASED, SIDED)), {}, clock=1.0)[0]


@pytest.mark.slow
def test_a_width_that_no_run_shows_is_followed_down_to_the_true_one(fast: Member) -> None:
    (column,) = width_columns(fast.vector)
    widths = np.array([b.theta[column] for b in fast.branches])
    assert len(widths) > 1
    assert widths.min() < 2.0 * NARROW < widths.max()
    nats = [b.nats for b in fast.branches]
    assert nats == sorted(nats, reverse=True)
    assert nats[0] == fast.nats
    assert nats[-1] > fast.nats - 4.0
    np.testing.assert_array_equal(fast.theta, fast.branches[0].theta)


@pytest.mark.slow
def test_draws_take_their_share_of_every_width_and_say_where_they_are_from(fast: Member) -> None:
    (column,) = width_columns(fast.vector)
    draws = fast.draws(40, np.random.default_rng(0))
    np.testing.assert_array_equal(draws[0], fast.theta)
    drawn = np.log(draws[1:, column])
    widths = np.log([b.theta[column] for b in fast.branches])
    assert drawn.min() < widths.mean() < drawn.max()
    assert (draws[:, column] >= fast.vector.low[column]).all()
    for branch in fast.branches:
        assert nearest(fast, branch.theta) is branch
