"""The example of two joints: its class, and what it can be asked."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nsde_torch.cli.main import main
from nsde_torch.systems import System, make_system
from tests.helpers.system_contract import SystemContract

HOME = "double_pendulum:DoublePendulum"


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "double_pendulum")


class TestDoublePendulum(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system(HOME, **options)

    def test_it_is_the_machine_of_the_simulator_that_shares_no_code_with_it(self, root: Path) -> None:
        maker = importlib.import_module("make_data")
        far = maker.MASS_2 * maker.LENGTH_1 * maker.CENTRE_2
        low = maker.INERTIA_2 + maker.MASS_2 * maker.CENTRE_2**2
        top = maker.INERTIA_1 + maker.MASS_1 * maker.CENTRE_1**2 + maker.MASS_2 * maker.LENGTH_1**2 + low
        weight = (maker.MASS_1 * maker.CENTRE_1 + maker.MASS_2 * maker.LENGTH_1) * maker.GRAVITY
        second = maker.MASS_2 * maker.GRAVITY * maker.CENTRE_2
        values = {"a": top, "b": far, "d": low, "g1": weight, "g2": second}
        system = self.make(values=values).double()
        x, u = self.states(20), self.inputs(20)
        rate = system.drift(0.0, x, u).detach().numpy()
        for row, pushed, found in zip(x.numpy(), u.numpy(), rate, strict=True):
            expected = maker.accelerations(row[:2], row[2:], pushed)
            np.testing.assert_allclose(found[2:], expected, rtol=1e-5, atol=1e-5)


def test_the_effects_of_the_machine_are_listed(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(root / "examples" / "double_pendulum")
    assert main(["effects", "system=double_pendulum", "--config-dir", folder]) == 0
    printed = capsys.readouterr().out
    assert "coulomb_friction[q1]" in printed
    assert "damping [N m s/rad]" in printed.replace("\n", " ")
