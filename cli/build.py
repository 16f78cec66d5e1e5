"""From a checked configuration to the objects of the library; the only file that knows both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nsde_torch.data import DataSet, Split, SystemInfo, read
from nsde_torch.data import split as split_runs
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.learning import filter_reach
from nsde_torch.learning.options import LossOptions, TrainerOptions
from nsde_torch.models import EnsembleSpec, ModelSpec, SDESpec, SysidSpec
from nsde_torch.plants import simulated
from nsde_torch.sde import Step, make_step
from nsde_torch.systems import System, make_system

# Keys of a data configuration that are not arguments of the function that makes the data.
_NOT_FOR_DATA = ("kind", "test", "test_path", "validation", "options", "instruments")


def settings(config: DictConfig, *, sweep: bool) -> tuple[torch.device, torch.dtype]:
    """Set the number of threads; return device and precision.

    Args:
        config: The configuration, with `device`, `dtype` and `threads`.
        sweep: Whether this is a job of a sweep, which has one thread whatever `threads` says.

    Raises:
        ConfigError: The device is unknown or not there.
    """
    torch.set_num_threads(1 if sweep else config.threads)
    return make_device(config.device), {"float32": torch.float32, "float64": torch.float64}[config.dtype]


def make_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        ConfigError: There is no such device here.
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"`device` must be cpu, cuda or cuda:N; got {name!r}.") from None
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"`device` must be cpu, cuda or cuda:N; got {name!r}.")
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise ConfigError(
                f"`device={name}`, but torch {torch.__version__} sees no CUDA device. Use device=cpu."
            )
        if device.index is not None and device.index >= torch.cuda.device_count():
            raise ConfigError(
                f"`device={name}`, but there are {torch.cuda.device_count()} CUDA devices (0 first)."
            )
    return device


def options(config: DictConfig, *left_out: str) -> dict[str, Any]:
    """A part of the configuration as keyword arguments."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items() if key not in left_out}


def system(config: DictConfig) -> System:
    """The machine of the group `system`.

    Raises:
        ConfigError: There is no such system, effect, parameter or option.
    """
    return make_system(
        config.name,
        effects=list(config.effects),
        declared=None if config.declared is None else list(config.declared),
        values=parameter_values(config),
        **options(config)["options"],
    )


def parameter_values(config: DictConfig) -> dict[str, Any]:
    """Initial values of declared parameters, `name` or `effect.name`, from the group `system`."""
    return dict(_dotted(options(config)["parameters"]))


def _dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """`{effect: {name: 1}}`, as an override with dots makes it, as `effect.name`."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def dataset(config: DictConfig, machine: SystemInfo) -> DataSet:
    """Read or simulate the runs.

    Args:
        config: The group `data`.
        machine: The system that the runs are of.

    Raises:
        DataError: The data cannot be used.
        ConfigError: An option is wrong.
    """
    given = options(config, *_NOT_FOR_DATA)
    if config.kind == "simulated":
        return simulated(machine, **given, **options(config.options))
    return read(config.kind, machine, **given)


def other_dataset(config: DictConfig, machine: SystemInfo) -> DataSet:
    """Read the runs of `data.test_path`, as those of `data.path` are read.

    Raises:
        DataError: The data cannot be used.
    """
    return read(config.kind, machine, **{**options(config, *_NOT_FOR_DATA), "path": config.test_path})


def split(config: DictConfig, data: DataSet, machine: SystemInfo) -> Split:
    """Training runs and runs held out for the test; `data.test` names them by index or name.

    With `data.test_path` all runs train (those that `data.test` names are left out), and the runs of that file or
    folder are the test.

    Raises:
        DataError: There is no such run, no run is left on a side, or one is on both.
    """
    test = None if config.test is None else list(config.test)
    if config.test_path is None:
        return split_runs(data, test)
    left = split_runs(data, test or [])
    other = other_dataset(config, machine)
    train = {run.content_hash: run.name for run in left.train}
    for run in other.runs:
        if run.content_hash in train:
            raise DataError(
                f"`data.test_path`: run {run.name!r} has the same content as the training run "
                f"{train[run.content_hash]!r}; a test on training data says nothing."
            )
    return Split(train=left.train, test=tuple(other.runs))


def model_spec(config: DictConfig, machine: System, runs: Split) -> ModelSpec:
    """What the model is made of; a null of the group `system` is the system's own constant.

    Args:
        config: The whole configuration.
        machine: The system that it names.
        runs: Training and test runs; whether the inputs were smoothed is read from the training runs.
    """
    system, own = config.system, machine.defaults
    common = {
        "kind": config.model.kind,
        "effects": tuple(system.effects),
        "declared": None if system.declared is None else tuple(system.declared),
        "system_options": options(system)["options"],
        "dt": own.dt if system.dt is None else system.dt,
        "horizon": own.horizon if system.horizon is None else system.horizon,
    }
    return _SPECS[config.model.kind](config, machine, runs, common)


def _sde_spec(config: DictConfig, machine: System, runs: Split, common: dict[str, Any]) -> ModelSpec:
    model, own = options(config.model), machine.defaults
    solver = step(config.solver, machine, kind=model["kind"], loss=config.loss.kind)
    paper = config.loss.kind == "paper"
    physics = model["kind"] != "blackbox_nsde"
    innovations = physics and config.loss.kind == "innovations"
    plain = paper or solver.deterministic
    learned = (model.get("sigma") or ("declared" if paper else "learned")) == "learned"
    declared = None if learned else tuple(own.sigma_max)
    widths: dict[str, Any] = {k: tuple(v) for k, v in model.items() if k.endswith("_hidden")}

    def choice(key: str, default: Any) -> Any:
        return default if model.get(key) is None else model[key]

    return SDESpec(
        system=config.system.name,
        **common,
        **widths,
        step=solver.name,
        solver=options(config.solver, "name"),
        physics=physics,
        sigma_max=declared if config.system.sigma_max is None else tuple(config.system.sigma_max),
        filter_reach=model["filter_reach"]
        if model["filter_reach"] is not None
        else 0
        if paper
        else filter_reach(runs.train, machine.nu, common["dt"]),
        measurement=choice("measurement", not plain and (innovations or machine.sensor_noise)),
        disturbance=physics and choice("disturbance", not plain and bool(machine.disturbed_ports)),
        learn_lag=innovations and model["learn_lag"],
        loss=config.loss.kind,
    )


def _ensemble_spec(config: DictConfig, machine: System, runs: Split, common: dict[str, Any]) -> ModelSpec:
    model = options(config.model, "kind", "hidden")
    return EnsembleSpec(system=config.system.name, hidden=tuple(config.model.hidden), **common, **model)


def _sysid_spec(config: DictConfig, machine: System, runs: Split, common: dict[str, Any]) -> ModelSpec:
    solver = step(config.solver, machine, kind=config.model.kind)
    reach = filter_reach(runs.train, machine.nu, common["dt"])
    # Restored inputs lack what is fast: weights by the noise would trust them most where they tell least.
    method = config.model.method or ("differences" if reach else "weak")
    return SysidSpec(
        system=config.system.name,
        **common,
        method=method,
        filter_reach=reach,
        max_iterations=config.model.max_iterations,
        step=solver.name,
        solver=options(config.solver, "name"),
    )


_SpecMaker = Callable[[DictConfig, System, Split, dict[str, Any]], ModelSpec]
_SPECS: dict[str, _SpecMaker] = {
    **dict.fromkeys(SDESpec.kinds, _sde_spec),
    "ensemble": _ensemble_spec,
    "sysid": _sysid_spec,
}


def loss_options(config: DictConfig) -> LossOptions:
    """Weights of the losses; radius and reward that belong to the machine come from the group `system`."""
    given = options(config.loss)
    if given["mu"] is None:
        given["mu"] = config.system.lambda_mu
    return LossOptions(ball_radius=config.system.ball_radius, **given)


def trainer_options(config: DictConfig) -> TrainerOptions:
    """Settings of the optimisation."""
    return TrainerOptions(**options(config))


def step(config: DictConfig, machine: System, *, kind: str = "nsde", loss: str = "replay") -> Step:
    """The integrator of the group `solver`; null is the system's own, and rk4 for a model without diffusion.

    A model of innovations has the parameters of the machine, not those that make up for a coarse step: its own is one
    of second order in the drift.

    Raises:
        ConfigError: There is no such integrator, or it does not fit the kind of model.
    """
    own = "milstein_heun" if loss == "innovations" and kind == "nsde" else machine.defaults.step
    own = "rk4" if kind in ("node", "sysid") else own
    made = make_step(config.name or own, **options(config, "name"))
    if kind in ("node", "sysid") and not made.deterministic:
        raise ConfigError(
            f"`model={kind}` has no diffusion, and solver={made.name} is for equations with noise. "
            "Take solver=rk4, midpoint or torchdiffeq, or leave it out."
        )
    if kind == "blackbox_nsde" and made.deterministic:
        raise ConfigError(
            f"`model=blackbox_nsde` has a diffusion, which solver={made.name} would leave out; choose a "
            "solver for equations with noise, or leave it out."
        )
    return made
