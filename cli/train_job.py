"""One job of `nsde train`: build what the configuration describes and hand it to the library."""

from __future__ import annotations

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
    # torch is imported here, not above: a launcher's parent process needs this module, but not torch.
    from nsde_torch import learning

    from . import build

    device, dtype = build.settings(config, sweep=job.sweep)
    system = build.system(config.system)
    model = build.model(config, system).to(device=device, dtype=dtype)
    data = build.dataset(config.data, system)
    return learning.train(
        model,
        data,
        build.split(config.data, data),
        loss=build.loss_options(config),
        options=build.trainer_options(config.trainer),
        validation=config.data.validation,
        seed=config.seed,
        run_dir=job.run_dir,
        resume=config.resume is not None,
    )
