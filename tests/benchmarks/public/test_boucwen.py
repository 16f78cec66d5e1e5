"""Bouc-Wen: the law with free weights is found from a noisy multisine in the layout of the set."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import savemat

from nsde_benchmarks.public import boucwen, run_benchmark
from nsde_torch.errors import DataError

pytestmark = pytest.mark.drawn

Array = NDArray[np.float64]

FINE = 10  # steps of the truth in a sample
STIFF, TOWARDS, AWAY = 2.5e4, 800.0, -1100.0


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The protocol, on signals of a few periods."""
    sizes = {"PERIOD": 256, "PERIODS": 2, "SWEEP": 300, "WINDOW": 63, "ITERATIONS": 14}
    for name, value in sizes.items():
        monkeypatch.setattr(boucwen, name, value)


def multisine(seed: int, count: int) -> Array:
    """A periodic force (count * FINE,) between 15 and 60 Hz, on the grid of the truth."""
    rng = np.random.default_rng(seed)
    lines = np.arange(round(15 * count / 750), round(60 * count / 750) + 1)
    turn = 2 * np.pi * np.arange(count * FINE) / (count * FINE)
    force: Array = sum(14.0 * np.cos(k * turn + rng.uniform(0, 6)) for k in lines)
    return force


def truth(force: Array) -> Array:
    """Positions at 750 Hz of a mass with hysteresis, by small semi-implicit steps."""
    y = v = z = 0.0
    h = boucwen.STEP / FINE
    out = np.empty(len(force))
    for k, u in enumerate(force):
        out[k] = y
        v += h * (0.5 * u - 25.0 * v - STIFF * y - z)
        y += h * v
        z += h * (STIFF * v - TOWARDS * abs(v) * z - AWAY * v * abs(z))
    return out[::FINE]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("boucwen")
    rng = np.random.default_rng(0)
    force = multisine(1, 256)
    y = truth(np.tile(force, 5))[3 * 256 :]
    test = multisine(2, 256)
    sweep = multisine(3, 300)
    for name, key, values in (
        ("uest_multisine", "u", np.tile(force[::FINE], 2)),
        ("yest_multisine", "y", y + 3e-6 * rng.standard_normal(len(y))),
        ("uval_multisine", "uval_multisine", test[::FINE]),
        ("yval_multisine", "yval_multisine", truth(np.tile(test, 2))[256:]),
        ("uval_sinesweep", "uval_sinesweep", sweep[::FINE]),
        ("yval_sinesweep", "yval_sinesweep", truth(sweep)),
    ):
        savemat(out / f"{name}.mat", {key: values[None]})
    return out


@pytest.mark.slow
def test_the_weights_of_a_hysteresis_are_found(folder: Path, tmp_path: Path) -> None:
    content = run_benchmark("boucwen", folder, out_dir=tmp_path)
    linear, equal, free = content["ours"].values()
    for test in ("multisine", "sinesweep"):
        assert free[test] < 0.25 * min(linear[test], equal[test])
    values = {name: entry["value"] for name, entry in content["parameters"].items()}
    assert values["free_hysteresis.stiffness"] == pytest.approx(STIFF, rel=0.1)
    assert values["free_hysteresis.towards"] == pytest.approx(TOWARDS, rel=0.15)
    assert values["free_hysteresis.away"] == pytest.approx(AWAY, rel=0.15)
    assert content["ratio_to_best_published"] == {"multisine": pytest.approx(free["multisine"] / 0.753)}
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000


def test_a_short_test_is_refused(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    savemat(tmp_path / "yval_sinesweep.mat", {"yval_sinesweep": np.zeros((1, 100))})
    with pytest.raises(DataError, match=r"yval_sinesweep\.mat has 100 rows, and the protocol needs 300"):
        run_benchmark("boucwen", tmp_path, out_dir=tmp_path / "out")
