"""`nsde policy`: learn a policy in a learned model or on the true machine, and judge it there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.errors import ConfigError
from nsde_torch.policy.options import PolicyOptions

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key, mirrors, of

if TYPE_CHECKING:
    from torch import Generator

    from nsde_torch.models import Model
    from nsde_torch.policy import Dynamics

TRUTH = "truth"


@mirrors(PolicyOptions, without=("interactions",))
class PpoConfig:
    """Proximal policy optimisation."""


@dataclass
class PolicySystem:
    name: str = key("???", "name of a system that has a task: cartpole")


@dataclass
class PolicyConfig:
    environment: str = key(
        "truth", "where the policy learns: truth, or the run directory of a model", file=True
    )
    truth: str = key(
        "plant",
        "the true machine: plant (this package's, as data=simulated) or published (that of the authors' data)",
        choices=("plant", "published"),
    )
    sensor_noise: float = key(1.0, "sensor noise of truth and model, relative to their own", low=0)
    propagation: str | None = key(
        None,
        "members of an ensemble: fixed (one for an episode) or redrawn (one for every step); null: as it was trained",
        choices=("fixed", "redrawn"),
    )
    steps: int = of(PolicyOptions, "interactions")
    seed: int = key(0, "seed of networks, actions and first states", low=0)
    scored_against: list[str] = key(
        [], "folders of policies that learned on the same truth; the score is relative to them", file=True
    )
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    run_dir: str = key("???", "folder of this run", file=True)
    sweep_dir: str = key("???", "folder of a sweep (-m); its jobs lie inside", file=True)
    resume: str | None = key(
        None, "folder of an interrupted run to continue, with its configuration", file=True
    )
    system: PolicySystem = group(PolicySystem, "the machine")
    ppo: PpoConfig = group(PpoConfig, "how it learns")


COMMAND = HydraCommand(
    name="policy",
    schema=PolicyConfig,
    groups={"system": "cartpole", "ppo": "default"},
    folder="policies/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.system}",
    unnamed=("sweep_dir", "threads", "environment", "scored_against"),
    examples=(
        ("environment=truth", "on the true machine"),
        ("environment=runs/model 'scored_against=[runs/on_truth]'", ""),
        ("truth=published sensor_noise=0", "the machine of the authors' data, clean sensors"),
        ("steps=20000 ppo=short", "for few interactions"),
        ("resume=runs/policy", "continue an interrupted run"),
        ("-m seed=0,1,2", "a sweep, one job for each seed"),
    ),
)


def run(config: Config, job: Job) -> float:
    """Learn one policy; minus the mean reward per episode where it learned."""
    from nsde_torch.policy import PolicyTraining, make_learned, make_task, make_truth

    from .. import build

    _check_extra()
    wanted = make_task(config.system.name)
    noise = float(config.sensor_noise)

    def truth(generator: Generator) -> Dynamics:
        return make_truth(
            config.truth, system=wanted.system, dt=wanted.dt, sensor_noise=noise, generator=generator
        )

    if config.environment == TRUTH and config.propagation is not None:
        raise ConfigError(
            f"`propagation={config.propagation}` chooses members of an ensemble, and environment=truth is none. "
            "Leave it out."
        )
    environment, kind = truth, TRUTH
    about: dict[str, Any] = {"kind": TRUTH, "name": str(config.truth)}
    if config.environment != TRUTH:
        model = _model(config.environment, wanted.system)

        def learned(generator: Generator) -> Dynamics:
            return make_learned(
                model, dt=wanted.dt, sensor_noise=noise, generator=generator, propagation=config.propagation
            )

        environment, kind = learned, "model"
        about = {"kind": kind, "name": model.spec.kind, "run": str(Path(config.environment).resolve())}
        if model.capabilities.propagation is not None:
            about["propagation"] = config.propagation or model.capabilities.propagation
    result = PolicyTraining(
        wanted,
        environment=environment,
        truth=truth,
        options=PolicyOptions(**build.shared(PolicyOptions, config.ppo), interactions=config.steps),
        seed=config.seed,
        folder=job.run_dir,
        about={"environment": about, "truth": str(config.truth), "sensor_noise": noise},
        scored_against=list(config.scored_against),
    ).run()
    return float(result["validation"]["score"])


def _model(folder: str, system: str) -> Model:
    """The model of a run directory, refused if it is of another machine."""
    import nsde_torch
    from nsde_torch.systems import make_system

    model = nsde_torch.load(folder)
    own = make_system(system)
    if (model.system.state_names, model.system.input_names) != (own.state_names, own.input_names):
        raise ConfigError(
            f"`environment={folder}` is a model of {model.spec.system}, and the task is of {system}; "
            f"expected states {', '.join(own.state_names)} and inputs {', '.join(own.input_names)}, got "
            f"{', '.join(model.system.state_names)} and {', '.join(model.system.input_names)}. Name a run of "
            f"`nsde train system={system}`."
        )
    return model


def _check_extra() -> None:
    from importlib.util import find_spec

    missing = [name for name in ("gymnasium", "stable_baselines3") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"`nsde policy` needs {' and '.join(missing)}, which are not installed. "
            "Install them with: pip install 'nsde_torch[policy]'"
        )
