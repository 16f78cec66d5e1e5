"""examples/body_rates: a Betaflight log, which has rates and motors alone, to a fitted machine."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.systems import System, make_system
from tests.helpers.log_writers import write_betaflight
from tests.helpers.system_contract import SystemContract

GAINS = (120.0, 90.0, -12.0)
COUPLING = (-0.3, 0.4, -0.05)


@pytest.fixture(scope="module", autouse=True)
def _beside(root: Path) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(root / "examples" / "body_rates"))
        yield


class TestBodyRates(SystemContract):
    def make(self, **options: Any) -> System:
        return make_system("body_rates:BodyRates", **options)


def _flown(seed: int) -> RawRun:
    """20 s at 100 Hz of rates under motor commands that know nothing of them, by small Euler steps."""
    rng = np.random.default_rng(seed)
    signs = np.array([[-1.0, 1, 1, -1], [-1, 1, -1, 1], [-1, -1, 1, 1]])
    w, rows, inputs = np.zeros(3), [], []
    command = np.zeros(3)
    for k in range(2000):
        if k % 15 == 0:
            command = rng.uniform(-0.02, 0.02, 3) * [1, 1, 4] - 0.002 * w
        u = 0.4 + 0.25 * signs.T @ command
        rows.append(w.copy())
        inputs.append(u)
        for _ in range(20):
            turn = signs @ u * GAINS - 1.5 * w + np.array(COUPLING) * w[[1, 2, 0]] * w[[2, 0, 1]]
            w = w + 5e-4 * turn
    x = np.zeros((2000, 13))
    x[:, 10:] = rows
    x[:, 10:] += rng.normal(0.0, 0.01, (2000, 3))
    return RawRun(f"run_{seed}", 0.01 * np.arange(2000), x, np.array(inputs))


@pytest.mark.slow
def test_a_betaflight_log_gives_the_gains_back(tmp_path: Path) -> None:
    pytest.importorskip("orangebox")
    for seed in range(3):
        write_betaflight(tmp_path / f"run_{seed}.bbl", _flown(seed))
    system = "body_rates:BodyRates"
    found = nsde_torch.inspect(tmp_path, system=system)
    assert found.usable
    assert found.kind == "betaflight"
    data = nsde_torch.read(tmp_path, system=system, kind="log")
    model = nsde_torch.train(data, system=system, model="sysid")
    gains = [float(model.system.value(f"{axis}_gain")) for axis in ("roll", "pitch", "yaw")]
    np.testing.assert_allclose(gains, GAINS, rtol=0.05)
    assert [run.name for run in data.runs] == ["run_0", "run_1", "run_2"]
