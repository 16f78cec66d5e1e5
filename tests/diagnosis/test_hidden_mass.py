"""A second mass that is not in the log, behind the noise of the sensors, has its sizes.

A servo that swings: test_own_machines.py.
"""

from dataclasses import replace

import numpy as np

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
