"""From the configuration of `nsde fly` to what is known of the machine, and to the controller where it runs."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from nsde_torch.control.loop import DECLARED, knowledge, system_of
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.effects import files
from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight.path import CascadeController, PathPoints
from nsde_torch.px4.flight.predictive import LEAD, PredictiveMaker, check_uncovered, without_covered
from nsde_torch.px4.flight.runner import Inline, Process, Runner
from nsde_torch.systems import Multirotor

from . import build, track_build
from .hydra_command import say
from .own_modules import see_own_modules

if TYPE_CHECKING:
    from nsde_torch.models import Model
    from nsde_torch.systems import System

_UNUSED = ("motor_latency", "force_time", "moment_time")


def known(config: DictConfig) -> Model | System:
    """What is known of the machine, for `run=pid` too: its declared physics.

    Raises:
        ConfigError: no multirotor, or keys of `mpc` that a flight on PX4 does not have.
        CheckpointError: no such run directory.
    """
    plain = build.options(config.mpc)
    from .schemas import MpcConfig

    given = [name for name in _UNUSED if plain[name] != getattr(MpcConfig(), name)]
    if given:
        raise ConfigError(
            f"`mpc.{given[0]}` is of `nsde track`; a flight on PX4 makes up for latency by `delay`, and for what lasts "
            "by moving the reference."
        )
    run = DECLARED if config.run == track_build.PID else config.run
    if track_build.is_exported(run):
        file = track_build.exported(run)
        track_build.agreed(file, config.mpc)
        check_uncovered(file.known)
        return file.known
    see_own_modules(Path(run))
    effects = _effects(config) if config.run == DECLARED else ()
    found = without_covered(knowledge(run, config.system.name, effects=effects))
    if not isinstance(system_of(found), Multirotor):
        raise ConfigError(
            f"PX4 flies multirotors here (hexacopter, quadrotor); the machine of run={config.run} is a "
            f"{system_of(found).name}."
        )
    return found


def _effects(config: DictConfig) -> list[Any]:
    """Effects that the declared physics has beside it, those of files in the place of their names."""
    given = build.options(config.system)["effects"]
    out: list[Any] = []
    for entry in [given] if isinstance(given, str) else given:
        if isinstance(entry, str) and files.is_file(entry):
            out += [{name: values} for name, values in files.read_for(entry, config.system.name).items()]
        else:
            out.append(entry)
    return out


def predictive(
    config: DictConfig, path: FlightPath, *, run: str, system: str, effects: Sequence[Any], lead: float
) -> Process:
    """The predictive controller of a flight, which is made in a process of its own."""
    maker = PredictiveMaker(
        run=run,
        system=system,
        path=path,
        **track_build.planning(config.mpc),
        delay=config.delay,
        lead=lead,
        tilt=radians(config.limits.tilt),
        effects=effects,
        threads=config.threads,
    )
    return Process(maker, period=config.mpc.period, say=say)


def runner(config: DictConfig, path: PathPoints, reference: Reference) -> Runner:
    """The controller, where it runs: a cascade in the loop, the predictive one in a process of its own.

    A check flies nothing, and waits for no solver to be compiled.
    """
    if config.run == track_build.PID or config.check:
        lead = {} if config.lead is None else {"lead": config.lead}
        return Inline(CascadeController(path, **lead))
    return predictive(
        config,
        reference.path,
        run=config.run,
        system=config.system.name,
        effects=_effects(config) if config.run == DECLARED else (),
        lead=LEAD if config.lead is None else config.lead,
    )
