"""The example of two joints: its class, and frictions that a simulator of its own put into each joint."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.systems import System, make_system
from tests.helpers.system_contract import SystemContract

HOME = "double_pendulum:DoublePendulum"
LAWS = ["coulomb_friction", "viscous_friction", "constant_force"]


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


def logs(folder: Path, dry: tuple[float, float], viscous: tuple[float, float]) -> Path:
    maker = importlib.import_module("make_data")
    maker.write(folder, maker.friction(np.array(dry), np.array(viscous)), seed=11, runs=3, seconds=8.0)
    return folder


@pytest.mark.parametrize(
    ("dry", "viscous", "named"),
    [
        ((0.12, 0.06), (0.0, 0.0), {"coulomb_friction[q1].size": 0.12, "coulomb_friction[q2].size": 0.06}),
        ((0.0, 0.05), (0.04, 0.0), {"viscous_friction[q1].damping": 0.04, "coulomb_friction[q2].size": 0.05}),
        ((0.0, 0.0), (0.0, 0.0), {}),
    ],
    ids=["dry in both", "viscous and dry", "nothing"],
)
@pytest.mark.slow
def test_frictions_are_named_with_their_joint_and_their_size(
    dry: tuple[float, float], viscous: tuple[float, float], named: dict[str, float], tmp_path: Path
) -> None:
    data = nsde_torch.read(logs(tmp_path / "data", dry, viscous), system=HOME)
    found = nsde_torch.diagnose(data, system=HOME, candidates=LAWS)
    assert set(found.added) == {name.partition(".")[0] for name in named}
    for name, value in named.items():
        entry = found.parameters[name]
        low, high = entry["interval_90"]
        assert abs(entry["value"] - value) < high - low + 0.03 * value, name
        assert entry["unit"] == ("N m" if name.endswith("size") else "N m s/rad")


def test_the_effects_of_the_machine_are_listed(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(root / "examples" / "double_pendulum")
    assert main(["effects", "system=double_pendulum", "--config-dir", folder]) == 0
    printed = capsys.readouterr().out
    assert "coulomb_friction[q1]" in printed
    assert "damping [N m s/rad]" in printed.replace("\n", " ")
