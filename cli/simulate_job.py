"""The work of `nsde simulate`: make the runs, write them, and the truth elsewhere."""

from __future__ import annotations

import time
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from .jobs import guarded_without_folder


def task(config: DictConfig) -> None:
    """What Hydra calls; a failure is left for the command to word, and nothing is written for it."""
    guarded_without_folder(run, "simulate", config)


def run(config: DictConfig) -> None:
    """Make and write one data set.

    Args:
        config: The composed and checked configuration.
    """
    # torch is imported here, not above: help and completion do without it.
    import torch

    from nsde_torch.plants.recording import Recording
    from nsde_torch.plants.replay import Replay
    from nsde_torch.plants.simulation import check_free, simulate, truth_path, write

    from . import build

    started = time.perf_counter()
    torch.set_num_threads(config.threads)
    folder = Path(config.out)
    check_free(folder, truth_path(folder, config.truth), overwrite=config.overwrite)
    plant = build.options(config.plant)
    made = simulate(
        config.system.name,
        durations=None if config.durations is None else list(config.durations),
        seed=config.seed,
        dt=config.dt,
        recording=Recording(**build.options(config.recording)),
        replay=Replay(**build.options(config.replay)) if config.pilot == "replay" else None,
        options=OmegaConf.to_container(config.options),  # type: ignore[arg-type]
        **plant,
    )
    files = write(made, folder, truth=config.truth, overwrite=config.overwrite)
    rows = sum(len(run.t) for run in made.runs)
    seconds = sum(made.truth["durations_s"])
    of = f"{config.replay.starts} interventions on flights of " if config.pilot == "replay" else ""
    took = time.perf_counter() - started
    print(
        f"took {took:.0f} s; wrote {len(made.runs)} runs of {config.system.name} ({of}{seconds:g} s, {rows} rows) into "
        f"{folder}, and what is in them to {files[-1]}"
    )
