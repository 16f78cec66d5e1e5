"""Functions chosen by held-out likelihood, on springs of a simulator of its own."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from nsde_torch.data import Run
from nsde_torch.inference import LogLikelihood, maximised
from nsde_torch.inference.functions import Functions, learned, seen_by_networks
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.helpers.machines import Array, held, simulated
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
    count: int, seconds: float, *, seed: int, force: Callable[[float, float], float] = lambda q, v: 0.0,
    lag: float = 0.0,
) -> list[Run]:  # fmt: skip
    """Springs that a controller holds by what it measures, sensor noise included."""
    rng, dt, out = np.random.default_rng(seed), 0.02, []

    def rates(x: Array, u: Array) -> list[float]:
        q, v, acting = x
        acting, rise = (acting, (u[0] - acting) / lag) if lag else (u[0], 0.0)
        return [v, TRUTH[G] * acting - TRUTH[K] * q - TRUTH[B] * v + u[1] + force(q, v), rise]

    for number in range(count):
        aim = held(rng, -0.5, 0.5, round(seconds / dt) + 1, each=40)
        push = lfilter([0.05], [1.0, -np.exp(-dt / 0.4)], rng.standard_normal(aim.shape), axis=0)
        run = simulated(
            number,
            rates,
            [0.3, 0.0, 0.0],
            np.hstack((aim, push)),
            dt,
            noise=(*SENSOR, 0.0),
            control=lambda row, seen: [6.0 * (row[0] - seen[0]) - 2.0 * seen[1], row[1]],
            rng=rng,
        )
        out.append(Run(run.name, run.t, run.x[:, :2], run.u[:, :1]))
    return out


def test_what_a_controller_measured_is_no_function_of_the_state() -> None:
    """Forces at the end of a step would explain the sensor noise that the inputs of its end answer."""
    for seed in range(3):
        assert found(looped(3, 10.0, seed=seed)).groups == ()


def test_a_lag_in_a_loop_is_the_past_of_the_inputs_and_no_force() -> None:
    out = found(looped(3, 10.0, lag=0.08, seed=1))
    assert {g.kind for g in out.groups} == {"past"}
    assert not out.nats
    assert out.lost[0] > 20.0


def test_a_product_of_two_variables_is_found_and_its_force_is_that_of_the_machine() -> None:
    out = found(looped(4, 12.0, force=lambda q, v: -2.0 * q * v, seed=2))
    assert {g.variables for g in out.groups} == {("q", "q_dot")}
    before, after = out.blocks
    assert float((after - before).sum()) == pytest.approx(out.nats[0])
    rng = np.random.default_rng(0)
    q, v = rng.uniform(-0.4, 0.4, 200), rng.uniform(-0.8, 0.8, 200)
    made, _ = out.force({"q": q, "q_dot": v}, 0)
    np.testing.assert_allclose(made, -2.0 * q * v, atol=0.05)


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
