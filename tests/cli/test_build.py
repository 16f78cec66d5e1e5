"""From the configuration to objects."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module

from nsde_torch.cli import build
from nsde_torch.cli.hydra_command import store
from nsde_torch.cli.registry import hydra_command
from nsde_torch.data import Run
from nsde_torch.errors import ConfigError
from nsde_torch.models import MODELS
from nsde_torch.models.kind import Choice, model_kind, model_options
from nsde_torch.systems import SYSTEMS
from nsde_torch.training.options import LOSSES, TRAINERS, LossOptions, TrainerOptions, machine_losses


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_cuda_without_a_device_says_so() -> None:
    with pytest.raises(ConfigError, match=r"sees no CUDA device\. Use device=cpu"):
        build.make_device("cuda")


def _configuration(*words: str) -> Any:
    store(hydra_command("train"))
    with initialize_config_module("nsde_torch.conf", version_base="1.3"):
        return compose("train", overrides=list(words))


def _spec(config: Any) -> Any:
    machine = build.system_options(config.system).make()
    still = Run("still", 0.01 * np.arange(50), np.zeros((50, machine.nx)), np.zeros((50, machine.nu)))
    choice = Choice(
        options=build.model_options(config.model), system=build.system_options(config.system), machine=machine,
        runs=(still,), loss=config.loss.kind,
        integrator=build.integrator(config.solver),
    )  # fmt: skip
    return model_kind(choice.options.kind).make_spec(choice)


def _losses(*words: str) -> LossOptions:
    config = _configuration(*words)
    return machine_losses(LossOptions(**build.options(config.loss)), build.system_options(config.system))


@pytest.mark.parametrize(("choice", "name"), [("default", "innovations"), ("replay",) * 2, ("paper",) * 2])
def test_a_loss_by_name_is_that_of_the_command_line(choice: str, name: str) -> None:
    assert LossOptions(**build.options(_configuration(f"loss={choice}").loss)) == LOSSES[name]


@pytest.mark.parametrize("choice", ["default", "fast", "paper"])
def test_a_trainer_by_name_is_that_of_the_command_line(choice: str) -> None:
    assert TrainerOptions(**build.options(_configuration(f"trainer={choice}").trainer)) == TRAINERS[choice]


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_by_name_is_that_of_the_command_line(kind: str) -> None:
    given, known = build.model_options(_configuration(f"model={kind}").model), model_options(kind)
    assert type(given) is type(known)
    ours, theirs = (json.loads(json.dumps(dataclasses.asdict(made))) for made in (given, known))
    assert ours == theirs


@pytest.mark.parametrize("name", SYSTEMS)
def test_constants_that_are_not_set_are_the_systems_own(name: str) -> None:
    words = [f"system={name}", "loss=paper"]
    config = _configuration(*words)
    system, spec, losses = build.system_options(config.system).make(), _spec(config), _losses(*words)
    own = system.defaults
    assert system.name == name
    assert (spec.dt, spec.horizon, spec.step) == (own.dt, own.horizon, own.step)
    assert spec.sigma_max == tuple(own.sigma_max)
    assert losses.mu is losses.ball_radius is None


def test_constants_that_are_set_win() -> None:
    words = ["system=mass_spring_damper", "system.dt=0.02", "system.horizon=7", "system.sigma_max=[1,2]"]
    words += ["system.lambda_mu=3", "system.ball_radius=0.5", "solver=heun"]
    spec, losses = _spec(_configuration(*words)), _losses(*words)
    assert (spec.dt, spec.horizon, spec.sigma_max, spec.step) == (0.02, 7, (1.0, 2.0), "heun")
    assert (losses.mu, losses.ball_radius) == (3, 0.5)
    assert _losses("system.lambda_mu=3", "loss.mu=4").mu == 4


@pytest.mark.parametrize("words", [[], ["loss=paper"], ["model.sigma=declared"], ["trainer=paper"]])
def test_sigma_is_learned_unless_the_loss_or_the_user_declares_it(words: list[str]) -> None:
    spec = _spec(_configuration("system=cartpole", *words))
    assert (spec.sigma_max is None) == (words in ([], ["trainer=paper"]))
