"""`nsde train` from the command line to a run directory that another process can use, on every kind of input."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import nsde_torch
from nsde_torch.cli.main import main
from nsde_torch.systems import make_system

pytestmark = pytest.mark.drawn

FAST = (
    *("trainer=fast", "trainer.steps=6", "trainer.polish=2", "trainer.batch=16", "trainer.validate_every=3"),
    *("trainer.checkpoint_every=2", "trainer.compile=off", "loss.points=16", "threads=1"),
)
SPRING = ("system=mass_spring_damper", "data=csv", "system.dt=0.05", "system.horizon=10")
KEYS = {
    *("best_step", "calibration", "clock_scale", "data_fingerprint", "input_filter", "loss", "loss_options"),
    *("parameters", "seconds", "seed", "steps", "system", "test_runs", "train_runs", "trainer_options"),
    "validation",
}
TEST_KEYS = {
    *("coverage", "coverage_channels", "crps", "diverged", "errors", "horizons_s", "particles", "spread"),
    *("starts", "units"),
}
PICTURES = {"data_summary", "distance", "learning_curves"}
TEST_PICTURES = {"calibration", "held_out_errors", "held_out_rollouts"}
PNG = b"\x89PNG\r\n\x1a\n"


def numbers(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of a JSON value with their places."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from numbers(item, f"{path}.{key}")
    elif isinstance(value, list):
        for k, item in enumerate(value):
            yield from numbers(item, f"{path}[{k}]")
    elif isinstance(value, int | float):
        yield path, float(value)


def check(folder: Path, system: str) -> dict[str, Any]:
    """What every run directory must hold; returns metrics.json."""
    text = (folder / "metrics.json").read_text()
    metrics: dict[str, Any] = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} in metrics"))
    assert set(metrics) >= KEYS
    assert all(math.isfinite(value) for _, value in numbers(metrics))
    assert metrics["system"] == system
    assert metrics["seconds"]["total"] > 0
    machine = make_system(system)
    for name in machine.all_declared():
        found = metrics["parameters"][name]
        assert len(found["value"]) == len(found["half_width_90"])
        assert found["unit"]
    test = metrics["test"]
    assert set(test) >= TEST_KEYS
    groups = [g.name for g in machine.error_groups]
    horizons = [f"{h:g}" for h in test["horizons_s"]]
    assert set(test["coverage"]) >= {"0.5", "0.9", "0.95"}
    for table in (*test["errors"].values(), *test["coverage"].values(), test["crps"]):
        assert list(table) == groups
        assert all(list(row) == horizons for row in table.values())
    assert set(test["errors"]) == {"model", "hold", "constant_velocity"}
    assert all(0 <= share <= 1 for _, share in numbers(test["coverage"]))
    assert test["diverged"] == 0
    assert not set(metrics["train_runs"]) & set(metrics["test_runs"])
    pictures = {file.stem for file in (folder / "plots").iterdir()}
    assert pictures == PICTURES | TEST_PICTURES
    for file in (folder / "plots").iterdir():
        assert file.read_bytes()[:8] == PNG
        assert file.stat().st_size > 5_000
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["config"]["system"]["name"] == system
    assert list((folder / "tensorboard").rglob("events*"))
    json.loads((folder / "data_summary.json").read_text())
    for file in folder.rglob("*"):
        assert file.suffix not in (".pt", ".pth", ".pkl", ".pickle", ".npy", ".npz")
        start = file.read_bytes()[:2] if file.is_file() else b""
        assert start not in (b"PK", b"\x80\x02", b"\x80\x04", b"\x80\x05"), file
    model = nsde_torch.load(folder)
    assert model.spec.system == system
    return metrics


def train(folder: Path, *words: str) -> Path:
    assert main(["train", *FAST, f"run_dir={folder}", *words]) == 0
    return folder


@pytest.mark.slow
def test_hexacopter_with_a_further_effect_and_a_second_process_that_loads_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["system=hexacopter", "data.durations=[5,5,4]", "system.effects=[linear_drag]", "verbose=true"]
    folder = train(tmp_path / "run", *words)
    metrics = check(folder, "hexacopter")
    assert len(metrics["parameters"]["linear_drag.drag"]["value"]) == 3
    assert metrics["parameters"]["linear_drag.drag"]["unit"] == "1/s"
    assert metrics["loss"] == "innovations"
    assert metrics["calibration"]["factor"] > 0
    assert len(metrics["calibration"]["left_out"]) == 2
    said = capsys.readouterr().out
    for word in ("linear_drag.drag", "thrust_gain", "constant velocity", "90% interval", "CRPS", str(folder)):
        assert word in said
    code = (
        "import sys, torch, nsde_torch\n"
        "model = nsde_torch.load(sys.argv[1])\n"
        "x0 = torch.zeros(2, 13); x0[:, 6] = 1\n"
        "g = torch.Generator().manual_seed(0)\n"
        "x = model.sample(x0, torch.full((2, 5, 6), 0.4), dt=0.05, particles=3, generator=g)\n"
        "assert torch.isfinite(x).all() and 0 <= model.distance(x0).min()\n"
        "print(tuple(x.shape))\n"
    )
    words = [sys.executable, "-W", "error", "-c", code, str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.strip() == "(3, 2, 6, 13)", done.stderr


def spring(seconds: float, seed: int, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """t, x and u of a pushed mass on a spring, measured with noise."""
    rng = np.random.default_rng(seed)
    dt = 0.01
    t = dt * np.arange(round(seconds / dt) + 1)
    u = 0.1 * np.sin(2 * t + seed) + 0.05 * rng.standard_normal(len(t))
    x = np.zeros((len(t), 2))
    x[0] = rng.uniform(-0.1, 0.1, 2)
    for k in range(len(t) - 1):
        q, v = x[k]
        v = v + dt * (u[k] - 0.5 * v - q)
        x[k + 1] = q + dt * v, v
    return t, x + noise * rng.standard_normal(x.shape), u[:, None]


def folder_of_runs(path: Path, seeds: list[int], noise: float) -> Path:
    path.mkdir()
    for seed in seeds:
        rows = np.column_stack(spring(8.0, seed, noise))
        np.savetxt(path / f"swing_{seed}.csv", rows, delimiter=",", header="t,q,q_dot,force", comments="")
    return path


@pytest.fixture
def swings(tmp_path: Path) -> Path:
    """A folder of CSV files."""
    return folder_of_runs(tmp_path / "swings", [0, 1, 2], 0.002)


def test_csv_files_of_the_user(tmp_path: Path, swings: Path) -> None:
    words = (*SPRING, f"data.path={swings}")
    metrics = check(train(tmp_path / "run", *words), "mass_spring_damper")
    assert metrics["train_runs"] == ["swing_0", "swing_1"]
    assert metrics["test_runs"] == ["swing_2"]
    assert metrics["parameters"]["force_gain"]["half_width_90"][0] > 0
    shown = {}
    for file in (tmp_path / "run" / "tensorboard").rglob("events*"):
        events = EventAccumulator(str(file), size_guidance={"images": 0})
        events.Reload()
        shown |= {name: events.Images(name)[0] for name in events.Tags()["images"]}
    assert set(shown) == PICTURES | TEST_PICTURES
    for name, image in shown.items():
        assert image.encoded_image_string == (tmp_path / "run" / "plots" / f"{name}.png").read_bytes()
        assert image.width == 1170
        assert image.height > 300


@pytest.mark.slow
def test_a_folder_of_further_runs_is_the_test_and_brings_its_own_sensor_noise(
    tmp_path: Path, swings: Path
) -> None:
    other = folder_of_runs(tmp_path / "others", [7], 0.02)
    words = (*SPRING, f"data.path={swings}", f"data.test_path={other}")
    metrics = check(train(tmp_path / "run", *words, "trainer.calibrate=false"), "mass_spring_damper")
    assert metrics["train_runs"] == ["swing_0", "swing_1", "swing_2"]
    assert metrics["test_runs"] == ["swing_7"]
    for name in ("q", "q_dot"):
        assert metrics["test"]["sensor_std"][name] > 4 * metrics["sensor_std"][name]


@pytest.mark.slow
def test_a_run_killed_midway_and_resumed_ends_in_the_same_metrics(tmp_path: Path, swings: Path) -> None:
    """SIGKILL at a checkpoint, in a process of its own; `resume=` finishes the run as if nothing had happened."""
    words = (*SPRING, f"data.path={swings}", "trainer.steps=30", "seed=3")
    expected = json.loads((train(tmp_path / "whole", *words) / "metrics.json").read_text())
    folder = tmp_path / "killed"
    command = [sys.executable, "-m", "nsde_torch.cli", "train", *FAST, *words, f"run_dir={folder}"]
    silent, env = subprocess.DEVNULL, {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=silent, stderr=silent, cwd=tmp_path, env=env)
    first = folder / "checkpoints" / "train.safetensors"
    deadline = time.monotonic() + 60
    while not first.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert first.exists()
    assert not (folder / "metrics.json").exists(), "the run finished before it could be killed"
    assert main(["train", f"resume={folder}"]) == 0
    metrics = check(folder, "mass_spring_damper")
    del expected["seconds"], metrics["seconds"]
    assert metrics == expected
    assert metrics["seed"] == 3
