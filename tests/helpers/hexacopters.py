"""Machines for tests of the controller and of its exports: declared physics, and a neural SDE that nobody trained."""

import pytest
import torch

from nsde_torch.control.reference import Reference
from nsde_torch.control.shapes import lemniscate
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.systems import System, make_plant_system

VALUES = {"thrust_gain": 4.6, "thrust_offset": -1.0, "roll_gain": 80.0, "pitch_gain": 80.0, "yaw_gain": 3.4}


@pytest.fixture(scope="session")
def declared() -> System:
    """The declared physics with the values of the plant."""
    return make_plant_system("hexacopter", declared_only=True)


@pytest.fixture(scope="session")
def model() -> NeuralSDE:
    """A neural SDE with residuals of a few tenths of m/s2."""
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein", disturbance=True)
    made = NeuralSDE(spec, generator=torch.Generator().manual_seed(0), values=VALUES)
    made.residual_inputs.scale.fill_(2.0)
    made.residual_inputs.mean.fill_(0.1)
    return made.eval().requires_grad_(False)


@pytest.fixture(scope="session")
def path() -> Reference:
    return Reference(lemniscate())
