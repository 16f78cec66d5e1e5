"""Run directories: what is saved comes back bit by bit, and nothing from outside is executed or half read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

import nsde_torch
from nsde_torch.errors import CheckpointError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.models.run_directory import CONFIG, WEIGHTS, save

Damage = Callable[[Path], object]


def make(dtype: torch.dtype = torch.float32, **spec: Any) -> NeuralSDE:
    options: dict[str, Any] = {"system": "hexacopter", "dt": 0.05, "horizon": 20, "step": "milstein", **spec}
    model = NeuralSDE(SDESpec(**options), generator=torch.Generator().manual_seed(0)).to(dtype)
    with torch.no_grad():
        for k, p in enumerate(model.parameters()):
            p.add_(0.01 * torch.randn(p.shape, generator=torch.Generator().manual_seed(k), dtype=dtype))
        model.clock_scale.fill_(1.037)
    return model


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save(make(), tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "spec",
    [
        {},
        {
            **{"effects": ("linear_drag", "motor_lag"), "filter_reach": 8, "measurement": True},
            **{"disturbance": True, "system_options": {"thrust_degree": 2}},
        },
        {"system": "mass_spring_damper", "declared": (), "sigma_max": (0.001, 0.02), "loss": "paper"},
    ],
)
def test_what_was_saved_comes_back_bit_by_bit(
    spec: dict[str, Any], dtype: torch.dtype, tmp_path: Path
) -> None:
    model = make(dtype, **spec)
    save(model, tmp_path, about={"command": "train"})
    loaded = nsde_torch.load(tmp_path)
    assert loaded.spec == model.spec
    assert not loaded.training
    assert not any(p.requires_grad for p in loaded.parameters())
    expected = model.state_dict()
    assert loaded.state_dict().keys() == expected.keys()
    for name, tensor in loaded.state_dict().items():
        assert tensor.dtype == expected[name].dtype
        assert torch.equal(tensor, expected[name]), name


def test_a_missing_folder_is_named_with_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no run directory .*nowhere.*nsde train"):
        nsde_torch.load(tmp_path / "nowhere")


@pytest.mark.parametrize("name", [CONFIG, WEIGHTS])
def test_a_missing_file_is_named_with_how_to_finish_the_run(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(CheckpointError, match=rf"holds no {name}.*resume={folder}"):
        nsde_torch.load(folder)


@pytest.mark.parametrize("change", ["shape", "missing", "extra"])
def test_weights_that_do_not_fit_the_configuration_are_refused_and_named(folder: Path, change: str) -> None:
    tensors = load_file(folder / WEIGHTS)
    if change == "shape":
        tensors["h.offset"] = torch.zeros(5)
    elif change == "missing":
        del tensors["h.offset"]
    else:
        tensors["h.more"] = torch.zeros(2)
    save_file(tensors, folder / WEIGHTS, metadata={"format": "nsde_torch/1"})
    with pytest.raises(CheckpointError, match=rf"{WEIGHTS} does not fit {CONFIG}.*h\.(offset|more)"):
        nsde_torch.load(folder)


HOSTILE = (
    "!!python/object/apply:os.system ['touch {mark}']",
    "format: nsde_torch/1\nspec: !!python/object/apply:os.system ['touch {mark}']",
    "format: nsde_torch/1\nspec: !!python/name:os.system",
    "format: nsde_torch/1\nspec: !!python/module:os",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_yaml_is_refused_and_not_run(folder: Path, tmp_path: Path, text: str) -> None:
    mark = tmp_path / "run_by_yaml"
    (folder / CONFIG).write_text(text.format(mark=mark))
    with pytest.raises(CheckpointError, match=str(folder)):
        nsde_torch.load(folder)
    assert not mark.exists()


def cut(kept: int) -> Damage:
    """The first bytes of the weights alone."""
    return lambda folder: (folder / WEIGHTS).write_bytes((folder / WEIGHTS).read_bytes()[:kept])


def another_kind(folder: Path) -> None:
    torch.save({"w": torch.zeros(3)}, folder / WEIGHTS)


def text(content: str) -> Damage:
    """A configuration that is this."""
    return lambda folder: (folder / CONFIG).write_bytes(content.encode(errors="surrogatepass"))


def spec(**change: Any) -> Damage:
    """A configuration whose specification is changed."""

    def damage(folder: Path) -> None:
        config = yaml.safe_load((folder / CONFIG).read_text())
        config["spec"].update(change)
        (folder / CONFIG).write_text(yaml.safe_dump(config))

    return damage


NO_SPEC = ("3", "[]", "null", "{}", "{system: hexacopter}", "{1: 2, system: hexacopter}")


@pytest.mark.parametrize(
    "damage",
    [
        *(cut(kept) for kept in (0, 4, 100, 2000, -1)), another_kind,
        *map(text, ("", "just words", "[1, 2", "format: other/9\nspec: {}", "format: nsde_torch/1")),
        *(text(f"format: nsde_torch/1\nspec: {none}") for none in NO_SPEC), text("[" * 900), text("\ud8ff no text"),
        spec(system="octocopter"), spec(step="leapfrog"), spec(effects=["warp_drive"]), spec(dt="fast"),
        spec(distance_hidden=5), spec(distance_hidden=["a"]), spec(sigma_max=[1.0, 2.0]), spec(system_options=3),
        spec(colour="red"), spec(filter_reach=-4),
    ],
)  # fmt: skip
def test_what_is_damaged_or_describes_no_model_is_refused_by_name(folder: Path, damage: Damage) -> None:
    damage(folder)
    with pytest.raises(CheckpointError, match=str(folder)):
        nsde_torch.load(folder)
