"""The log likelihood is that of the joint Gaussian of all rows, cut into chunks or whole."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.inference import LogLikelihood, chunks, log_likelihood
from nsde_torch.inference.estimate import maximised, nearly_maximised
from nsde_torch.systems import make_system
from tests.inference.springs import (
    GUST,
    LASTS,
    SENSOR,
    TRUTH,
    WHITE,
    G,
    K,
    exact_step,
    levels_of,
    linear_runs,
    moved,
    spring,
)

Array = NDArray[np.float64]

LATE = 30  # rows that are not counted where rates are inferred
UNKNOWN = 3.0  # times what is not known of an inferred rate: where a filter starts


def joint(run: Run, seen: list[int], first: Array, variance: Array, begun: int) -> tuple[Array, Array]:
    """What is measured less its mean (rows, channels), and the covariance of all that (rows, channels, rows, channels).

    Rows are those after `begun`, where the state is normal about `first`. Written as the sum of what each source of
    noise does to all rows, not as a recursion over time.
    """
    n, h = len(run) - begun, run.dt
    transition, push = exact_step(TRUTH, h)
    keep = np.exp(-h / LASTS)
    forward = np.zeros((3, 3))
    forward[:2, :2], forward[:2, 2], forward[2, 2] = transition, push, keep
    struck = np.zeros((3, 2))
    struck[:2, 0], struck[2, 1] = push * WHITE / np.sqrt(h), GUST * np.sqrt(1.0 - keep**2)
    powers = [np.linalg.matrix_power(forward, k) for k in range(n)]
    sources = np.zeros((n, 3, 3 + 2 * (n - 1)))
    mean = np.zeros((n, 2))
    for k in range(n):
        sources[k, :, :3] = powers[k] @ np.diag(np.sqrt(variance))
        mean[k] = powers[k][:2, :2] @ first
        for j in range(k):
            sources[k, :, 3 + 2 * j : 5 + 2 * j] = powers[k - 1 - j] @ struck
            mean[k] += powers[k - 1 - j][:2, :2] @ push * TRUTH[G] * run.u[begun + j, 0]
    some = sources[1:, seen]
    covariance = np.einsum("kis,ljs->kilj", some, some)
    for i, channel in enumerate(seen):
        at = np.arange(n - 1)
        covariance[at, i, at, i] += SENSOR[channel] ** 2
    return run.x[begun + 1 :, seen] - mean[1:, seen], covariance


def density(residual: Array, covariance: Array) -> float:
    """Log density of a normal vector, without log 2 pi / 2 for each entry, as the package leaves it out."""
    flat = residual.reshape(-1)
    square = covariance.reshape(len(flat), len(flat))
    return float(-0.5 * flat @ np.linalg.solve(square, flat) - 0.5 * np.linalg.slogdet(square)[1])


def test_with_all_states_measured_it_is_that_of_the_joint_gaussian_of_all_rows_after_the_first() -> None:
    runs = linear_runs(2, 1.6)
    expected = 0.0
    for run in runs:
        variance = np.array([SENSOR[0] ** 2, SENSOR[1] ** 2, GUST**2])
        expected += density(*joint(run, [0, 1], run.x[0], variance, 0))
    got = log_likelihood(spring(), runs, levels=levels_of())
    assert got == pytest.approx(expected, abs=1e-4)


def test_with_positions_alone_it_is_that_of_the_later_rows_given_the_first_ones() -> None:
    unknown = 0.4
    (run,) = linear_runs(1, 2.0)
    run = replace(run, inferred={"q_dot": unknown})
    # the filter begins at the first row that has a difference to the row before
    first = np.array([run.x[1, 0], (run.x[1, 0] - run.x[0, 0]) / run.dt])
    variance = np.array([SENSOR[0] ** 2, (UNKNOWN * unknown) ** 2, GUST**2])
    residual, covariance = joint(run, [0], first, variance, 1)
    early = density(residual[:LATE], covariance[:LATE, :, :LATE])
    got = log_likelihood(spring(), [run], levels=levels_of(SENSOR[:1]))
    assert got == pytest.approx(density(residual, covariance) - early, abs=1e-4)


def test_a_clock_that_runs_slow_is_made_up_for() -> None:
    (run,) = linear_runs(1, 1.6)
    slow = Run(run.name, 0.5 * run.t, run.x, run.u)
    expected = log_likelihood(spring(), [run], levels=levels_of())
    assert log_likelihood(spring(), [slow], levels=levels_of(), clock=2.0) == pytest.approx(expected)


@pytest.mark.parametrize("inferred", [False, True])
def test_cutting_a_long_run_into_chunks_changes_little(
    inferred: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = linear_runs(1, 12.0)
    if inferred:
        runs = [replace(run, inferred={"q_dot": 0.4}) for run in runs]
    levels = levels_of(SENSOR[:1] if inferred else SENSOR)

    def both() -> tuple[float, float]:
        near, far = (log_likelihood(moved(by), runs, levels=levels) for by in ({}, {K: 0.5}))
        return near, near - far

    cut, told_cut = both()
    monkeypatch.setattr(chunks, "_LENGTH", (len(runs[0]), len(runs[0])))
    whole, told_whole = both()
    # what the filter was told before a chunk: some tenths of a nat of ten thousand
    assert cut != whole
    assert cut == pytest.approx(whole, abs=1.5)
    # and less in what parameters are compared by
    assert told_cut == pytest.approx(told_whole, abs=0.1)


def test_physics_that_are_compared_are_disturbed_on_the_same_ports() -> None:
    # a force on the cart does not turn a pole that lies; then it is what a tilt does, of a tilted pole it is not
    still = []
    for run in nsde_torch.simulate("cartpole", durations=[3.0, 3.0], seed=1).runs:
        noise = 1e-4 * np.random.default_rng(1).standard_normal(run.x.shape)
        x = run.x * (1.0, 1.0, 0.0, 0.0) + (0.0, 0.0, 0.5 * np.pi, 0.0) + noise
        still.append(Run(run.name, run.t, x, 0.0 * run.u))
    system = make_system("cartpole")
    bias = {"position_bias[pole].bias": -0.7}
    biased = make_system("cartpole", effects=["position_bias[pole]"], values=bias)
    problem = LogLikelihood(system, still)
    other = LogLikelihood(biased, still)
    assert other.space.nd > problem.space.nd
    _, at = nearly_maximised(problem)
    best, _ = nearly_maximised(problem.of(biased), at)
    assert best.disturbances == problem.space.disturbances
    with pytest.raises(DataError, match="noise levels of"):
        maximised(other, held=at.levels)


def test_a_fit_ends_where_it_has_no_way_to_what_is_wanted() -> None:
    problem, far = LogLikelihood(spring(), linear_runs(2, 10.0, seed=5)), moved({K: -2.0})
    best, at = nearly_maximised(problem)
    whole, _ = nearly_maximised(problem.of(far), at)
    cut, _ = nearly_maximised(problem.of(far), at, wanted=best.likelihood + 1e6)
    same, _ = nearly_maximised(problem.of(far), at, wanted=best.likelihood - 10.0)
    assert cut.likelihood < whole.likelihood - 50.0
    assert same.likelihood == pytest.approx(whole.likelihood, abs=1.0)
    assert whole.likelihood == pytest.approx(best.likelihood, abs=1.0)
