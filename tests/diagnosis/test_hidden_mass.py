"""What swings and is not in the log, on a machine or between its command and it, has its name and its sizes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.inference import fit
from nsde_torch.systems.options import system_options
from tests.helpers.machines import Array, simulated

DT = 0.02


def absorber(seed: int, *, hidden: float, hertz: float, ratio: float, seconds: float = 25.0) -> list[RawRun]:
    """Runs of a spring (4 1/s2, damping 0.4 1/s) that carries a second one, of the equations of both masses."""
    rng, out, w = np.random.default_rng(seed), list[RawRun](), 2.0 * np.pi * hertz
    t = DT * np.arange(round(seconds / DT))

    def rates(x: Array, u: Array) -> list[float]:
        held = w * w * (x[2] - x[0]) + 2.0 * ratio * w * (x[3] - x[1])
        return [x[1], u[0] - 4.0 * x[0] - 0.4 * x[1] + hidden * held, x[3], -held]

    for r in range(3):
        waves, phase = rng.uniform(0.1, 2.0, 6), rng.uniform(0.0, 6.3, 6)
        u = 0.5 * np.sin(2.0 * np.pi * waves * t[:, None] + phase).sum(1, keepdims=True)
        run = simulated(r, rates, np.zeros(4), u, DT, noise=(0.001, 0.005, 0.0, 0.0), rng=rng)
        out.append(replace(run, x=run.x[:, :2]))
    return out


def test_noise_of_the_sensors_does_not_bias_a_hidden_mass_that_forces_hardly_move() -> None:
    # memory along measured velocities made 0.135 (0.115 to 0.154) of it, at 2.52 Hz
    true = {"mass": 0.195, "frequency": 2.71, "damping": 0.0585}
    runs = absorber(1, hidden=true["mass"], hertz=true["frequency"], ratio=true["damping"])
    values = {"force_gain": 1.0, "linear_spring.stiffness": 4.0, "viscous_friction.damping": 0.4}
    options = system_options("mass_spring_damper", effects=[{"hidden_mass": true}], parameters=values)
    system = options.make()
    found = fit(system, nsde_torch.read(runs, system=system).runs)
    expected = np.array([*values.values(), *true.values()])
    assert np.all(np.abs(found.theta - expected) < 3.0 * found.standard_errors)
    assert found.standard_errors[3] < 0.02


def behind_a_servo(seed: int, hertz: float, ratio: float) -> list[RawRun]:
    """Runs of a spring (4 1/s2, damping 0.5 1/s) whose command is followed in second order, from rest at 0; exact."""
    rng, out, w = np.random.default_rng(seed), list[RawRun](), 2.0 * np.pi * hertz
    t = DT * np.arange(750)
    rates = np.zeros((5, 5))  # of q, q', what acts, its rate and the command
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, :3], rates[3, 2:] = [-4.0, -0.5, 1.0], [-w * w, -2.0 * ratio * w, w * w]
    over = expm(DT * rates)[:4]
    for r in range(2):
        size, waves = rng.uniform(0.5, 2.0, 5), np.exp(rng.uniform(-2.3, 1.4, 5))
        u = np.sin(2.0 * np.pi * waves * t[:, None] + rng.uniform(0.0, 6.3, 5)) @ size
        z, x = np.array([*rng.uniform(-0.3, 0.3, 2), 0.0, 0.0]), np.empty((len(t), 2))
        for k, command in enumerate(u):
            x[k] = z[:2]
            z = over @ np.append(z, command)
        out.append(
            RawRun(f"run_{r}", t + 20.0 * r, x + rng.normal(size=x.shape) * [0.001, 0.003], u[:, None])
        )
    return out


# of the slow one the fit without it takes the input for nothing
@pytest.mark.parametrize(("hertz", "ratio"), [pytest.param(3.0, 0.3, marks=pytest.mark.slow), (1.5, 0.1)])
def test_a_servo_that_swings_is_found_alone(hertz: float, ratio: float) -> None:
    found = nsde_torch.diagnose(behind_a_servo(9, hertz, ratio), system="mass_spring_damper", say=False)
    assert (found.added, [f["lead"] for f in found.content()["findings"]]) == (
        ["actuator_resonance"],
        [False],
    )
    parameters = found.content()["parameters"]
    for key, true in (("period", 1.0 / hertz), ("damping", ratio)):
        value = parameters[f"actuator_resonance.{key}"]
        low, high = value["interval_90"]
        assert abs(value["value"] - true) < 1.5 * (high - low) < 0.03 * true
