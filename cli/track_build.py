"""From the configuration of `nsde track` to references, plants and autopilots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nsde_torch.control import feasible, shapes
from nsde_torch.control.autopilots import (
    Autopilot,
    CascadePilot,
    EstimatorOptions,
    Foresight,
    PredictivePilot,
)
from nsde_torch.control.controller import Controller, Planner, SafetyOptions
from nsde_torch.control.loop import DECLARED, SteppedMachine, system_of
from nsde_torch.control.loop import knowledge as knowledge_of
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions, problem_of
from nsde_torch.control.reference import FlightPath, Reference, StateReference, course, setpoint
from nsde_torch.control.shapes import from_csv, waypoints
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError
from nsde_torch.export.exported import ExportedController
from nsde_torch.models import Model
from nsde_torch.models.run_directory import load
from nsde_torch.simulation import make_plant
from nsde_torch.simulation.plant import LearnedPlant
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.machines import machine

from . import build
from .hydra_command import say
from .own_modules import see_own_modules
from .schemas import MpcConfig

PID = "pid"

_PATHS: Mapping[str, Callable[..., FlightPath]] = {
    "circle": shapes.circle,
    "lemniscate": shapes.lemniscate,
    "hover": shapes.hover,
    "waypoints": waypoints,
    "csv": lambda *, path, **rest: from_csv(path, **rest),
}


def reference(config: DictConfig) -> Reference:
    """The group `reference`; ConfigError for a size that makes no path."""
    if config.kind == "setpoint":
        raise ConfigError(
            "a multirotor flies paths: take reference=hover, waypoints, csv, circle or lemniscate."
        )
    return Reference(_PATHS[config.kind](**build.options(config, "kind", "check", "tilt_limit")))


def any_reference(config: DictConfig, system: System) -> StateReference:
    """The group `reference` for a machine; ConfigError for a flight of one that does not fly."""
    if isinstance(system, Multirotor):
        return reference(config)
    if config.kind == "setpoint":
        return set_to("reference.states", build.options(config)["states"], system, duration=config.duration)
    if config.kind == "csv":
        return course(system, config.path)
    raise ConfigError(
        f"reference={config.kind} is a flight, and the machine is a {system.name}. Take reference=setpoint with "
        f"reference.states={{{system.state_names[0]}: 0}}, or reference=csv with reference.path=FILE."
    )


def set_to(key: str, states: Any, system: System, *, duration: float = 1.0) -> StateReference:
    """The value of a key that takes states with values; ConfigError for any other."""
    if not (isinstance(states, dict) and all(type(v) in (int, float) for v in states.values())):
        raise ConfigError(f"`{key}` takes {{state: value}}; got {states!r}.")
    return setpoint(system, states, duration=duration)


_NOT_IN_FILES = ("compile", "cache")  # of the keys of `mpc`; others are fixed when a controller is exported
_MOTOR_LATENCY = 0.02  # measured best on machines whose motors lag 50 ms
_LAGS = {"motor_lag", "actuator_lag", "asymmetric_lag", "input_delay"}


def knowledge(name: str, config: DictConfig, beside: Model | System | None = None) -> Model | System:
    """What `run=` names: a model, or the declared physics of the plant, whose machine may be that of `beside`."""
    if is_exported(name):
        return ExportedController(name).known
    machine_name = config.system or (beside.spec.system if isinstance(beside, Model) else None)
    if name == DECLARED and machine_name is None:
        raise ConfigError("`run=declared` needs the machine: plant=hexacopter or plant.system=NAME.")
    see_own_modules(Path(name))
    return knowledge_of(name, machine_name or "")


def machine_name(config: DictConfig, known: Model | System) -> str:
    """Name of the machine of the group `plant`; ConfigError for another machine than the model's."""
    own = system_of(known)
    # a model names a class of the user's own as `module:Class`
    mine = own.name if isinstance(known, System) else known.spec.system
    name = str(config.system or mine)
    if name.rpartition(":")[2] not in (own.name, mine.rpartition(":")[2], type(own).__name__):
        fits = own.name if isinstance(own, Multirotor) else "own"
        raise ConfigError(f"the model is of a {own.name}, and plant.system={name}. Take plant={fits}.")
    return name


def plant(config: DictConfig, known: Model | System, *, seed: int) -> SteppedMachine:
    """The group `plant`; ConfigError for another machine than the model's, or an option that it does not have."""
    how: dict[str, Any] = {
        "generator": torch.Generator().manual_seed(seed),
        **{name: config[name] for name in ("process_noise", "sensor_noise", "latency")},
    }
    if config.kind == "learned":
        flown = known if config.run is None else load(config.run)
        if isinstance(flown, System):
            raise ConfigError("`plant=learned` needs a model: name its run directory with plant.run=DIR.")
        if build.options(config)["effects"] or config.declared_only:
            raise ConfigError(
                "plant=learned is the model itself: plant.effects and declared_only are of machines."
            )
        spec = machine(flown.spec.system)
        limits = (0.0, 1.0) if isinstance(flown.system, Multirotor) else spec.limits
        return LearnedPlant(flown, dt=config.dt or spec.dt, sensor_std=spec.sensor_std, limits=limits, **how)
    effects, bare = build.options(config)["effects"], config.declared_only
    name = machine_name(config, known)
    return make_plant(name, effects=effects, declared_only=bare, dt=config.dt, check=False, **how)


def envelope(config: DictConfig, path: Reference, known: Model | System) -> feasible.Envelope:
    """What a reference asks for; ConfigError where the machine cannot do it, unless that is not to be checked."""
    options = problem(config.mpc, system_of(known))
    predictor = Predictor(known, dt=options.dt)
    if not config.reference.check:
        return feasible.envelope(path, predictor)
    return feasible.check(path, predictor, options, tilt=config.reference.tilt_limit)


def problem(config: DictConfig, system: System | None = None) -> ProblemOptions:
    """What a plan pays for, of a machine; None: with what is not given as a multirotor has it."""
    given = {k: v for k, v in build.shared(ProblemOptions, config).items() if v is not None}
    if "fence" in given:
        given["fence"] = build.fence(config, "mpc", 3 if isinstance(system, Multirotor) else None)
    return ProblemOptions(**given) if system is None else problem_of(system, **given)


def planning(config: DictConfig, system: System | None = None) -> dict[str, Any]:
    """The group `mpc` as arguments of a controller: what a plan pays for, how it is looked for, what trouble does."""
    return {
        "problem": problem(config, system),
        "solver": SolverOptions(**{**build.shared(SolverOptions, config), "name": config.solver}),
        "safety": SafetyOptions(**build.shared(SafetyOptions, config)),
    }


def autopilot(
    name: str, known: Model | System, config: DictConfig, path: StateReference, *, batch: int, sample: float
) -> Autopilot:
    """A controller by its name: `pid`, or the predictive one with what is known of the machine."""
    mpc = config.mpc
    if abs(sample * max(1, round(mpc.period / sample)) - mpc.period) > 1e-6:
        raise ConfigError(
            f"`mpc.period` must be a multiple of {sample:g} s, the sample of the plant; got {mpc.period:g} s."
        )
    if name == PID:
        assert isinstance(path, Reference)  # the command has seen to it
        return CascadePilot(system_of(known), path, batch=batch, period=sample)
    controller: Planner
    foresight: Model | System | Foresight = known
    if is_exported(name):
        if batch != 1:
            raise ConfigError(f"a file flies one machine at a time; got at_once={batch}. Take at_once=1.")
        controller = file = ExportedController(name)
        agreed(file, mpc)
        foresight = file.sample
    else:
        controller = Controller(known, **planning(mpc, system_of(known)), batch=batch, say=say)
    return PredictivePilot(
        controller,
        foresight,
        path,
        period=mpc.period,
        sample=sample,
        estimator=estimator(mpc, latency=latency(config, known), sample=sample),
        state_latency=config.plant.state_latency,
        say=say,
    )


def estimator(config: DictConfig, *, latency: float, sample: float) -> EstimatorOptions:
    """Options of the estimator: the latency, in whole samples, and how fast pushes are learned."""
    return EstimatorOptions(
        latency=round(latency / sample) * sample, force_time=config.force_time, moment_time=config.moment_time
    )


def latency(config: DictConfig, known: Model | System) -> float:
    """Time from a measurement to the effect of the command that follows from it [s]."""
    flown, system, motors = config.plant, system_of(known), config.mpc.motor_latency
    if motors is None:  # the lag of motors, where the model does not have it
        lagless = isinstance(system, Multirotor) and not _LAGS & set(system.effect_names)
        motors = _MOTOR_LATENCY if lagless else 0.0
    return float(flown.latency + flown.state_latency + motors)


def is_exported(name: str) -> bool:
    """Whether a name in the place of a run directory is a file that `nsde export` wrote."""
    return Path(name).is_file()


def agreed(file: ExportedController, mpc: DictConfig) -> None:
    """Refuse settings of `mpc` that somebody gave and that a file does not have: nothing would come of them."""

    def settings(*parts: Any) -> dict[str, Any]:
        found = {name: value for part in parts for name, value in asdict(part).items()}
        return {**found, "solver": found.pop("name")}

    given = settings(*planning(mpc).values())
    plain = settings(*planning(OmegaConf.structured(MpcConfig)).values())
    kept = settings(file.options, file.solver, file.safety)
    for name, value in given.items():
        if name not in _NOT_IN_FILES and value not in (plain[name], kept[name]):
            raise ConfigError(
                f"`mpc.{name}` is {value} here, and {file.path} was exported with {kept[name]}, which is what it "
                "does. Leave it out, or export anew."
            )


def label(name: str) -> str:
    """How a controller is called in tables and figures."""
    return {PID: "PID cascade", DECLARED: "MPC, declared physics"}.get(name, f"MPC, {Path(name).name}")
