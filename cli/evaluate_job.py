"""The work of `nsde evaluate`: read runs and data, score, print, write."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from .jobs import Job, guarded

if TYPE_CHECKING:
    from torch import Tensor

    from .evaluate_data import Chosen
    from .evaluated_runs import TrainedRun

RESULT = "evaluation.json"


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

    from nsde_torch.learning.common_grid import Candidate
    from nsde_torch.learning.comparison import compare
    from nsde_torch.learning.comparison_figures import write_figures
    from nsde_torch.learning.comparison_text import lines
    from nsde_torch.learning.seen import SeenRuns

    from . import build, colour, evaluate_data
    from .evaluated_runs import read_runs

    started = time.perf_counter()
    torch.set_num_threads(config.threads)
    given = OmegaConf.to_container(config.run) if OmegaConf.is_config(config.run) else config.run
    names = None if config.names is None else list(config.names)
    trained = read_runs(given, names, build.make_device(config.device))
    machine = evaluate_data.all_columns([r.model.system for r in trained])
    chosen = evaluate_data.choose(config.data, trained[0], machine)
    from_data = (config.sensor_noise or ("data" if chosen.other_sensors else "train")) == "data"
    candidates = [
        Candidate(
            name=r.name,
            model=r.model,
            seen=SeenRuns.of(r.metrics),
            folder=str(r.folder),
            measurement_std=_sensors(r, chosen) if from_data else None,
            reach=float(r.metrics.get("input_filter", {}).get("reach_s", 0.0)),
            smoothing=float(r.metrics.get("input_smoothing_s", 0.0)),
        )
        for r in trained
    ]
    if from_data:
        print("sensor noise is taken from the runs' own fourth differences; nothing else of them is used")
    done = compare(
        candidates,
        chosen.data,
        chosen.runs,
        seed=config.seed,
        particles=config.particles,
        horizons=None if config.horizons is None else list(config.horizons),
        replicates=config.bootstrap,
        compile=config.compile,
        say=print,
    )
    (job.run_dir / RESULT).write_text(json.dumps(done.content, indent=1, allow_nan=False), encoding="utf-8")
    print()
    for text, red in lines(done.content):
        print(colour.red(text) if red else text)
    pictures = write_figures(job.run_dir / "plots", done)
    wrote = ", ".join([RESULT, *(f"plots/{path.name}" for path in pictures)])
    print(f"\ntook {time.perf_counter() - started:.0f} s; wrote {job.run_dir}: {wrote}")


def _sensors(trained: TrainedRun, chosen: Chosen) -> Tensor | None:
    """Noise of the sensors of the chosen runs (nx,), as `nsde train` estimates it; None for a model without any.

    The learned noise is scaled by the ratio of what the fourth differences of both data show.
    """
    import torch

    from nsde_torch.learning.prepare import sensor_std
    from nsde_torch.learning.training import learns_sensors

    from .evaluate_data import training_runs

    model = trained.model
    if not learns_sensors(model):
        return None
    known = trained.metrics.get("train_sensor_std")
    if known is None:
        before = sensor_std(training_runs(trained))
    else:
        before = torch.tensor([float(known[n]) for n in model.system.state_names], dtype=torch.float64)
    ratio = sensor_std(chosen.runs) / before.clamp_min(1e-12)
    return model.measurement_std * ratio.to(model.measurement_std)
