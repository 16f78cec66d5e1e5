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
    from nsde_torch import learning

    from . import build

    device, dtype = build.settings(config, sweep=job.sweep)
    system = build.system(config.system)
    data = build.dataset(config.data, system)
    split = build.split(config.data, data, system)
    return learning.train(
        build.model_spec(config, system, split),
        data,
        split,
        loss=build.loss_options(config),
        options=build.trainer_options(config.trainer),
        validation=config.data.validation,
        seed=config.seed,
        run_dir=run_dir,
        values=build.parameter_values(config.system),
        device=device,
        dtype=dtype,
        about={"command": "train", "config": about},
        other_sensors=config.data.test_path is not None,
        instruments=list(config.data.instruments),
    )
