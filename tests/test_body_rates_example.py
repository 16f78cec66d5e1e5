"""examples/body_rates: a Betaflight log, which has rates and motors alone, to a fitted machine."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nsde_torch
from nsde_torch.data.raw import RawRun
from nsde_torch.systems import System, make_system
from tests.helpers.log_writers import write_betaflight
from tests.helpers.machines import Array, simulated
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
    """20 s at 100 Hz of rates under motor commands that know nothing of them."""
    rng = np.random.default_rng(seed)
    signs = np.array([[-1.0, 1, 1, -1], [-1, 1, -1, 1], [-1, -1, 1, 1]])

    def rates(w: Array, u: Array) -> Array:
        return signs @ u * GAINS - 1.5 * w + np.array(COUPLING) * w[[1, 2, 0]] * w[[2, 0, 1]]

    command = np.repeat(rng.uniform(-0.02, 0.02, (134, 3)) * [1, 1, 4], 15, axis=0)[:2000]
    run = simulated(seed, rates, np.zeros(3), 0.4 + 0.25 * command @ signs, 0.01, noise=0.01, rng=rng)
    return RawRun(run.name, 0.01 * np.arange(2000), np.pad(run.x, ((0, 0), (10, 0))), run.u)


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
