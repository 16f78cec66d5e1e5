"""Functions chosen by held-out likelihood, on springs of a simulator of its own."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.inference import LogLikelihood, maximised
from nsde_torch.inference.force_scores import DRAWS, FunctionScores
from nsde_torch.inference.functions import Functions, learned, log_chance, seen_by_networks
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.inference.springs import SENSOR, TRUTH, B, G, K, rubbing, run, small_runs, spring


def found(runs: list[Run]) -> Functions:
    _, at = maximised(LogLikelihood(spring(), runs), nuisances=False)
    return learned(at, seen_by_networks(spring()), [0])


def test_a_drag_is_found_as_a_function_of_the_speed_with_what_the_damping_is_beside_it() -> None:
    size = 0.1
    out = found(small_runs(replace(rubbing(0.0), effects={"quadratic": {"size": size}}), 4, 10.0, seed=3))
    assert out.groups
    assert {name for g in out.groups for name in g.variables} == {"q_dot"}
    assert out.nats[0] > 10.0 * out.error[0] > 0.0 or out.nats[0] > 50.0
    damping = out.theta[LABELS.index(B)]
    reach = 0.8 * out.scaled["q_dot"].half
    v = np.linspace(-reach, reach, 9)
    values = {"q": np.zeros(9), "q_dot": v}
    total = -damping * v + out.force(values, 0)[0]
    true = -TRUTH[B] * v - size * np.abs(v) * v
    # a constant is a force of the spring's rest, and no part of a drag
    np.testing.assert_allclose(total - total.mean(), true - true.mean(), atol=0.05 * np.abs(true).max())
    assert (out.force(values, 0)[1] >= 0).all()


LABELS = ParameterVector(spring()).labels


def test_nothing_is_found_where_nothing_is_missing() -> None:
    for seed in range(6):
        assert found(small_runs(rubbing(0.0), 3, 8.0, seed=seed)).groups == ()


def looped(
    count: int, seconds: float, *, force: Callable[[float, float], float], lag: float, seed: int
) -> list[Run]:
    """Springs that a controller holds by what it measures, sensor noise included."""
    rng, dt, fine = np.random.default_rng(seed), 0.02, 10
    out = []
    for number in range(count):
        n = round(seconds / dt) + 1
        q, v, acting, rows, inputs = 0.3, 0.0, 0.0, np.empty((n, 2)), np.empty((n, 1))
        aim, push = 0.0, 0.0
        for k in range(n):
            rows[k] = (q, v) + np.array(SENSOR) * rng.standard_normal(2)
            if k % 40 == 0:
                aim = rng.uniform(-0.5, 0.5)
            inputs[k] = 6.0 * (aim - rows[k, 0]) - 2.0 * rows[k, 1]
            push = np.exp(-dt / 0.4) * push + 0.05 * rng.standard_normal()
            for _ in range(fine):
                acting += (inputs[k, 0] - acting) * (min(dt / fine / lag, 1.0) if lag else 1.0)
                pull = TRUTH[G] * acting - TRUTH[K] * q - TRUTH[B] * v + push + force(q, v)
                v += dt / fine * pull
                q += dt / fine * v
        out.append(Run(f"run_{number}", 100.0 * number + dt * np.arange(n, dtype=np.float64), rows, inputs))
    return out


def test_what_a_controller_measured_is_no_function_of_the_state() -> None:
    """Forces at the end of a step would explain the sensor noise that the inputs of its end answer."""
    for seed in range(3):
        assert found(looped(3, 10.0, force=lambda q, v: 0.0, lag=0.0, seed=seed)).groups == ()


def test_a_lag_in_a_loop_is_the_past_of_the_inputs_and_no_force() -> None:
    out = found(looped(3, 10.0, force=lambda q, v: 0.0, lag=0.08, seed=1))
    assert {g.kind for g in out.groups} == {"past"}
    assert not out.nats
    assert out.lost[0] > 20.0


def test_a_product_of_two_variables_is_found_and_its_force_is_that_of_the_machine() -> None:
    out = found(looped(4, 12.0, force=lambda q, v: -2.0 * q * v, lag=0.0, seed=2))
    assert {g.variables for g in out.groups} == {("q", "q_dot")}
    before, after = out.blocks
    assert float((after - before).sum()) == pytest.approx(out.nats[0])
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-0.4, 0.4, 200), rng.uniform(-0.8, 0.8, 200)
    made, _ = out.force({"q": q, "q_dot": v}, 0)
    np.testing.assert_allclose(made, -2.0 * q * v, atol=0.05)


@pytest.mark.parametrize("sizes", [(1.0,), (1.0, 1.0, 1.0), (3.0, 1.0, 0.1, 0.01), (1.0,) * 200])
def test_chances_of_a_variance_are_right_where_weights_have_none(sizes: tuple[float, ...]) -> None:
    """Scores of functions of any sizes, more of them than there are draws too."""
    rng = np.random.default_rng(len(sizes))
    turn = np.linalg.qr(rng.normal(size=(len(sizes), len(sizes))))[0] * np.array(sizes)
    chances = []
    for _ in range(400):
        rows = rng.normal(size=(len(sizes), 1 + DRAWS))
        scores = (turn @ rows)[None]
        some = FunctionScores(scores[..., 0], scores[..., 1:], np.zeros(len(sizes)), DRAWS)
        chances.append(np.exp(log_chance(some)))
    for level in (0.05, 0.2, 0.5):
        error = (level * (1.0 - level) / len(chances)) ** 0.5
        assert np.mean(np.array(chances) < level) == pytest.approx(level, abs=4.0 * error + 0.15 * level)


def test_a_law_that_one_run_alone_shows_is_found() -> None:
    # run_0 moves a third further than the others, whose cubes say little of its
    values, effects = {"k": 4.0, "b": 0.5, "g": 1.0}, {"hardening": {"size": 0.8}}
    machine = replace(rubbing(0.0), values=values, effects=effects, noise=(0.001, 0.003))
    runs = []
    for k in range(4):
        t, x, u = run(machine, 12.0, 0.01, 7919 * 3 + k)
        runs.append(Run(f"run_{k}", 100.0 * k + t, x, u))
    assert np.ptp(runs[0].x[:, 0]) > 1.3 * max(np.ptp(r.x[:, 0]) for r in runs[1:])
    plain = make_system("mass_spring_damper")  # from its own first values disturbances learn most of the cube
    _, at = maximised(LogLikelihood(plain, runs))
    out = learned(at, seen_by_networks(plain), [0])
    assert {name for g in out.groups for name in g.variables} == {"q"}
    q = np.linspace(-1.0, 1.0, 9)
    force = out.force({"q": q, "q_dot": np.zeros(9)}, 0)[0] - out.theta[LABELS.index(K)] * q
    np.testing.assert_allclose(force, -4.0 * q - 0.8 * q**3, atol=0.1)
