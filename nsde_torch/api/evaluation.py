"""`nsde_torch.evaluate`: what `nsde evaluate` does."""

import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from nsde_torch.api.reading import Data, read, runs_named
from nsde_torch.data.run import Run
from nsde_torch.data.system_info import all_columns
from nsde_torch.errors import ConfigError
from nsde_torch.evaluation.common_grid import Candidate
from nsde_torch.evaluation.comparison import Comparison, compare
from nsde_torch.evaluation.seen import SeenRuns
from nsde_torch.models.model import Model, is_equation, learns_sensors
from nsde_torch.models.run_directory import load
from nsde_torch.threads import one_thread
from nsde_torch.training.prepare import sensor_std

Models = Model | str | Path | Sequence[Model | str | Path] | Mapping[str, Model | str | Path]


@one_thread(of_torch=False)
def evaluate(
    models: Models,
    data: Data,
    *,
    runs: Sequence[int | str | Run] | None = None,
    sensor_noise: str = "train",
    horizons: Sequence[float] | None = None,
    particles: int = 199,
    bootstrap: int = 2000,
    seed: int = 0,
    compile: bool = False,
    inputs: Literal["logged", "set"] = "logged",
    say: Callable[[str], None] | Literal[False] = print,
) -> Comparison:
    """Score models on runs, against baselines and each other, as `nsde evaluate` does.

    Args:
        models: A model, its run directory, a list of these, or a mapping from names to these; all of one system.
        data: Folder of CSV files, PX4 log, simulation, arrays or data set (see `nsde_torch.read`).
        runs: Runs to score on, by index or name; None: all.
        sensor_noise: Sensors that predictions of measurements assume: those of the training data ("train"), or those
            that the runs show ("data").
        horizons: Horizons [s]; None: those of 0.1, 0.25, 0.5, 1 and 2 that fit.
        particles: Paths sampled from each start, at least 2.
        bootstrap: Resamples of the paired bootstrap, at least 100.
        seed: Seed of the sampled paths and of the bootstrap.
        compile: Compile the step: half a minute or more, which some thousand starts repay.
        inputs: `logged`: a controller chose the inputs, and a model that has learned it reads from them what disturbed
            the machine, but at interventions. `set`: whatever the inputs answer, nothing is read from them.
        say: Takes what is going on, line by line; False: nothing is printed.

    Returns:
        The scores: `errors` of the first model by group and horizon, `report` (text), `content` (what
        `evaluation.json` holds: intervals, coverage, differences, notes) and `save(folder)`.

    Raises:
        ConfigError: models of different systems, names given twice, or a step or horizon that does not fit.
        DataError: runs that are too short, or lack a column.
        CheckpointError: a run directory that is missing or damaged.

    Example:
        >>> import nsde_torch
        >>> made = nsde_torch.simulate("mass_spring_damper", durations=[6.0] * 3, seed=1)
        >>> model = nsde_torch.train(made, system="mass_spring_damper", model="sysid", say=False)
        >>> scores = nsde_torch.evaluate(model, made, runs=[2], particles=2, say=False)
        >>> scores.errors["position"]["0.5"] < 0.02  # [m]
        True
    """
    if sensor_noise not in ("train", "data"):
        raise ConfigError(f"`sensor_noise` must be train or data; got {sensor_noise!r}.")
    if inputs not in ("logged", "set"):
        raise ConfigError(f"`inputs` must be logged or set; got {inputs!r}.")
    named = _named(models)
    if inputs == "set":
        named = {name: _without_feedback(model) for name, model in named.items()}
    read_data = read(data, system=all_columns([model.system for model in named.values()]))
    chosen = runs_named(read_data, runs)
    candidates = [
        Candidate(
            name=name,
            model=model,
            seen=SeenRuns.of(model.metrics),
            folder=str(model.folder or ""),
            measurement_std=_sensors(model, chosen) if sensor_noise == "data" else None,
            reach=float(model.metrics.get("input_filter", {}).get("reach_s", 0.0)),
            smoothing=float(model.metrics.get("input_smoothing_s", 0.0)),
        )
        for name, model in named.items()
    ]
    return compare(
        candidates,
        read_data,
        chosen,
        seed=seed,
        particles=particles,
        horizons=None if horizons is None else list(horizons),
        replicates=bootstrap,
        compile=compile,
        say=say or (lambda text: None),
    )


def _named(models: Models) -> dict[str, Model]:
    if isinstance(models, Mapping):
        return {str(name): _loaded(model) for name, model in models.items()}
    listed = [models] if isinstance(models, Model | str | Path) else list(models)
    if not listed:
        raise ConfigError("`models` names no model.")
    loaded = [_loaded(model) for model in listed]
    names = [m.folder.name if m.folder is not None else m.spec.kind for m in loaded]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(
            f"`models` has several called {', '.join(twice)}; give names, {{'a': model, 'b': other}}."
        )
    return dict(zip(names, loaded, strict=True))


def _without_feedback(model: Model) -> Model:
    """The model, or a copy that has not learned the controller of its training runs."""
    if not (model.capabilities.knows_feedback and is_equation(model)):
        return model
    made = copy.deepcopy(model)
    made.feedback = None
    return made


def _loaded(model: Model | str | Path) -> Model:
    return model if isinstance(model, Model) else load(model)


def _sensors(model: Model, runs: Sequence[Run]) -> Tensor | None:
    """Noise of the sensors of the runs (nx,), as `nsde train` estimates it; None for a model without any.

    The learned noise is scaled by the ratio of the fourth differences of both data.
    """
    if not learns_sensors(model):
        return None
    known = model.metrics.get("train_sensor_std")
    if known is None:
        raise ConfigError(
            "`sensor_noise`: this model does not record the sensors of its training data; take train, or train again."
        )
    before = torch.tensor([float(known[n]) for n in model.system.state_names], dtype=torch.float64)
    ratio = sensor_std(runs) / before.clamp_min(1e-12)
    return model.measurement_std * ratio.to(model.measurement_std)
