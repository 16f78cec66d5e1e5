"""What an experiment is expected to tell is what it tells; members and widths are fitted as the data leave them."""

from dataclasses import replace

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.design import Question
from nsde_torch.design.members import Branch, Member, Rollouts, as_run, members_of, open_loop, width_columns
from nsde_torch.design.proposals import Separation
from nsde_torch.design.rehearsal import fit_all
from nsde_torch.inference.posterior import LogWithPrior
from nsde_torch.systems.options import system_options
from tests.helpers.ties import BIASED, DT, SIDED, Tie

HOLD = np.repeat([[0.1], [-0.1], [0.0]], 25, 0)


def _flown(tie: Tie, seed: int) -> Run:
    """An experiment of the first member in the noise of its sensors."""
    member, rng = tie.members[0], np.random.default_rng(seed)
    rollouts, drive = Rollouts(member.system, dt=DT), open_loop(HOLD[None])
    x, _, u = rollouts.run(member.theta[None], np.zeros((1, 2)), drive, len(HOLD))
    return as_run(x[0] + [0.005, 0.01] * rng.standard_normal(x[0].shape), u[0], DT)


def test_the_density_is_the_likelihood_averaged_over_what_is_known(tie: Tie) -> None:
    """By quadrature over one parameter, the others known."""
    member, run = tie.members[0], _flown(tie, 1)
    own, theta = member.posteriors, member.branches[0].theta
    j = member.vector.labels.index("constant_force.acceleration")
    std = 0.05
    known = np.diag(1.0 / np.square(np.where(np.arange(len(theta)) == j, std, 1e-7 * member.vector.scale)))
    begun = replace(member, branches=(Branch(theta + 0.3 * std * (np.arange(len(theta)) == j), known, 0.0),))
    (fit,) = fit_all([begun], [run])
    grid = np.linspace(-5.0, 5.0, 401)
    values = np.tile(begun.branches[0].theta, (len(grid), 1))
    values[:, j] += std * grid
    known = np.zeros((len(theta), len(theta)))
    log = [here.nats for here in own.at_centres([LogWithPrior((run,), each, known) for each in values])]
    log = np.array(log) - 0.5 * grid**2 - 0.5 * np.log(2 * np.pi)
    whole = log.max() + np.log(np.sum(np.exp(log - log.max())) * (grid[1] - grid[0]))
    assert fit.brought[0] == pytest.approx(whole, abs=0.05)


@pytest.mark.parametrize("truth", [0, 1])
def test_no_rehearsal_speaks_against_what_it_simulates_on_average(tie: Tie, truth: int) -> None:
    """Of an experiment that tells nothing, too: the last term of the density is what keeps it so."""
    told = tie.rehearsed(truth, np.zeros((20, 1)), count=8, seed=3)
    assert told.evidence.mean() > -0.5


TWICE = 2.0


def _held(tie: Tie, truth: int, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    member = tie.members[truth]
    rollouts, drive = Rollouts(member.system, dt=DT), open_loop(table[None])
    states, _, inputs = rollouts.run(member.theta[None], np.zeros((1, 2)), drive, len(table))
    return states, inputs


def _nats(tie: Tie, truth: int, pair: Separation, table: np.ndarray) -> float:
    states, inputs = _held(tie, truth, table)
    told = pair.nats(states[None], inputs[None], tie.members[truth].theta[None])
    assert told.shape == (1, 1)
    return float(told[0, 0])


@pytest.mark.parametrize("truth", [0, 1])
@pytest.mark.slow
def test_rehearsed_evidence_is_within_a_factor_of_two_of_what_is_expected_without_noise(
    tie: Tie, truth: int
) -> None:
    a, b = tie.members[truth], tie.members[1 - truth]
    expected = _nats(tie, truth, Separation(a, b), HOLD)
    told = tie.rehearsed(truth, HOLD, count=8, seed=truth)
    assert expected > 3.0
    assert expected / TWICE < np.median(told.evidence) < expected * TWICE


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
