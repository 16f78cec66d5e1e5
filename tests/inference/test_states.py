"""States at given physics: what is not known of them is as large as their errors, whatever the physics lacks."""

from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.inference import LogLikelihood
from nsde_torch.inference.states import filtered_at
from nsde_torch.recording import assemble
from nsde_torch.systems import make_system
from tests.helpers.encoders import TRUTH, encoder_runs


@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_what_is_not_known_of_a_rate_is_as_large_as_its_error(friction: float) -> None:
    system = make_system("mass_spring_damper", values=TRUTH)
    data = assemble(encoder_runs("none", friction=friction, runs=2), system, kind="test")
    true = np.concatenate([run.x[:, 1] for run in encoder_runs("truth", friction=friction, runs=2)])
    found = filtered_at(LogLikelihood(system, data.runs, states=True))
    rate = np.concatenate([x[:, 1] for x in found.states(data.runs)])
    assert 0.7 < np.std(rate - true) / float(found.unknown()[1]) < 1.2
    assert float(found.square()[0]) == pytest.approx(1.0, abs=0.2)


def test_a_friction_narrower_than_all_speeds_is_widened() -> None:
    narrow = {**TRUTH, "coulomb_friction.size": 0.2, "coulomb_friction.width": 1e-5}
    system = make_system("mass_spring_damper", effects=["coulomb_friction"], values=narrow)
    data = assemble(encoder_runs("none", runs=2), system, kind="test")
    found = filtered_at(LogLikelihood(system, data.runs, states=True))
    assert np.isfinite(found.at.total)


def test_rows_that_no_stretch_holds_stay_as_they_were_read() -> None:
    system = make_system("mass_spring_damper", values=TRUTH)
    (run,) = assemble(encoder_runs("none", runs=1), system, kind="test").runs
    whole = filtered_at(LogLikelihood(system, [run], states=True)).states([run])[0]
    parts = replace(run, segments=((0, 700), (710, len(run))))
    (found,) = filtered_at(LogLikelihood(system, [parts], states=True)).states([parts])
    np.testing.assert_array_equal(found[700:710], run.x[700:710])
    assert np.abs(found[:700] - whole[:700]).max() < 0.02
    assert np.abs(found[900:] - whole[900:]).max() < 0.02
