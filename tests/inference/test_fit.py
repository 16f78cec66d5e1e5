"""The fit climbs, finds what is true with the noise it came with, and objects where it is wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import nsde_torch
from nsde_torch.data import Run
from nsde_torch.inference import LogLikelihood, fit, log_likelihood
from nsde_torch.inference.estimate import filtered_at
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.maximum import likeliest
from nsde_torch.inference.posterior import LogWithPrior, Posteriors
from nsde_torch.recording import assemble
from nsde_torch.simulation import simulate
from nsde_torch.systems import make_system
from tests.helpers.encoders import TRUTH as ENCODED
from tests.helpers.encoders import encoder_runs
from tests.inference.springs import (
    GUST,
    SENSOR,
    TRUTH,
    B,
    G,
    K,
    assert_near,
    levels_of,
    linear_runs,
    spring,
    value,
)

FAR = {G: 0.3, K: 20.0, B: 3.0}


def test_it_ends_above_the_truth_and_what_it_reports_is_the_likelihood_there() -> None:
    runs = linear_runs(2, 12.0, seed=1)
    found = fit(spring(values=FAR), runs)
    system = spring()
    found.vector.write(system, found.theta)
    assert found.likelihood == pytest.approx(log_likelihood(system, runs, levels=found.levels), abs=0.01)
    assert found.likelihood > log_likelihood(spring(), runs, levels=levels_of())


@pytest.mark.parametrize("inferred", [False, True])
def test_noise_levels_and_parameters_are_found(inferred: bool) -> None:
    runs = linear_runs(3, 25.0, seed=2)
    if inferred:
        runs = [replace(run, inferred={"q_dot": 0.4}) for run in runs]
    found = fit(spring(values={G: 1.0, K: 1.0, B: 0.5}), runs)
    assert found.settled
    assert found.objections == []
    assert found.channels == (("q",) if inferred else ("q", "q_dot"))
    expected = SENSOR[:1] if inferred else SENSOR
    np.testing.assert_allclose(found.levels.sensor.exp().numpy(), expected, rtol=0.05)
    # a minute of gusts that last 0.4 s has some hundred of them
    assert float(found.levels.gust.exp()) == pytest.approx(GUST, rel=0.15)
    assert_near(found, share=0.2)


@pytest.mark.parametrize("lag", [0.05, 0.2])
def test_the_lag_of_an_actuator_is_found(lag: float) -> None:
    runs = linear_runs(2, 12.0, seed=2, lag=lag, gust=0.1)
    found = fit(spring("actuator_lag", values={}), runs)
    assert found.settled
    assert found.objections == []
    assert_near(found, {**TRUTH, "actuator_lag.time_constant": lag})
    assert value(found, "actuator_lag.time_constant")[1] < 0.1 * lag


def test_gaps_and_runs_of_unequal_length_are_fitted_as_one() -> None:
    long, short = linear_runs(2, 20.0, seed=3)
    long = replace(long, segments=((0, 40), (60, 400), (405, len(long))))
    found = fit(spring(values={}), [long, short.slice(0, 90)])
    assert found.objections == []
    assert_near(found)


def test_levels_are_held_where_the_log_has_no_gusts() -> None:
    runs = linear_runs(2, 8.0, white=0.0, gust=0.0)
    found = fit(spring(values={G: 1.0, K: 1.0, B: 0.5}), runs)
    assert isinstance(found.levels, Levels)
    # over a second, what is left of disturbances moves the rate by less than its sensor sees
    assert float(found.levels.white.exp()) < 0.5 * SENSOR[1]
    assert float(found.levels.gust.exp()) < 0.1 * GUST
    assert_near(found)


@pytest.mark.slow
def test_levels_end_at_once_where_they_end_when_begun_with_again() -> None:
    """A level that nothing shows made the whole step as short as it wanted its own: 30 nats below after twelve."""
    system = make_system("hexacopter")  # without the lag that is there
    made = nsde_torch.simulate("hexacopter", effects=["motor_lag"], durations=[6.0] * 2, seed=3)
    problem = LogLikelihood(system, nsde_torch.read(made, system=system).runs)
    first, about = problem.first(problem.vector.start)
    about, _ = problem.settled(first, about, problem.filtered(first, about), 1)
    levels, totals = first, []
    for _ in range(3):
        levels, _, _ = likeliest(problem.space, levels, first, about)
        totals.append(problem.filtered(levels, about).total)
    assert totals[-1] - totals[0] < 1.0


def test_a_sensor_beside_a_far_better_one_says_little_of_the_physics() -> None:
    """Rates that are as good as their noise: however that repeats itself, it is no reason to doubt the physics."""
    rng = np.random.default_rng(0)
    runs = linear_runs(2, 12.0, sensor=(1e-4, 0.0), seed=2)
    noise = [np.convolve(rng.standard_normal(len(run.x) + 9), np.ones(10) / 10.0, "valid") for run in runs]
    noisy = [replace(r, x=r.x + np.outer(v, [0, 1])) for r, v in zip(runs, noise, strict=True)]
    found = fit(spring(), noisy)
    alone = fit(spring(), linear_runs(2, 12.0, seed=2))
    assert found.predictable[1] > 0.5
    assert found.driven[1] < 0.02 < 0.3 < found.driven[0]
    assert found.worst(found.driven) < 2.0 + alone.worst(alone.driven)
    assert found.worst(np.ones(2)) > 20.0


@pytest.mark.slow
def test_the_likelihood_asks_for_the_attitude_and_not_for_the_sign_of_its_quaternion() -> None:
    system = make_system("hexacopter")
    made = simulate("hexacopter", seed=1, durations=[4.0], declared_only=True)
    (run,), turned = nsde_torch.read(made, system=system).runs, np.ones(13)
    turned[system.quaternion] = -1.0
    sensor = [1e-3] * 3 + [1e-2] * 3 + [3.5e-3] * 3 + [2e-2] * 3
    levels = Levels(
        torch.tensor(sensor, dtype=torch.float64).log(),
        *(torch.full((6,), np.log(size), dtype=torch.float64) for size in (0.01, 0.3, 0.3)),
    )
    expected = log_likelihood(system, [run], levels=levels)
    assert log_likelihood(system, [replace(run, x=run.x * turned)], levels=levels) == pytest.approx(expected)


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_what_is_not_known_of_a_rate_is_as_large_as_its_error(friction: float) -> None:
    system = make_system("mass_spring_damper", values=ENCODED)
    data = assemble(encoder_runs("none", friction=friction, runs=2), system, kind="test")
    true = np.concatenate([run.x[:, 1] for run in encoder_runs("truth", friction=friction, runs=2)])
    found = filtered_at(LogLikelihood(system, data.runs, states=True))
    rate = np.concatenate([x[:, 1] for x in found.states(data.runs)])
    assert 0.7 < np.std(rate - true) / float(found.unknown()[1]) < 1.2
    assert float(found.square()[0]) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("effects", [(), ("actuator_lag",)])
def test_logs_side_by_side_have_the_likelihood_that_they_have_alone(effects: tuple[str, ...]) -> None:
    system = spring(*effects)
    own = Posteriors(system, levels_of())
    start = own.vector.start
    runs = linear_runs(3, 5.0, seed=1)
    short = runs[1]
    runs[1] = Run("short", short.t[:60], short.x[:60], short.u[:60])
    none = np.zeros((len(start), len(start)))
    problems = [LogWithPrior((run,), f * start, none) for f, run in zip((1.0, 1.05, 0.9), runs, strict=True)]
    for problem, here in zip(problems, own.at_centres(problems), strict=True):
        (alone,) = own.at_centres([problem])
        assert here.nats == pytest.approx(alone.nats, abs=1e-6)
        np.testing.assert_allclose(here.information, alone.information, rtol=1e-6, atol=1e-3)
        if not effects:  # those that remember bring up their memory first there
            machine = spring()
            own.vector.write(machine, problem.centre)
            whole = log_likelihood(machine, problem.runs, levels=levels_of())
            assert here.nats == pytest.approx(whole, abs=1e-3)


def test_parameters_are_found_within_their_standard_errors_and_the_prior_counts() -> None:
    own = Posteriors(spring(), levels_of())
    truth, runs = own.vector.start, linear_runs(2, 20.0, seed=2)
    assert dict(zip(own.vector.labels, truth, strict=True)) == pytest.approx(dict(TRUTH))
    wide, narrow = (np.diag(1.0 / np.square(share * truth)) for share in (10.0, 1e-4))
    found, held = own.modes([LogWithPrior((runs[0],), 1.5 * truth, k) for k in (wide, narrow)])
    errors = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert (np.abs(found.theta - truth) < 3.5 * errors).all()
    assert 0.9 < found.excess < 1.1
    assert found.moved < 0.2
    np.testing.assert_allclose(held.theta, 1.5 * truth, rtol=0.01)
    assert held.nats < found.nats
    # of all runs together more is known than of one
    (both,) = own.modes([LogWithPrior(tuple(runs), truth, wide)])
    assert (np.sqrt(np.diag(np.linalg.inv(both.information))) < errors).all()
