"""The work of `nsde export`: read the model, write the file, say what is in it."""

from __future__ import annotations

import time
from pathlib import Path

from omegaconf import DictConfig

from .jobs import guarded_without_folder


def task(config: DictConfig) -> None:
    """What Hydra calls; a failure is left for the command to word."""
    guarded_without_folder(run, "export", config)


def run(config: DictConfig) -> None:
    """Write one controller.

    Args:
        config: The composed and checked configuration.

    Raises:
        ConfigError: the file is there already, or a setting that a file cannot hold.
    """
    # torch is imported here, not above: help and completion do without it.
    import torch

    from nsde_torch.control.knowledge import DECLARED, system_of
    from nsde_torch.errors import ConfigError
    from nsde_torch.export.write import export
    from nsde_torch.plants.machines import machine

    from . import track_build

    started = time.perf_counter()
    torch.set_num_threads(config.threads)
    path = Path(config.out)
    if path.exists() and not config.overwrite:
        raise ConfigError(f"`out={path}` is there already; name another file, or say overwrite=true.")
    known = track_build.knowledge(config.run, config.plant)
    mpc = config.mpc
    digest = export(
        known,
        path,
        problem=track_build.problem(mpc),
        solver=track_build.solver(mpc),
        safety=track_build.safety(mpc),
        kind=config.format,
        run=None if config.run == DECLARED else Path(config.run),
        sample=config.sample or config.plant.dt or machine(system_of(known).name).dt,
        period=mpc.period,
        latency=track_build.latency(config, known),
        dtype=getattr(torch, config.precision),
        say=lambda line: print(line, flush=True),
    )
    print(
        f"took {time.perf_counter() - started:.0f} s; wrote {path} ({path.stat().st_size / 1024:.0f} kB, "
        f"{config.format}, sha256 {digest[:16]}...); check it with: nsde verify {path} run={config.run}"
    )
