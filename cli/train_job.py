"""One job of `nsde train`: build what the configuration describes and hand it to the library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from .jobs import Job, guarded


def task(config: DictConfig) -> float | None:
    """What Hydra calls; returns the validation score (smaller is better), which Optuna minimises."""
    return guarded(run, "train", config)


def run(config: DictConfig, job: Job) -> float:
    """Train one model.

    Args:
        config: The composed and checked configuration.
        job: Where this job writes.

    Returns:
        The validation score of the kept model.
    """
    from . import build, effects_file

    effects_file.expand(config.system)
    metrics = fit(config, job, job.run_dir, about=build.options(config))
    return float(metrics["validation"]["score"])


def fit(config: DictConfig, job: Job, run_dir: Path, *, about: dict[str, Any]) -> dict[str, Any]:
    """Build what a configuration describes and train it.

    Args:
        config: The composed and checked configuration, effects files expanded.
        job: What is being run.
        run_dir: Where the run directory is made.
        about: The configuration that `metrics.json` tells.

    Returns:
        The content of `metrics.json`.
    """
    # torch is imported here, not above: a launcher's parent process needs this module, but not torch.
    import nsde_torch

    from . import build

    device, dtype = build.settings(config, sweep=job.sweep)
    machine = build.system_options(config.system)
    system = machine.make()
    model = nsde_torch.train(
        build.dataset(config.data, system),
        system=machine,
        model=build.model_options(config.model),
        loss=build.loss_options(config.loss),
        trainer=build.trainer_options(config.trainer),
        solver=build.integrator(config.solver),
        test=None if config.data.test is None else list(config.data.test),
        test_data=build.test_data(config.data, system),
        validation=config.data.validation,
        instruments=list(config.data.instruments),
        seed=config.seed,
        run_dir=run_dir,
        device=device,
        dtype=dtype,
        about={"command": "train", "config": about},
    )
    return dict(model.metrics)
