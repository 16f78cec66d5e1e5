"""From the configuration to objects."""

from __future__ import annotations

import pytest
import torch
from omegaconf import OmegaConf

from nsde_torch.cli import build
from nsde_torch.errors import ConfigError


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
