"""What the noise levels do to a pass, against differences of the filter."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.filtering import Linearisation, Pass, filtered
from nsde_torch.inference.level_slopes import level_slopes, score
from nsde_torch.inference.levels import Levels
from nsde_torch.systems import make_system
from tests.inference.springs import linear_runs, spring

SMALL = 1e-5


def flight() -> LogLikelihood:
    system = make_system("hexacopter", effects=["motor_lag"])
    made = nsde_torch.simulate("hexacopter", effects=["motor_lag"], durations=[3.0], seed=3)
    return LogLikelihood(system, nsde_torch.read(made, system=system).runs)


def passed(problem: LogLikelihood, levels: Levels, about: Linearisation) -> Pass:
    live = problem.space.chunks.counted
    return filtered(problem.space, levels, about, problem.start, live, covariances=True)


@pytest.mark.parametrize("of", ["spring", "flight"])
def test_the_score_and_the_slopes_of_the_levels_are_the_filter_s(of: str) -> None:
    problem = LogLikelihood(spring(), linear_runs(2, 4.0)) if of == "spring" else flight()
    first, about = problem.first(problem.vector.start)
    phi, live = first.vector(), problem.space.chunks.counted
    at = passed(problem, first, about)
    exact = score(problem.space, first, about, at, live).sum(0)
    slopes, spreads = level_slopes(problem.space, first, about, at, spreads=True)
    assert spreads is not None
    for j, step in enumerate(SMALL * torch.eye(len(phi), dtype=phi.dtype)):
        up, down = (passed(problem, first.like(phi + way * step), about) for way in (1.0, -1.0))
        difference = (up.total - down.total) / (2 * SMALL)
        assert exact[j] == pytest.approx(difference, rel=1e-4, abs=1e-6 * float(exact.abs().max()))
        moved = at.whitening @ (up.errors - down.errors)[..., None] / (2 * SMALL)
        near = 2e-5 * float(slopes.abs().max())
        np.testing.assert_allclose(slopes[..., j], moved[..., 0], atol=near)
        seen = [torch.linalg.inv(p.whitening) for p in (up, down)]
        turned = (seen[0] @ seen[0].mT - seen[1] @ seen[1].mT) / (2 * SMALL)
        turned = at.whitening @ turned @ at.whitening.mT
        np.testing.assert_allclose(spreads[1:, :, j], turned[1:], atol=1e-5)
