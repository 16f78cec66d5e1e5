"""The work of `nsde evaluate`: read runs and data, score, print, write."""

from __future__ import annotations

import time

from omegaconf import DictConfig, OmegaConf

from .jobs import Job, guarded


def task(config: DictConfig) -> float | None:
    """What Hydra calls."""
    return guarded(run, "evaluate", config)


def run(config: DictConfig, job: Job) -> None:
    """Evaluate one or several models.

    Args:
        config: The composed and checked configuration.
        job: Where to write.
    """
    # torch is imported here, not above: help and completion do without it.
    import torch

    import nsde_torch
    from nsde_torch.data.system_info import all_columns
    from nsde_torch.learning.comparison import RESULT
    from nsde_torch.learning.comparison_text import lines

    from . import build, colour, evaluate_data
    from .evaluated_runs import read_runs

    started = time.perf_counter()
    torch.set_num_threads(config.threads)
    given = OmegaConf.to_container(config.run) if OmegaConf.is_config(config.run) else config.run
    names = None if config.names is None else list(config.names)
    trained = read_runs(given, names, build.make_device(config.device))
    chosen = evaluate_data.choose(config.data, trained[0], all_columns([r.model.system for r in trained]))
    sensors = config.sensor_noise or ("data" if chosen.other_sensors else "train")
    if sensors == "data":
        evaluate_data.record_sensors(trained)
        print("sensor noise is taken from the runs' own fourth differences; nothing else of them is used")
    done = nsde_torch.evaluate(
        {r.name: r.model for r in trained},
        chosen.data,
        runs=chosen.runs,
        sensor_noise=sensors,
        seed=config.seed,
        particles=config.particles,
        horizons=None if config.horizons is None else list(config.horizons),
        bootstrap=config.bootstrap,
        compile=config.compile,
        say=print,
    )
    _, *pictures = done.save(job.run_dir)
    print()
    for text, red in lines(done.content):
        print(colour.red(text) if red else text)
    wrote = ", ".join([RESULT, *(f"plots/{path.name}" for path in pictures)])
    print(f"\ntook {time.perf_counter() - started:.0f} s; wrote {job.run_dir}: {wrote}")
