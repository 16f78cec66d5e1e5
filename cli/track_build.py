"""From the configuration of `nsde track` to references, plants and autopilots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from nsde_torch.control.loop import DECLARED, system_of
from nsde_torch.control.loop import knowledge as knowledge_of
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.control.shapes import from_csv, waypoints
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError
from nsde_torch.models import Model
from nsde_torch.models.run_directory import load
from nsde_torch.simulation import make_plant
from nsde_torch.simulation.learned_plant import LearnedPlant
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.machines import machine

from . import build
from .own_modules import see_own_modules

if TYPE_CHECKING:
    from nsde_torch.control.loop import SteppedMachine
    from nsde_torch.export.exported import ExportedController

Say = Callable[[str], None]
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
    return Reference(_PATHS[config.kind](**build.options(config, "kind", "check", "tilt_limit")))


_IN_FILES = (
    *("horizon", "steps", "state_weights", "input_weight", "input_centre", "rate_weight", "speed_limit"),
    *("tilt_limit", "fence", "limit_weight", "uncertainty_weight", "particles", "iterations", "tolerance"),
    *("deadline", "keep", "jump"),
)
"""Keys of `mpc` that are fixed when a controller is exported."""
_MOTOR_LATENCY = 0.02  # measured best on machines whose motors lag 50 ms
_LAGS = {"motor_lag", "actuator_lag", "input_delay"}


def knowledge(name: str, config: DictConfig, *, command: str) -> Model | System:
    """What `run=` names, a model or the declared physics of the plant; ConfigError for no multirotor, or no machine."""
    if is_exported(name):
        return exported(name).known
    if name == DECLARED and config.system is None:
        raise ConfigError("`run=declared` needs the machine: plant=hexacopter or plant.system=NAME.")
    see_own_modules(Path(name))
    known = knowledge_of(name, config.system or "")
    if not isinstance(system_of(known), Multirotor):
        raise ConfigError(
            f"`nsde {command}` is for multirotors (hexacopter, quadrotor); the machine of run={name} is a "
            f"{system_of(known).name}. What its model predicts: nsde evaluate run=DIR."
        )
    return known


def plant(config: DictConfig, known: Model | System, *, seed: int) -> SteppedMachine:
    """The group `plant`; ConfigError for another machine than the model's, or an option that it does not have."""
    generator = torch.Generator().manual_seed(seed)
    own = system_of(known)
    if config.kind == "learned":
        flown = known if config.run is None else load(config.run)
        if isinstance(flown, System):
            raise ConfigError("`plant=learned` needs a model: name its run directory with plant.run=DIR.")
        spec = machine(flown.system.name)
        return LearnedPlant(
            flown,
            dt=config.dt or spec.dt,
            generator=generator,
            sensor_std=spec.sensor_std,
            process_noise=config.process_noise,
            sensor_noise=config.sensor_noise,
            latency=config.latency,
            limits=spec.limits or (0.0, 1.0),
        )
    name = config.system or own.name
    if name != own.name:
        raise ConfigError(f"the model is of a {own.name}, and plant.system={name}. Take plant={own.name}.")
    return make_plant(
        name,
        generator=generator,
        effects=build.options(config)["effects"],
        declared_only=config.declared_only,
        process_noise=config.process_noise,
        sensor_noise=config.sensor_noise,
        latency=config.latency,
        dt=config.dt,
        check=False,
    )


def envelope(config: DictConfig, path: Reference, known: Model | System) -> feasible.Envelope:
    """What a reference asks for; ConfigError where the machine cannot do it, unless that is not to be checked."""
    options = problem(config.mpc)
    predictor = Predictor(known, dt=options.dt)
    if not config.reference.check:
        return feasible.envelope(path, predictor)
    tilt = config.reference.tilt_limit
    return feasible.check(path, predictor, low=options.low, high=options.high, tilt=tilt)


def problem(config: DictConfig) -> ProblemOptions:
    """What a plan pays for."""
    given = build.shared(ProblemOptions, config)
    limits = {name: inf if given[name] is None else given[name] for name in ("speed_limit", "tilt_limit")}
    fence = None if config.fence is None else build.fence(config, "mpc")
    return ProblemOptions(**{**given, **limits, "state_weights": tuple(config.state_weights), "fence": fence})


def solver(config: DictConfig) -> SolverOptions:
    """How plans are looked for."""
    return SolverOptions(**{**build.shared(SolverOptions, config), "name": config.solver})


def safety(config: DictConfig) -> SafetyOptions:
    """What a controller does about trouble."""
    return SafetyOptions(keep=config.keep, jump=config.jump)


def autopilot(
    name: str,
    known: Model | System,
    config: DictConfig,
    path: Reference,
    *,
    batch: int,
    sample: float,
    say: Say,
) -> Autopilot:
    """A controller by its name: `pid`, or the predictive one with what is known of the machine."""
    mpc, flown = config.mpc, config.plant
    if name == PID:
        return CascadePilot(system_of(known), path, batch=batch, period=sample)
    controller: Planner
    foresight: Model | System | Foresight = known
    if is_exported(name):
        if batch != 1:
            raise ConfigError(f"a file flies one machine at a time; got at_once={batch}. Take at_once=1.")
        controller = file = exported(name)
        agreed(file, mpc)
        foresight = file.sample
    else:
        controller = Controller(
            known, problem=problem(mpc), solver=solver(mpc), safety=safety(mpc), batch=batch, say=say
        )
    return PredictivePilot(
        controller,
        foresight,
        path,
        period=mpc.period,
        sample=sample,
        estimator=estimator(mpc, latency=latency(config, known), sample=sample),
        state_latency=flown.state_latency,
        say=say,
    )


def estimator(config: DictConfig, *, latency: float, sample: float) -> EstimatorOptions:
    """Options of the estimator: the latency, in whole samples, and how fast pushes are learned."""
    return EstimatorOptions(
        latency=round(latency / sample) * sample, force_time=config.force_time, moment_time=config.moment_time
    )


def latency(config: DictConfig, known: Model | System) -> float:
    """Time from a measurement to the effect of the command that follows from it [s]."""
    flown = config.plant
    return float(flown.latency + flown.state_latency + _motor_latency(config.mpc, known))


def _motor_latency(mpc: DictConfig, known: Model | System) -> float:
    """Stands for the lag of motors [s] where the model does not have it."""
    if mpc.motor_latency is not None:
        return float(mpc.motor_latency)
    return 0.0 if _LAGS & set(system_of(known).effect_names) else _MOTOR_LATENCY


def is_exported(name: str) -> bool:
    """Whether a name in the place of a run directory is a file that `nsde export` wrote."""
    return Path(name).is_file()


def exported(name: str) -> ExportedController:
    """The controller in a file; ExportError where that is damaged, changed or of another version."""
    from nsde_torch.export.exported import ExportedController

    return ExportedController(name)


def agreed(file: ExportedController, mpc: DictConfig) -> None:
    """Refuse settings of `mpc` that somebody gave and that a file does not have: nothing would come of them."""
    from .schemas.control import MpcConfig

    def settings(config: DictConfig) -> dict[str, Any]:
        found = {**asdict(problem(config)), **asdict(solver(config)), **asdict(safety(config))}
        return {**found, "solver": found.pop("name")}

    given, plain = settings(mpc), settings(OmegaConf.structured(MpcConfig))
    kept = {**asdict(file.options), **asdict(file.solver.options), **asdict(file.safety)}
    kept["solver"] = kept.pop("name")
    for name in (*_IN_FILES, "solver"):
        if given[name] not in (plain[name], kept[name]):
            raise ConfigError(
                f"`mpc.{name}` is {given[name]} here, and {file.path} was exported with {kept[name]}, which is what it "
                "does. Leave it out, or export anew."
            )


def label(name: str) -> str:
    """How a controller is called in tables and figures."""
    return {PID: "PID cascade", DECLARED: "MPC, declared physics"}.get(name, f"MPC, {Path(name).name}")
