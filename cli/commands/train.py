"""`nsde train`: learn a neural SDE of a machine from simulated or measured runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nsde_torch.recall import recall
from nsde_torch.systems.options import SystemOptions
from nsde_torch.training.options import LossOptions, TrainerOptions

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key
from ..schemas import DataConfig, LossConfig, ModelConfig, SolverConfig, SystemConfig, TrainerConfig


@dataclass
class TrainConfig:
    seed: int = key(0, "seed of initial weights, batches and noise", low=0)
    device: str = key("cpu", "where tensors live: cpu, cuda or cuda:N")
    dtype: str = key("float32", "precision", choices=("float32", "float64"))
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    verbose: bool = key(False, "print every table of the test, baselines and the summary of the data too")
    run_dir: str = key("???", "folder of this run", file=True)
    sweep_dir: str = key("???", "folder of a sweep (-m); its jobs lie inside", file=True)
    resume: str | None = key(
        None, "folder of an interrupted run to continue, with its configuration", file=True
    )
    system: SystemConfig = group(SystemConfig, "the machine")
    data: DataConfig = group(DataConfig, "where the runs come from")
    model: ModelConfig = group(ModelConfig, "what is learned")
    loss: LossConfig = group(LossConfig, "what a good model is")
    trainer: TrainerConfig = group(TrainerConfig, "how it is optimised")
    solver: SolverConfig = group(SolverConfig, "how paths are integrated")


GROUPS = {
    **{"system": "hexacopter", "data": "simulated", "model": "nsde"},
    **{"loss": "default", "trainer": "default", "solver": "default"},
}
COMMAND = HydraCommand(
    name="train",
    schema=TrainConfig,
    groups=GROUPS,
    folder="runs/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.system}",
    unnamed=("sweep_dir", "device", "threads", "data.path"),
    examples=(
        ("trainer.lr=0.003 'data.test=[0]'", "set keys; lists in brackets, quoted"),
        ("system=cartpole trainer=fast", "choose from groups"),
        ("run_dir=runs/first", "name the folder of the run"),
        ("resume=runs/first", "continue an interrupted run"),
        ("--config-dir DIR system=mine", "your own DIR/system/mine.yaml, modules in DIR"),
        ("-m loss=paper,replay seed=0,1,2", "a sweep, one job for each combination"),
        ("-m hydra/launcher=batched seed=0,1", "what jobs share is worked out once, on all cores"),
        ("-m hydra/launcher=joblib ...", "in parallel (also submitit_local, submitit_slurm, ray)"),
        ("-m hydra/sweeper=optuna 'trainer.lr=tag(log,interval(0.001,0.1))'", ""),
    ),
)


def run(config: Config, job: Job) -> float:
    """Train one model; the validation score of the kept one."""
    from .. import build

    metrics = fit(config, build.system_options(config.system), job.run_dir)
    return float(metrics["validation"]["score"])


def fit(config: Config, machine: SystemOptions, run_dir: Path) -> dict[str, Any]:
    """Train a model of a machine as a checked configuration says; the content of `metrics.json`."""
    import torch
    from omegaconf import OmegaConf

    import nsde_torch

    from .. import build

    system = machine.make()
    data = recall(
        (OmegaConf.to_yaml(config.data), OmegaConf.to_yaml(config.system)),
        lambda: build.dataset(config.data, system),
    )
    about = {k: v for k, v in build.options(config).items() if k in TrainConfig.__dataclass_fields__}
    model = nsde_torch.train(
        data,
        system=machine,
        model=build.model_options(config.model),
        loss=LossOptions(**build.options(config.loss)),
        trainer=TrainerOptions(**build.options(config.trainer)),
        solver=build.integrator(config.solver),
        **build.beside(config.data, system),
        validation=config.data.validation,
        seed=config.seed,
        run_dir=run_dir,
        verbose=config.verbose,
        device=build.make_device(config.device),
        dtype=getattr(torch, config.dtype),
        about={"command": "train", "config": {**about, "system": asdict(machine)}},
    )
    return dict(model.metrics)
