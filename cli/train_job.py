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
    from nsde_torch.models import make_model

    from . import build

    device, dtype = build.settings(config, sweep=job.sweep)
    system = build.system(config.system)
    step = build.step(config.solver, system)
    data = build.dataset(config.data, system)
    runs = build.split(config.data, data)
    model = make_model(config.model.kind, system, step=step, **build.options(config.model, "kind"))
    return learning.train(
        model.to(device=device, dtype=dtype),
        data,
        runs,
        config=build.options(config, "run_dir", "sweep_dir", "resume"),
        run_dir=job.run_dir,
        resume=config.resume is not None,
    )
