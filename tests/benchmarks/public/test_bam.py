"""BAM: recordings in the layout of the set are read, simulated and scored; what was put into them is found."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nsde_benchmarks.public import bam, run_benchmark
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError

pytestmark = pytest.mark.drawn


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, diagnosed: Callable[..., list[RawRun]]) -> list[RawRun]:
    """The protocol, on the few short recordings of the tests; what is diagnosed is told by another."""
    found = {"coulomb_friction.size": {"value": 0.1, "interval_90": None, "unit": "N m"}}
    logs = diagnosed("coulomb_friction", parameters=found)
    tried = {name: bam.CANDIDATES[name] for name in ("input_delay", "coulomb_friction")}
    sizes = {"LOGS": {"training": 6, "validation": 2}, "ROWS": 90, "THINNED": 1, "DIAGNOSED": 3}
    for name, value in {**sizes, "ITERATIONS": (5, 3), "CANDIDATES": tried}.items():
        monkeypatch.setattr(bam, name, value)
    return logs


@pytest.mark.slow
def test_delay_and_dry_friction_of_a_servo_are_found(
    servo_folder: Path, tmp_path: Path, small: list[RawRun]
) -> None:
    content = run_benchmark("bam", servo_folder, out_dir=tmp_path)
    assert len(small) == 2
    assert small[0].x.shape == (45, 2)
    assert np.allclose(np.diff(small[0].t), 0.01)
    assert sorted(content["effects"]) == ["coulomb_friction", "input_delay"]
    values = {name: entry["value"] for name, entry in content["parameters"].items()}
    assert values["input_delay.delay"] == pytest.approx(0.03, abs=0.004)
    assert values["coulomb_friction.size"] == pytest.approx(0.1, rel=0.25)
    assert values["stall_torque"] == pytest.approx(8.0, rel=0.1)
    assert content["parameters"]["stall_torque"]["unit"] == "N m"
    *models, first, last = content["ours"].values()
    assert len(models) == 6
    assert content["found"][1].endswith("(effect_found): coulomb_friction.size 0.1 N m.")
    assert last["validation"] < 0.3 * min(first["validation"], models[0]["validation"])
    assert content["ratio_to_best_published"]["training"] == pytest.approx(last["training"] / 29.9)
    assert (tmp_path / "benchmark.png").stat().st_size > 10_000


@pytest.mark.usefixtures("small")
def test_folders_and_files_of_something_else_are_refused(servo_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no such folder|holds no data/feetech"):
        run_benchmark("bam", tmp_path / "none", out_dir=tmp_path / "out")
    (tmp_path / "newer").mkdir()
    with pytest.raises(DataError, match="at commit 140d9c5: newer ones hold the recordings in archives"):
        run_benchmark("bam", tmp_path / "newer", out_dir=tmp_path / "out")
    folder = tmp_path / "copy"
    shutil.copytree(servo_folder, folder)
    path = folder / bam.HOME / "processed" / "run0.json"
    whole = path.read_text()
    log = json.loads(whole)
    short = {**log, "entries": log["entries"][:50]}
    for text, message in (
        (whole[:-40], r"run0\.json is no recording of a servo, or is cut off"),
        (json.dumps(short), "run0.json has 50 rows, and the protocol needs 90"),
        (json.dumps({**log, "dt": 0.01}), r"run0.json has steps of 0.01 s"),
        (json.dumps({**log, "mass": None}), "run0.json is no recording of a servo"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=message):
            run_benchmark("bam", folder, out_dir=tmp_path / "out")
    path.unlink()
    with pytest.raises(DataError, match="holds 5 recordings and not 6"):
        run_benchmark("bam", folder, out_dir=tmp_path / "out")
    shutil.copy(servo_folder / bam.HOME / "processed" / "run0.json", path)
    (folder / bam.HOME / "friction_params" / "m3.json").write_text('{"kt": 1.0}')
    with pytest.raises(DataError, match=r"m3\.json lacks R, armature"):
        bam._parameters(folder / bam.HOME / "friction_params" / "m3.json")
