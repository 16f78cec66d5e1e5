"""`nsde_torch.train`: what `nsde train` does."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Literal

import torch

from nsde_torch.api.reading import Data, read, split_runs
from nsde_torch.errors import ConfigError
from nsde_torch.models.kind import Choice, ModelKind, model_kind, model_options
from nsde_torch.models.model import Model
from nsde_torch.models.options import ModelOptions
from nsde_torch.models.run_directory import WEIGHTS, load
from nsde_torch.sde.options import IntegratorOptions, integrator_options
from nsde_torch.sde.step import Step
from nsde_torch.systems.base import System
from nsde_torch.systems.options import Effects, SystemOptions, system_options
from nsde_torch.threads import one_thread
from nsde_torch.training.options import (
    LOSSES,
    TRAINERS,
    LossOptions,
    TrainerOptions,
    machine_losses,
    named_options,
)
from nsde_torch.training.session import Training

DTYPES = {"float32": torch.float32, "float64": torch.float64}


@one_thread(of_torch=False)
def train(
    data: Data,
    *,
    system: str | type[System] | SystemOptions,
    model: str | type[ModelKind] | ModelOptions = "nsde",
    effects: Effects = (),
    declared: Sequence[str] | None = None,
    parameters: Mapping[str, Any] | None = None,
    loss: str | LossOptions = "innovations",
    trainer: str | TrainerOptions = "default",
    solver: str | type[Step] | IntegratorOptions | None = None,
    test: Sequence[int | str] | None = None,
    test_data: Data | None = None,
    validation: float = 0.15,
    instruments: Sequence[str] = (),
    seed: int = 0,
    run_dir: str | Path | None = None,
    device: str | torch.device = "cpu",
    dtype: str | torch.dtype = "float32",
    about: Mapping[str, Any] | None = None,
    say: Callable[[str], None] | Literal[False] = print,
    verbose: bool = False,
) -> Model:
    """Train a model on runs and score it on runs held out, as `nsde train` does.

    What the user does not choose of the model's structure (input filter, sensor noise, disturbance, integrator) is as
    the system and the data ask for (`nsde_torch.models.kind`). Ctrl-C (in a notebook: interrupt) once the model is
    fitted returns it, with what `metrics` holds by then; before, it is a KeyboardInterrupt as ever.

    Args:
        data: Folder of CSV files, PX4 log, simulation, arrays or data set (see `nsde_torch.read`).
        system: The machine: key of `nsde_torch.systems.SYSTEMS`, `module:Class`, a class, or
            `nsde_torch.systems.SystemOptions` for constants that are not its own (step, horizon, largest diffusion).
        model: Kind of model, a key of `nsde_torch.models.MODELS` ("nsde", "node", "blackbox_nsde", "ensemble",
            "sysid"), `module:Class` or the class of one of your own, or its options, such as
            `nsde_torch.models.NsdeOptions(residual_hidden=(16,))`.
        effects: Effects to add to the declared physics: names, `{name: {parameter: value}}`, a file `effects.yaml`, or
            `found.effects` of a diagnosis.
        declared: Effects that replace the declared ones; None keeps them.
        parameters: Initial values of declared parameters, `name` or `effect.name`, in their units.
        loss: "innovations", "replay" or "paper", or `nsde_torch.training.LossOptions`.
        trainer: "default", "fast" or "paper", or `nsde_torch.training.TrainerOptions`.
        solver: Integrator: a key of `nsde_torch.sde.STEPS`, `module:Class` or the class of one of your own, or its
            options; None: the one that fits.
        test: Runs to hold out, by index or name; None holds out the last; [] holds out none.
        test_data: Further runs, recorded by other sensors perhaps, that are the test.
        validation: Share of the training runs' time that early stopping looks at, 0.01 to 0.5.
        instruments: Logged columns that nothing inside the control loop moves: sticks, setpoints.
        seed: Seed of weights, batches and noise.
        run_dir: Run directory to write; None keeps no file.
        device: Where tensors live.
        dtype: Precision, "float32" or "float64".
        about: Plain values for the run directory's `config.yaml`.
        say: Takes what is going on, line by line; a bar counts steps in a terminal and a notebook. False: neither.
        verbose: Say all: the summary of the data, every table of the test and the baselines.

    Returns:
        The model, in evaluation mode; `model.metrics` holds what `metrics.json` does: parameters with intervals,
        errors and coverage on the runs held out, and how the training went.

    Raises:
        DataError: the data cannot be used, or are too few.
        ConfigError: an unknown name, an option out of range, or choices that do not fit.
        NonFiniteError: the optimisation left the finite numbers.

    Example:
        >>> import nsde_torch
        >>> made = nsde_torch.simulate("mass_spring_damper", durations=[6.0] * 3, seed=1)
        >>> model = nsde_torch.train(made, system="mass_spring_damper", model="sysid", say=False)
        >>> sorted(model.metrics["parameters"])
        ['force_gain', 'linear_spring.stiffness', 'viscous_friction.damping']
    """
    machine_options = system_options(system, effects=effects, declared=declared, parameters=parameters)
    machine = machine_options.make()
    runs = read(data, system=machine)
    other = None if test_data is None else read(test_data, system=machine)
    parts = split_runs(runs, test, test_data=other)
    losses = named_options("loss", loss, LOSSES)
    choice = Choice(
        options=model_options(model),
        system=machine_options,
        machine=machine,
        runs=parts.train,
        loss=losses.kind,
        integrator=integrator_options(solver),
    )
    spec = model_kind(choice.options.kind).make_spec(choice)
    if isinstance(dtype, str):
        if dtype not in DTYPES:
            raise ConfigError(f"`dtype` must be {' or '.join(DTYPES)}; got {dtype!r}.")
        dtype = DTYPES[dtype]
    began = time.time()
    with tempfile.TemporaryDirectory() if run_dir is None else nullcontext(run_dir) as folder:
        try:
            Training(
                spec=spec,
                data=runs,
                split=parts,
                loss=machine_losses(losses, machine_options),
                options=named_options("trainer", trainer, TRAINERS),
                validation=validation,
                seed=seed,
                run_dir=folder,
                values=machine_options.values,
                device=device,
                dtype=dtype,
                about=about,
                say=say,
                verbose=verbose,
                other_sensors=other is not None,
                instruments=list(instruments),
                kept=run_dir is not None,
            ).run()
        except KeyboardInterrupt:
            weights = Path(folder) / WEIGHTS
            if not weights.is_file() or weights.stat().st_mtime < began:  # of this training
                raise
            if say:
                say("stopped: the model is fitted; its intervals are not calibrated, and it is not tested")
        made = load(folder, device=device)
    if run_dir is None:
        made.folder = None
    return made
