"""What training takes residuals from: rows in which a machine with dry friction moves."""

from __future__ import annotations

import numpy as np

from nsde_torch.models.neural_sde import SDESpec
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from nsde_torch.training.fit_innovations import identified
from tests.helpers.encoders import encoder_runs


def test_rows_at_a_standstill_teach_no_noise() -> None:
    effects = ("coulomb_friction",)
    runs = encoder_runs("sensor", friction=0.8, runs=2, seconds=10.0, gust=0.0)
    data = assemble(runs, make_system("mass_spring_damper", effects=list(effects)), kind="test")
    spec = SDESpec(
        "mass_spring_damper", dt=data.dt, horizon=10, effects=effects, step="heun", learn_lag=False
    )
    physics = identified(spec, data.runs, clock=1.0, values={}).regression.physics
    rows = sum(len(run) for run in data.runs)
    assert 0.2 * rows < len(physics.steps) < 0.95 * rows
    slow = np.abs(physics.steps.x0[:, 1].numpy()) < 0.005
    assert slow.mean() < 0.02
