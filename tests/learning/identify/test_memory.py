"""Memory of effects along measured runs: that of one long integration, segment by segment, after the run-in."""

from __future__ import annotations

import numpy as np
import torch

from nsde_torch.data import Run
from nsde_torch.learning.identify.memory import memory_along
from nsde_torch.learning.identify.steps import steps_of
from nsde_torch.systems import make_system

DT, TAU = 0.01, 0.05


def run_with_gap() -> Run:
    rng = np.random.default_rng(0)
    n = 700
    x = np.zeros((n, 13))
    x[:, 6] = 1.0
    t = DT * np.arange(n)
    t[300:] += 3.0
    u = 0.4 + 0.1 * rng.normal(size=(n, 6))
    return Run("r", t, x, u, segments=((0, 300), (300, n)))


def test_it_is_the_exact_response_of_each_segment_from_rest_at_its_first_input() -> None:
    run = run_with_gap()
    system = make_system(
        "hexacopter", effects=["motor_lag"], values={"motor_lag.time_constant": TAU}
    ).double()
    with torch.no_grad():
        steps = steps_of(system, [run], clock=1.0, smooth=False)
        before, after = (part.numpy() for part in memory_along(system, steps))
    fade = np.exp(-DT / TAU)
    expected_before, expected_after = [], []
    for a, b in run.segments:
        m, rows = run.u[a], []
        for k in range(a, b - 1):
            rows.append((m, m := run.u[k] + (m - run.u[k]) * fade))
        lead = min(40, (b - 1 - a) // 10)  # the run-in: 0.4 s or a tenth
        expected_before += [r[0] for r in rows[lead:]]
        expected_after += [r[1] for r in rows[lead:]]
    np.testing.assert_allclose(before, expected_before, atol=2e-6)
    np.testing.assert_allclose(after, expected_after, atol=2e-6)


def test_a_wrong_first_memory_is_forgotten_when_equations_begin() -> None:
    """What the motors did before the recording is unknown; 0.4 s later it no longer matters."""
    run = run_with_gap()
    system = make_system(
        "hexacopter", effects=["motor_lag"], values={"motor_lag.time_constant": TAU}
    ).double()
    other = np.array(run.u)
    other[0] += 0.5  # the first input alone, at which the memory starts
    with torch.no_grad():
        first, second = (
            memory_along(system, steps_of(system, [Run("r", run.t, run.x, u)], clock=1.0, smooth=False))[0]
            for u in (run.u, other)
        )
    assert float((first - second).abs().max()) < 0.5 * 1.2 * np.exp(-0.39 / TAU)
