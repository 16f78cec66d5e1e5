"""The evidence of an experiment is the density that it had before it was flown."""

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.design.members import Branch, Rollouts, as_run, open_loop
from nsde_torch.design.rehearsal import against, fit_all
from nsde_torch.inference.posterior import LogWithPrior
from tests.helpers.ties import DT, Tie

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


def test_a_member_is_not_worth_more_for_knowing_less(tie: Tie) -> None:
    """Of two members that are one but for what they know, the one that is surer of the truth is worth more."""
    member = tie.members[0]
    (only, *_) = member.branches
    sure = replace(member, branches=(only,))
    lost = np.zeros_like(only.known)
    j = member.vector.labels.index("constant_force.acceleration")
    lost[j, j] = 0.99 / np.linalg.inv(only.known)[j, j]
    vague = replace(member, branches=(Branch(only.theta, only.known - lost, only.nats),))
    told = [against(f.brought, 0) for f in fit_all([sure, vague], [_flown(tie, s) for s in range(4)])]
    assert np.mean(told) > 0.3


@pytest.mark.parametrize("truth", [0, 1])
def test_no_rehearsal_speaks_against_what_it_simulates_on_average(tie: Tie, truth: int) -> None:
    """Of an experiment that tells nothing, too: the last term of the density is what keeps it so."""
    told = tie.rehearsed(truth, np.zeros((20, 1)), count=8, seed=3)
    assert told.evidence.mean() > -0.5
