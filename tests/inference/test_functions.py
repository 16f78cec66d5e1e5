"""Functions chosen by held-out likelihood, on springs of a simulator of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from nsde_torch.data import Run
from nsde_torch.inference import LogLikelihood, maximised
from nsde_torch.inference.functions import Functions, learned
from tests.inference.springs import TRUTH, B, rubbing, small_runs, spring


def found(runs: list[Run]) -> Functions:
    _, at = maximised(LogLikelihood(spring(), runs), nuisances=False)
    return learned(at, torch.Tensor.double, ("q", "q_dot"), [0])


def test_a_drag_is_found_as_a_function_of_the_speed_with_what_the_damping_is_beside_it() -> None:
    size = 0.1
    out = found(small_runs(replace(rubbing(0.0), effects={"quadratic": {"size": size}}), 4, 10.0, seed=3))
    assert out.groups
    assert {name for g in out.groups for name in g.variables} == {"q_dot"}
    assert out.nats[0] > 10.0 * out.error[0] > 0.0 or out.nats[0] > 50.0
    at = [g for g in spring_labels() if g == B]
    assert at
    damping = out.theta[spring_labels().index(B)]
    reach = 0.8 * out.scaled["q_dot"].half
    v = np.linspace(-reach, reach, 9)
    values = {"q": np.zeros(9), "q_dot": v}
    total = -damping * v + out.force(values, 0)[0]
    true = -TRUTH[B] * v - size * np.abs(v) * v
    # a constant is a force of the spring's rest, and no part of a drag
    np.testing.assert_allclose(total - total.mean(), true - true.mean(), atol=0.05 * np.abs(true).max())
    assert (out.force(values, 0)[1] >= 0).all()


def spring_labels() -> list[str]:
    return list(LogLikelihood(spring(), small_runs(rubbing(0.0), 1, 3.0, seed=0)).vector.labels)


def test_nothing_is_found_where_nothing_is_missing() -> None:
    for seed in range(6):
        assert found(small_runs(rubbing(0.0), 3, 8.0, seed=seed)).groups == ()
