"""From the configuration to objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from nsde_torch.cli import build
from nsde_torch.cli.schema import CsvData
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.systems import make_system


@pytest.mark.parametrize("name", ["gpu", "mps", "cpu:x"])
def test_an_unknown_device_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="`device` must be cpu, cuda or cuda:N"):
        build.make_device(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_cuda_without_a_device_says_so() -> None:
    with pytest.raises(ConfigError, match=r"sees no CUDA device\. Use device=cpu"):
        build.make_device("cuda")


def test_a_job_of_a_sweep_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    monkeypatch.setattr(torch, "set_num_threads", seen.append)
    config = OmegaConf.create({"device": "cpu", "dtype": "float64", "threads": 4})
    assert build.settings(config, sweep=True) == (torch.device("cpu"), torch.float64)
    build.settings(config, sweep=False)
    assert seen == [1, 4]


def test_options_are_plain_keyword_arguments() -> None:
    config = OmegaConf.create({"kind": "csv", "path": "a", "test": [0], "deep": {"x": [1]}})
    assert build.options(config, "kind", "test") == {"path": "a", "deep": {"x": [1]}}


def test_runs_are_read_and_split_as_the_configuration_says(tmp_path: Path) -> None:
    time = np.arange(200) * 0.01
    for number in range(3):
        columns = np.column_stack([time, np.cos(time + number), -np.sin(time + number)])
        np.savetxt(
            tmp_path / f"run_{number}.csv",
            columns,
            delimiter=",",
            header="t,q,q_dot",
            comments="",
            fmt="%.9g",
        )
    config = OmegaConf.structured(CsvData(path=str(tmp_path), test=["run_1"]))
    data = build.dataset(config, make_system("mass_spring_damper"))
    assert data.dt == pytest.approx(0.01)
    parts = build.split(config, data)
    assert [run.name for run in parts.train] == ["run_0", "run_2"]
    assert [run.name for run in parts.test] == ["run_1"]
    config.test = None
    assert [run.name for run in build.split(config, data).test] == ["run_2"]
    config.test = [7]
    with pytest.raises(DataError, match="7"):
        build.split(config, data)
