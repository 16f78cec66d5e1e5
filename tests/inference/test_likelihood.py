"""The log likelihood is that of the joint Gaussian of all rows, cut into chunks or whole, and of outliers nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.inference import LogLikelihood, log_likelihood
from nsde_torch.inference.estimate import maximised
from nsde_torch.inference.lanes import WIDTH
from nsde_torch.inference.steps import Chunks, low_passed, steps_of
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded
from tests.inference.springs import (
    GUST,
    LASTS,
    SENSOR,
    TRUTH,
    WHITE,
    B,
    G,
    K,
    exact_step,
    levels_of,
    linear_runs,
    spring,
    value,
)

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


@pytest.mark.parametrize("count", [2, WIDTH + 3])
def test_it_is_that_of_the_joint_gaussian_of_all_rows_after_the_first_of_any_number_of_runs(
    count: int,
) -> None:
    runs, expected = linear_runs(count, 1.6), 0.0
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


Stretches = tuple[tuple[int, int], ...]


def numbered(lengths: tuple[int, ...], gaps: dict[int, Stretches], dt: float) -> list[Run]:
    out, at = [], 0
    for k, n in enumerate(lengths):
        number = np.arange(at, at + n, dtype=np.float64)
        x = np.column_stack([number, number])
        out.append(Run(f"run_{k}", dt * number, x, number[:, None], segments=gaps.get(k, ())))
        at += n
    return out


CASES: dict[str, tuple[tuple[int, ...], dict[int, Stretches]]] = {
    "of two rows": ((2, 2), {}),
    "long and short": ((2357, 700, 33, 141, 140), {}),
    "with gaps": ((800, 300), {0: ((0, 40), (45, 450), (500, 800)), 1: ((10, 12), (20, 299))}),
}


@pytest.mark.parametrize("dt", [0.1, 0.02, 0.001])
@pytest.mark.parametrize("late", [0, 30])
@pytest.mark.parametrize("case", CASES)
def test_each_row_after_the_first_ones_of_a_stretch_counts_once(case: str, late: int, dt: float) -> None:
    runs = numbered(*CASES[case], dt)
    chunks = Chunks(steps_of(spring(), runs, clock=1.0, smooth=False), late=late)
    expected = np.concatenate([run.x[a + 1 + late : b, 0] for run in runs for a, b in run.segments])
    counted = chunks.y[chunks.counted][:, 0].numpy()
    np.testing.assert_array_equal(np.sort(counted), expected)


ROWS, FIRST, COUNT = 3000, 1777, 10


@pytest.mark.parametrize("by", [0.1, 1.0, 5.0])
def test_a_jump_of_ten_rows_is_left_out_and_moves_nothing(by: float) -> None:
    """As markers jump that a camera system confuses: far off for a moment, and back on the way."""
    runs = linear_runs(8, ROWS * 0.02, seed=2)
    x = np.array(runs[1].x)
    x[FIRST : FIRST + COUNT, 0] += by
    problem = LogLikelihood(spring(), [runs[0], replace(runs[1], x=x), *runs[2:]])
    found, at = maximised(problem)
    sound, _ = maximised(LogLikelihood(spring(), runs))
    row = problem.space.chunks.row[problem.outliers.any(-1)]
    assert sorted(row.tolist()) == [ROWS + FIRST + k for k in range(COUNT)]
    assert at.outlier_times == {1: runs[1].t[FIRST : FIRST + COUNT].tolist()}
    for name in (K, B):
        (here, _), (there, error) = value(found, name), value(sound, name)
        assert here == pytest.approx(there, abs=0.2 * error)
    assert found.likelihood > sound.likelihood - 10 * COUNT


def test_a_sound_log_has_no_outliers() -> None:
    problem = LogLikelihood(spring(), linear_runs(2, 20.0))
    maximised(problem)
    assert not bool(problem.outliers.any())


def test_rows_that_an_effect_explains_are_no_outliers_any_more() -> None:
    """A force that was cut to a limit in a few rows: they are left out before anybody knows of the limit."""
    runs = recorded("mass_spring_damper", durations=(20.0,) * 4).runs
    most = max(float(abs(run.u).max()) for run in runs)
    # what was asked for in the rows of the largest force is more than the limit let through
    more = [np.where(abs(run.u) > 0.995 * most, np.sign(run.u) * 10.0 * most, run.u) for run in runs]
    cut = [replace(run, u=u) for run, u in zip(runs, more, strict=True)]
    problem = LogLikelihood(make_system("mass_spring_damper"), cut, run_in=True)
    _, before = maximised(problem)
    assert before.outlier_times
    level = {"actuator_saturation.level": most}
    limited = make_system("mass_spring_damper", effects=["actuator_saturation"], values=level)
    _, after = maximised(problem.of(limited), before)
    assert bool(after.of.outliers.any())
    assert not after.outlier_times


def test_what_is_below_stays_and_what_is_above_goes() -> None:
    t = 0.02 * torch.arange(1000, dtype=torch.float64)
    slow = 0.3 + 0.05 * t + torch.sin(2 * torch.pi * 1.7 * t)
    fast = torch.sin(2 * torch.pi * 8.0 * t)
    out = low_passed(torch.stack((slow, slow + fast, fast), 1), 5.0, 0.02, level=True)
    inner = slice(50, -50)
    assert float((out[inner, 0] - slow[inner]).abs().max()) < 0.01
    assert float((out[inner, 1] - slow[inner]).abs().max()) < 0.02
    assert float(out[inner, 2].abs().max()) < 0.02
    # a disk whose parameters all ended at bounds, behind a smoother, was a traceback of the Fourier transform
    assert low_passed(torch.zeros(100, 2, 0), 5.0, 0.02).shape == (100, 2, 0)


def test_beyond_the_end_of_a_short_stretch_states_stay_where_they_were_measured() -> None:
    """A pole falls there; its slopes were no numbers, and a search in rows that move began without a likelihood."""
    effects = {"coulomb_friction[cart]": {"size": 0.4}}, {"viscous_friction[pole]": {"damping": 0.3}}
    (run,) = recorded("cartpole", *effects, durations=(8.0,), dt=0.02, seed=2).runs
    moving = (0, 180), (180, 225), (226, 266), (266, 310), (310, 350)
    system = make_system("cartpole", effects=["coulomb_friction[cart]"])
    problem = LogLikelihood(system, [replace(run, segments=moving)], 1.0)
    _, at = maximised(problem)
    chunks = problem.space.chunks
    assert bool(chunks.beyond.any())
    assert not bool((chunks.beyond & chunks.counted).any())
    assert float(at.about.x.abs().max()) < 1.1 * float(chunks.y.abs().max())
    assert bool(torch.isfinite(at.about.slopes).all())
