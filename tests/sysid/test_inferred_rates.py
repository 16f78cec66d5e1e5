"""Rates that no sensor measured, inferred with physics."""

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from nsde_torch.sysid.identify import with_rates
from nsde_torch.systems import make_system
from tests.helpers.encoders import TRUTH, encoder_runs


def test_rates_with_physics_are_nearer_than_those_without() -> None:
    values = {**TRUTH, "coulomb_friction.size": 0.2, "coulomb_friction.width": 0.01}
    system = make_system("mass_spring_damper", effects=["coulomb_friction"], values=values)
    raw = encoder_runs("none", noise=5e-3)
    data = assemble(raw, system, kind="test")
    true = np.concatenate([run.x[:, 1] for run in encoder_runs("truth")])
    before, after = (
        np.concatenate([run.x[:, 1] for run in runs]) for runs in (data.runs, with_rates(system, data.runs))
    )
    assert np.std(after - true) < 0.7 * np.std(before - true)


def test_rates_that_diverge_between_rows_are_refused_with_what_to_record() -> None:
    values = {"cubic_stiffness.stiffness": 400.0}
    stiff = make_system("mass_spring_damper", effects=["cubic_stiffness"], values=values)
    t = 0.5 * np.arange(60)
    run = Run("r", t, np.stack([np.sin(t), np.cos(t)], 1), np.zeros((60, 1)), inferred={"q_dot": 0.1})
    with pytest.raises(DataError, match=r"q_dot cannot be inferred from q: over steps of 0\.5 s .* diverges"):
        with_rates(stiff, [run])
