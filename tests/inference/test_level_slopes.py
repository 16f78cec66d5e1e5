"""What the noise levels do to a pass, against differences of the filter."""

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.inference import LogLikelihood, kernels, nearly_maximised
from nsde_torch.inference.filtering import Linearisation, Pass, filtered
from nsde_torch.inference.level_slopes import level_slopes, score
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.maximum import _curved
from nsde_torch.systems import make_system
from tests.inference.springs import linear_runs, spring

SMALL = 1e-5


def flight() -> LogLikelihood:
    system = make_system("hexacopter", effects=["motor_lag"])
    made = nsde_torch.simulate("hexacopter", effects=["motor_lag"], durations=[3.0], seed=3)
    return LogLikelihood(system, nsde_torch.read(made, system=system).runs)


def passed(problem: LogLikelihood, levels: Levels, about: Linearisation) -> Pass:
    live = problem.space.chunks.counted
    return filtered(problem.space, levels, about, problem.start, live, covariances=problem.space.nd)


@pytest.mark.parametrize("of", ["spring", "flight"])
def test_the_score_and_the_slopes_of_the_levels_are_the_filter_s(of: str) -> None:
    problem = LogLikelihood(spring(), linear_runs(2, 4.0)) if of == "spring" else flight()
    first, about = problem.first(problem.vector.start)
    phi, live = first.vector(), problem.space.chunks.counted
    at = passed(problem, first, about)
    exact = score(problem.space, first, about, at, live).sum(0)
    slopes, spreads = level_slopes(problem.space, first, about, at, spreads=True)
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


@pytest.mark.slow
def test_parts_of_a_log_side_by_side_give_the_same_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = flight()
    levels, about = problem.first(problem.vector.start)
    space, live = problem.space, problem.space.chunks.counted
    assert space.chunks.count > 1
    monkeypatch.setattr(kernels, "_FEWEST", 1)
    kernels._pool.cache_clear()
    passes = []
    for threads in (1, 2):
        monkeypatch.setattr(kernels, "allowed_threads", lambda count=threads: count)
        at = passed(problem, levels, about)
        slopes, _ = level_slopes(space, levels, about, at)
        passes.append((at.rows, score(space, levels, about, at, live), slopes))
    for one, other in zip(*passes, strict=True):
        assert torch.equal(one, other)
    assert kernels._pool.cache_info().misses == 1  # the second of them had two threads


@pytest.mark.parametrize("precise", [1e-3, 1e-5, 1e-7])
def test_the_score_holds_over_long_chunks_of_precise_sensors(precise: float) -> None:
    """Rounding grew from row to row of the pass backwards: slopes of 1e50 and more, and levels that never moved.

    Two masses, each pushed by a disturbance that lasts; of the second the speed is measured too.
    """
    rows, dt, observed = 500, 0.01, np.array([0, 1, 3])
    random = np.random.default_rng(1)
    slopes = np.zeros((rows, 1, 4, 6))
    rates = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-3, 0, -2, 1], [0, 0, 2, -1]])
    slopes[:, 0, :, :4] = np.eye(4) + dt * rates
    slopes[:, 0, 2, 4] = slopes[:, 0, 3, 5] = dt
    keep, white, live = np.full(2, 0.95), np.full(2, 1e-4), np.ones((rows, 1), bool)
    gust = 1.0 - keep**2
    missed, seen = np.zeros((rows, 1, 4)), np.zeros((rows, 1, 3))
    x = np.zeros(6)
    for k in range(rows - 1):
        x[:4] = slopes[k, 0] @ x + slopes[k, 0, :, 4:] @ (0.01 * random.standard_normal(2))
        x[4:] = keep * x[4:] + np.sqrt(gust) * random.standard_normal(2)
        seen[k + 1, 0] = x[observed] + (precise, precise, 0.1) * random.standard_normal(3)

    def passed(sensor: np.ndarray, pushed: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Log likelihood, and its slopes in the variances of the sensors and of white disturbances."""
        whitening, gain, spread = (np.zeros((rows, 1, *shape)) for shape in ((3, 3), (6, 3), (6, 2)))
        noise = (keep, pushed, gust, sensor, np.ones(6), observed, np.zeros((0, 0, 0), bool))
        kernels.covariances(0, 1, slopes, *noise, whitening, gain, spread)
        errors, whitened = np.zeros((rows, 1, 3)), np.zeros((rows, 1, 3))
        left, nats = np.zeros((rows, 1, 6)), np.zeros((rows, 1))
        kernels.means(
            0, 1, slopes, keep, np.zeros((1, 4)), missed, seen, observed, live, whitening, gain,
            errors, whitened, left, nats,
        )  # fmt: skip
        parts = [np.zeros((1, 3)), *(np.zeros((1, 2)) for _ in range(4))]
        kernels.adjoints(0, 1, slopes, keep, observed, whitening, gain, whitened, left, spread, live, *parts)
        return float(nats[1:].sum()), parts[0][0], parts[1][0]

    sensor = np.array([precise**2, precise**2, 0.01])
    _, of_sensors, of_white = passed(sensor, white)
    for j in range(2):
        up, down = (passed(sensor, white * (1.0 + way * 1e-3 * np.eye(2)[j]))[0] for way in (1.0, -1.0))
        assert white[j] * of_white[j] == pytest.approx((up - down) / 2e-3, rel=1e-2, abs=1e-2)
    up, down = (passed(sensor * (1.0 + way * 1e-3 * np.eye(3)[2]), white)[0] for way in (1.0, -1.0))
    assert sensor[2] * of_sensors[2] == pytest.approx((up - down) / 2e-3, rel=1e-2, abs=1e-2)


def test_the_information_takes_on_the_curvature_of_a_step_and_stays_positive() -> None:
    rng = torch.Generator().manual_seed(2)
    half = torch.randn(4, 4, generator=rng, dtype=torch.float64)
    known, moved = half @ half.T + torch.eye(4), torch.randn(4, generator=rng, dtype=torch.float64)
    bent = 0.3 * known @ moved + 0.1 * moved
    found = _curved(known, moved, bent)
    torch.testing.assert_close(found @ moved, bent)
    assert torch.linalg.eigvalsh(found).min() > 0.0
    # of a step along which the likelihood bends upwards nothing is learned
    assert _curved(known, moved, -bent) is known


@pytest.mark.slow
def test_levels_do_not_stop_by_information_from_elsewhere() -> None:
    drag = {"linear_drag": {"drag": [0.35, 0.3, 0.15]}}
    made = nsde_torch.simulate("hexacopter", effects=[drag], durations=[15.0], seed=106)
    system = make_system("hexacopter", effects=["linear_drag"])
    runs = nsde_torch.read(made, system=system).runs
    best, at = nearly_maximised(LogLikelihood(system, runs, run_in=True))
    best.vector.write(system, best.theta)
    # what is not there brings what the levels had stopped below, 6.4 nats
    more = system.with_effects(system.make_effect("gyroscopic_moment", {}))
    assert nearly_maximised(at.of.of(more), at)[0].likelihood - best.likelihood < 2.0
