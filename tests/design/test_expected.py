"""What an experiment is expected to tell is what it tells: checked by noisy experiments that are fitted."""

import numpy as np
import pytest

from nsde_torch.design.members import Rollouts, open_loop
from nsde_torch.design.proposals import Precision, Separation
from tests.helpers.ties import DT, Tie

HOLD = np.repeat([[0.1], [-0.1], [0.0]], 25, 0)  # stands still: the steady push is felt, or is not there
TWICE = 2.0


def _flown(tie: Tie, truth: int, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    member = tie.members[truth]
    rollouts, drive = Rollouts(member.system, dt=DT), open_loop(table[None])
    states, _, inputs = rollouts.run(member.theta[None], np.zeros((1, 2)), drive, len(table))
    return states, inputs


def _nats(tie: Tie, truth: int, pair: Separation, table: np.ndarray) -> float:
    states, inputs = _flown(tie, truth, table)
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


def test_no_evidence_is_expected_against_what_a_refit_takes_away(tie: Tie) -> None:
    member = tie.members[0]
    assert _nats(tie, 0, Separation(member, member), HOLD) == pytest.approx(0.0, abs=1e-3)


def test_standard_errors_fall_with_an_experiment_and_never_rise(tie: Tie) -> None:
    member = tie.members[0]
    now = np.sqrt(np.diag(member.covariance))
    then = Precision(member, [0], member.theta[:1]).errors(*_flown(tie, 0, HOLD), member.theta)[0]
    assert (then <= 1.0001 * now).all()
    steady = member.vector.labels.index("constant_force.acceleration")
    assert then[steady] < 0.9 * now[steady]
