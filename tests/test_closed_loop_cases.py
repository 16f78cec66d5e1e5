"""The simulator of the closed-loop cases does what physics says, and its files say nothing."""

from dataclasses import replace
from typing import Any

import loop_machine
import numpy as np
import pytest


def machine(system: str = "hexacopter", **effects: Any) -> Any:
    return loop_machine.Machine(system, 4.6, -1.0, (108.0, 100.0, 3.5), (0.54, 0.6), effects)


def fall(machines: list[Any], seconds: float, u: float = 0.0, step: float = 0.001, **start: Any) -> Any:
    """Bodies after some time under held commands, a share of hover."""
    made = loop_machine.Bodies(machines, np.zeros(len(machines)), step=step)
    for name, value in start.items():
        setattr(made, name, np.tile(np.asarray(value, dtype=float), (len(machines), 1)))
    commands = made.m * u
    made.m, made.past = commands.copy(), np.repeat(commands[None], len(made.past), axis=0)
    for _ in range(round(seconds / step)):
        made.advance(commands)
    return made


@pytest.mark.parametrize("system", ["hexacopter", "quadrotor"])
def test_it_falls_freely_and_hovers(system: str) -> None:
    free = replace(machine(system), thrust_offset=0.0)
    dropped = fall([free], 1.0, step=0.01)
    np.testing.assert_allclose(dropped.p[0], [0, 0, -0.5 * 9.81], atol=1e-9)
    np.testing.assert_allclose(dropped.v[0], [0, 0, -9.81], atol=1e-9)
    still = fall([machine(system)], 2.0, 1.0, 0.01)
    np.testing.assert_allclose(np.concatenate([still.p[0], still.v[0], still.w[0]]), 0.0, atol=1e-9)


def test_a_tumbling_body_keeps_its_momentum_its_energy_and_a_unit_quaternion() -> None:
    coupled = machine(inertia_coupling={"product": [0.05, -0.08, 0.1]})
    askew = replace(coupled, thrust_offset=0.0, gains=(0.0,) * 3)
    start = np.array([3.0, -2.0, 5.0])
    made = fall([askew], 1.0, step=0.002, w=start)
    np.testing.assert_allclose(np.linalg.norm(made.q[0]), 1.0, atol=1e-12)
    j = made.inertia[0]
    np.testing.assert_allclose(made.w[0] @ j @ made.w[0], start @ j @ start, rtol=1e-9)
    np.testing.assert_allclose(loop_machine.rotation(made.q)[0] @ j @ made.w[0], j @ start, atol=1e-8)
    assert np.abs(made.w[0] - start).max() > 1.0  # it does tumble


def test_lag_and_delay_are_as_in_closed_form() -> None:
    lag, late = machine(motor_lag={"time_constant": 0.05}), machine(input_delay={"delay": 0.02})
    made = loop_machine.Bodies([lag, late], np.zeros(2))
    hover = made.m.copy()
    for _ in range(30):
        made.advance(1.2 * hover)
    rise = made.v[:, 2] / (0.2 * (9.81 + 1.0))  # time that the step has acted
    np.testing.assert_allclose(rise, [0.03 - 0.05 * (1 - np.exp(-0.03 / 0.05)), 0.01], rtol=1e-6)
