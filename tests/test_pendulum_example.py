"""The example of a machine of one's own does what its README says, as the commands that it shows."""

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import nsde_torch
from nsde_torch.recording import read
from nsde_torch.systems import System, make_system
from tests.helpers.system_contract import SystemContract


@pytest.fixture(autouse=True)
def _importable(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "pendulum")


class TestPendulum(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system("pendulum:Pendulum", **options)

    def twin(self, x: Tensor) -> Tensor:
        return x + torch.tensor([2 * math.pi, 0.0], dtype=x.dtype)

    def test_it_obeys_its_equation(self) -> None:
        s = self.make(values={"gravity": 20.0, "damping": 0.3, "torque_gain": 8.0})
        rate = s.drift(0.0, torch.tensor([[math.pi / 6, 2.0]]), torch.tensor([[0.5]])).detach()
        torch.testing.assert_close(rate, torch.tensor([[2.0, -10.0 - 0.6 + 4.0]]))


def run(words: list[str], folder: Path) -> str:
    how = {"cwd": folder, "env": {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}, "timeout": 280}
    done = subprocess.run(words, capture_output=True, text=True, check=False, **how)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def data_folder(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pendulum")
    script = root / "examples" / "pendulum" / "make_data.py"
    run([sys.executable, str(script), "data", "--seconds", "20"], folder)
    return folder / "data"


def test_the_data_are_read_without_a_complaint(data_folder: Path) -> None:
    data = read("csv", make_system("pendulum:Pendulum"), path=str(data_folder))
    assert data.names == ("run_0", "run_1", "run_2")
    assert (data.dt, data.clock_scale) == (pytest.approx(0.01), 1.0)
    assert [f.kind for f in data.summary.findings] == []
    x = np.concatenate([r.x for r in data.runs])
    assert np.abs(x[:, 0]).max() > 1.0  # the swings are large enough to show sin theta


@pytest.mark.slow
def test_the_command_of_the_readme_trains_it_and_the_model_loads(
    root: Path, data_folder: Path, tmp_path: Path
) -> None:
    example = root / "examples" / "pendulum"
    words = ["--config-dir", str(example), "system=pendulum", "data=csv", f"data.path={data_folder}"]
    command = [sys.executable, "-m", "nsde_torch.cli", "train", *words]
    run([*command, "trainer=fast", "threads=1", "run_dir=out"], tmp_path)
    model = nsde_torch.load(tmp_path / "out")
    paths = model.sample(
        torch.tensor([[0.5, 0.0]]), torch.zeros(1, 25, 1), dt=0.02, particles=8, generator=torch.Generator()
    )
    assert bool(torch.isfinite(paths).all())
