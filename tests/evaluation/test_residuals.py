"""What a model's steps leave, with forces that are not declared."""

from collections.abc import Mapping

import pytest
import torch

from nsde_torch.effects import Port
from nsde_torch.inference.steps import steps_of
from nsde_torch.sysid.physics import Physics
from nsde_torch.systems import make_system
from nsde_torch.systems.parameters import ParameterVector
from tests.inference.springs import rubbing, small_runs


def test_a_force_beside_physics_leaves_what_the_declared_law_leaves() -> None:
    runs = small_runs(rubbing(0.2), 2, 6.0, seed=3)
    values = {"quadratic_damping.damping": 3.0}

    def physics(*effects: str) -> Physics:
        system = make_system("mass_spring_damper", effects=list(effects), values=values if effects else {})
        return Physics(ParameterVector(system), steps_of(system, runs, clock=1.0, smooth=False))

    def law(x: torch.Tensor) -> Mapping[Port, torch.Tensor]:
        return {Port.FORCE: -3.0 * x[:, 1:] * x[:, 1:].abs()}

    declared, plain = physics("quadratic_damping"), physics()
    beside = plain.beside(law)
    theta, own = declared.vector.start, plain.vector.start
    assert beside.residual(own) == pytest.approx(declared.residual(theta), abs=1e-12)
    assert beside.middle(own).numpy() == pytest.approx(declared.middle(theta).numpy(), abs=1e-12)
    # where networks would be asked instead
    assert abs(plain.middle(own) - declared.middle(theta)).max() > 0.05
