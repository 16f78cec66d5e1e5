"""Memory of effects along measured runs: that of one long integration, segment by segment; and its steps."""

from typing import Any

import numpy as np
import pytest
import torch

from nsde_torch.data import Run
from nsde_torch.effects.actuators import ActuatorLag
from nsde_torch.inference.steps import Steps, memory_along, steps_of
from nsde_torch.sysid.physics import Physics
from nsde_torch.systems import System, make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.helpers.diagnosed import recorded

DT, TAU = 0.01, 0.05
TIMES = {"input_delay": "delay", "motor_lag": "time_constant", "actuator_lag": "time_constant"}


def made(machine: str, *effects: Any, **values: float) -> System:
    """In double precision; values are of the effects' times."""
    named = {f"{k}.{TIMES[k]}": v for k, v in values.items()}
    return make_system(machine, effects=effects, values=named).double()


@torch.no_grad()
def along(system: System, run: Run) -> tuple[Steps, torch.Tensor, torch.Tensor]:
    steps = steps_of(system, [run], clock=1.0, smooth=False)
    return steps, *memory_along(system, steps)


def test_it_is_the_exact_mean_response_of_each_segment_from_rest_at_its_first_input() -> None:
    rng, n, t = np.random.default_rng(0), 700, DT * np.arange(700)
    x = np.zeros((n, 13))
    x[:, 6], x[:, 0] = 1.0, t  # a log in which nothing moves is refused
    t[300:] += 3.0
    run = Run("r", t, x, 0.4 + 0.1 * rng.normal(size=(n, 6)), segments=((0, 300), (300, n)))
    _, before, after = along(made("hexacopter", "motor_lag", motor_lag=TAU), run)
    fade = np.exp(-DT / TAU)
    expected = []
    for a, b in run.segments:
        m, rows = run.u[a], []
        for k in range(a, b - 1):
            rows.append(run.u[k] + (m - run.u[k]) * (1 - fade) * TAU / DT)
            m = run.u[k] + (m - run.u[k]) * fade
        lead = min(40, (b - 1 - a) // 10)  # the run-in: 0.4 s or a tenth
        expected += rows[lead:]
    np.testing.assert_allclose(before, expected, atol=1e-6)
    np.testing.assert_array_equal(before, after)


def test_a_delay_of_held_inputs_is_exact_at_every_length() -> None:
    """The mean over each step of what arrives, whatever share of a step the delay is."""
    rng = np.random.default_rng(3)
    n, fine = 400, 20
    u = rng.normal(size=(n, 1))
    run = Run("r", DT * np.arange(n), rng.normal(size=(n, 4)), u)
    for delay in (0.3 * DT, DT, 3.65 * DT):
        system = made("cartpole", "input_delay", input_delay=delay)
        steps, before, after = along(system, run)
        found = steps.u + system.effects[0](0.0, steps.x0, steps.u, before).detach()
        late = np.repeat(u[:, 0], fine)[np.maximum(np.arange(n * fine) - round(delay / DT * fine), 0)]
        expected = late.reshape(n, fine).mean(1)[: n - 1]
        np.testing.assert_allclose(found[:, 0], expected[-len(steps) :], atol=1e-6)
        torch.testing.assert_close(before, after)


def test_a_lag_follows_what_a_delay_lets_through() -> None:
    rng = np.random.default_rng(4)
    u = 0.4 + 0.1 * rng.normal(size=(500, 6))
    x = np.zeros((500, 13))
    x[:, 6] = 1.0
    x[:, 0] = DT * np.arange(500)
    late = np.concatenate((np.repeat(u[:1], 3, axis=0), u[:-3]))
    both = made("hexacopter", "motor_lag", "input_delay", motor_lag=TAU, input_delay=3 * DT)
    alone = made("hexacopter", "motor_lag", motor_lag=TAU)
    first, second = (along(s, Run("r", DT * np.arange(500), x, w))[1] for s, w in ((both, u), (alone, late)))
    torch.testing.assert_close(first[:, :6], second)


class Unknowing(ActuatorLag):
    """A lag that does not say what it makes of held inputs."""

    name = "drift"

    def held(self, u: torch.Tensor, dt: float) -> None:  # type: ignore[override]
        return None


@pytest.mark.parametrize("names", [["drift", "actuator_lag"], ["actuator_lag", "drift"]])
def test_memory_that_nobody_knows_exactly_is_integrated_with_what_is_known_held(names: list[str]) -> None:
    """A lag that says nothing of held inputs, before or after one that does."""
    rng = np.random.default_rng(5)
    u, x = rng.normal(size=(300, 1)), rng.normal(size=(300, 4))
    own = Unknowing({"time_constant": 0.3}, n_inputs=1)
    own.stage = {"drift": 1, "actuator_lag": 3}[names[0]]  # type: ignore[misc]
    system = made("cartpole", "actuator_lag", own, actuator_lag=0.3)
    steps, before, _ = along(system, Run("r", DT * np.arange(300), x, u))
    # both orders of two equal lags give the same in the end, to the accuracy of a mean over a step
    last = before[:, 1] if names[0] == "actuator_lag" else before[:, 0]
    m = np.zeros((300, 2))
    fade = np.exp(-DT / 0.3)
    m[0] = u[0, 0]
    for k in range(299):
        m[k + 1, 0] = u[k, 0] + (m[k, 0] - u[k, 0]) * fade
        m[k + 1, 1] = m[k, 0] + (m[k, 1] - m[k, 0]) * fade
    np.testing.assert_allclose(last, m[-1 - len(steps) : -1, 1], atol=0.02)


def test_a_load_that_runs_away_leaves_numbers() -> None:
    """Where thrust is fitted as a pull a load has no place that it returns to, and none that it starts from."""
    data = recorded("hexacopter", durations=(6.0,), dt=0.02, plant={"rounds": 1})
    vector = ParameterVector(make_system("hexacopter", effects=["slung_load"]))
    physics = Physics(vector, steps_of(vector.system, data.runs, clock=1.0))
    theta = vector.start.copy()
    for label, value in (
        ("thrust_offset", -60.0),
        ("slung_load.length", 0.002),
        ("slung_load.damping", 0.02),
    ):
        theta[vector.labels.index(label)] = value
    assert np.isfinite(physics.residual(theta)).all()
