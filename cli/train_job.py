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
    from . import build

    return build.train(config, job)
