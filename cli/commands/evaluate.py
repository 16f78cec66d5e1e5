"""`nsde evaluate`: score trained models on runs, against baselines and each other."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Any

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key
from ..schemas import RunChoice


@dataclass
class EvaluateConfig:
    run: Any = key("???", "run directory to evaluate, or several to compare: run=[A,B]", file=True)
    names: list[str] | None = key(None, "name of each run in tables and figures; null: its folder")
    seed: int = key(0, "seed of the sampled paths and of the bootstrap", low=0)
    device: str = key("cpu", "where tensors live: cpu, cuda or cuda:N")
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    particles: int = key(199, "paths sampled from each start", low=2)
    horizons: list[float] | None = key(
        None, "horizons; null: those of 0.1, 0.25, 0.5, 1 and 2 that fit", unit="s", above=0
    )
    bootstrap: int = key(2000, "resamples of the paired bootstrap", low=100)
    sensor_noise: str | None = key(
        None,
        "sensors that predictions of measurements assume: those of the training data, or those that the runs show; "
        "null: data with data.test_path, else train",
        choices=("train", "data"),
    )
    inputs: str = key(
        "logged",
        "logged: a controller chose the inputs, and a model that has learned it reads from them what disturbed the "
        "machine; set: nothing is read from them",
        choices=("logged", "set"),
    )
    compile: bool = key(False, "compile the step: half a minute or more, which some thousand starts repay")
    out_dir: str = key("???", "folder to write into", file=True)
    data: RunChoice = group(RunChoice, "runs to score on; null: those that the first run was tested on")


COMMAND = HydraCommand(
    name="evaluate",
    schema=EvaluateConfig,
    groups={"data": None},
    values={"data": {"kind": "trained"}},
    folder="evaluations/${now:%Y-%m-%d}/${now:%H-%M-%S}",
    result=("evaluation.json", "an evaluation"),
    examples=(
        ("run=runs/a", "on the runs that it was tested on"),
        ("'run=[runs/a,runs/b]'", "several, and how each differs from the first"),
        ("run=runs/a 'data.test=[0]'", "on another run of its data"),
        ("run=runs/a data=csv data.path=flights/", "on other data, all runs of them"),
        ("run=runs/a 'horizons=[0.2,1,5]'", "lists in brackets, quoted"),
    ),
)


def run(config: Config, job: Job) -> None:
    import nsde_torch
    from nsde_torch.data.system_info import all_columns
    from nsde_torch.evaluation.comparison import RESULT
    from nsde_torch.evaluation.comparison_text import lines

    from .. import build, evaluated

    given = build.options(config)
    trained = evaluated.read_runs(given["run"], given["names"], build.make_device(config.device))
    machine = all_columns([model.system for model in trained.values()])
    data, runs, by_others = evaluated.choose(config.data, next(iter(trained.values())), machine)
    sensors = config.sensor_noise or ("data" if by_others else "train")
    if sensors == "data":
        print("sensor noise is taken from the runs' own fourth differences; nothing else of them is used")
    done = nsde_torch.evaluate(
        trained,
        data,
        runs=runs,
        sensor_noise=sensors,
        **{k: given[k] for k in ("seed", "particles", "horizons", "bootstrap", "compile", "inputs")},
    )
    _, *pictures = done.save(job.run_dir)
    print()
    for text, red in lines(done.content):
        print(f"\033[31m{text}\033[0m" if red and text and _colours() else text)
    wrote = ", ".join([RESULT, *(f"plots/{path.name}" for path in pictures)])
    print(f"\n{job.took}; wrote {job.run_dir}: {wrote}")


def _colours() -> bool:
    """Whether standard output takes colours (no-color.org); FORCE_COLOR asks for them in a pipe or file too."""
    if os.environ.get("NO_COLOR"):
        return False
    return bool(os.environ.get("FORCE_COLOR")) or (sys.stdout.isatty() and os.environ.get("TERM") != "dumb")
