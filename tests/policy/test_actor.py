"""A policy on disk: tensors and plain words, and nothing else is believed."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from nsde_torch.errors import CheckpointError
from nsde_torch.policy import Actor, load_policy, make_task

TASK = make_task("cartpole")


def actor() -> Actor:
    torch.manual_seed(0)
    made = Actor(TASK.observation_scale, (8, 6), 1, system="cartpole")
    return made.eval().requires_grad_(False)


def test_policy_that_is_loaded_acts_as_the_one_that_was_saved(tmp_path: Path) -> None:
    own = actor()
    own.save(tmp_path)
    other = load_policy(tmp_path)
    seen = torch.randn(50, 5)
    assert torch.equal(other(seen), own(seen))
    assert (other.system, other.hidden) == ("cartpole", (8, 6))
    assert not any(p.requires_grad for p in other.parameters())


def test_actions_are_clipped() -> None:
    own = actor()
    own.layers[-1].bias.fill_(9.0)  # type: ignore[operator, union-attr]
    assert own(torch.zeros(3, 5)).tolist() == [[1.0]] * 3


def test_missing_policy_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no policy"):
        load_policy(tmp_path / "nowhere")


@pytest.mark.parametrize("fault", ["cut", "pickle", "format", "shape", "width", "nan"])
def test_damaged_policy_is_refused(tmp_path: Path, fault: str) -> None:
    path = actor().save(tmp_path)
    tensors = {k: v.clone() for k, v in load_file(path).items()}  # not views of the file that is overwritten
    about = {"system": "cartpole", "hidden": [8, 6], "n_actions": 1}
    metadata = {"format": "nsde_torch/policy/1", "about": json.dumps(about)}
    if fault == "cut":
        path.write_bytes(path.read_bytes()[:-40])
    elif fault == "pickle":
        torch.save(tensors, path)
    elif fault in ("format", "width"):
        wrong = {"format": {"format": "other"}, "width": {"about": json.dumps({**about, "hidden": "x"})}}
        save_file(tensors, path, metadata=metadata | wrong[fault])
    else:
        bias = torch.zeros(3) if fault == "shape" else torch.full((8,), torch.nan)
        save_file({**tensors, "layers.0.bias": bias}, path, metadata=metadata)
    with pytest.raises(CheckpointError, match=r"policy\.safetensors"):
        load_policy(tmp_path)
