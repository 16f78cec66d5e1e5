"""Flights on PX4: the link, what is known of the machine, the controller where it runs, and how a flight ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from nsde_torch.control.loop import DECLARED, knowledge, system_of
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.effects import files
from nsde_torch.errors import ConfigError
from nsde_torch.export.exported import ExportedController
from nsde_torch.px4 import SetpointLimits
from nsde_torch.px4.flight.cascade import CascadeController, PathPoints
from nsde_torch.px4.flight.controller import Inline, Process, Runner
from nsde_torch.px4.flight.predictive import LEAD, PredictiveMaker, check_uncovered, without_covered
from nsde_torch.px4.flight.safety import REFUSED, FlightOutcome, Limits
from nsde_torch.px4.link import connection as links
from nsde_torch.px4.link.codec import signing_key
from nsde_torch.px4.link.connection import LinkError
from nsde_torch.systems import Multirotor

from . import build, track_build
from .exit_status import FLIGHT_ENDED, INTERRUPTED, NOT_LANDED, EndedError
from .hydra_command import say
from .own_modules import see_own_modules
from .schemas import MpcConfig

if TYPE_CHECKING:
    from nsde_torch.models import Model
    from nsde_torch.px4.simulator.body import Body
    from nsde_torch.systems import System

_UNUSED = ("motor_latency", "force_time", "moment_time")


def known(config: DictConfig) -> Model | System:
    """What is known of the machine, for `run=pid` too: its declared physics."""
    given = [name for name in _UNUSED if config.mpc[name] != getattr(MpcConfig, name)]
    if given:
        raise ConfigError(
            f"`mpc.{given[0]}` is of `nsde track`; a flight on PX4 makes up for latency by `delay`, and for what lasts "
            "by moving the reference."
        )
    run = DECLARED if config.run == track_build.PID else config.run
    if track_build.is_exported(run):
        file = ExportedController(run)
        track_build.agreed(file, config.mpc)
        check_uncovered(file.known)
        return file.known
    see_own_modules(Path(run))
    found = without_covered(knowledge(run, config.system.name, effects=_effects(config)))
    if not isinstance(system_of(found), Multirotor):
        raise ConfigError(
            f"PX4 flies multirotors here (hexacopter, quadrotor); the machine of run={config.run} is a "
            f"{system_of(found).name}."
        )
    return found


def _effects(config: DictConfig) -> list[Any]:
    """Effects that run=declared has beside the declared physics, those of files in the place of their names."""
    given = build.options(config.system)["effects"] if config.run == DECLARED else ()
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
    """The controller where it runs: a cascade (for a check too) in the loop, else in a process of its own."""
    if config.run == track_build.PID or config.check:
        lead = {} if config.lead is None else {"lead": config.lead}
        return Inline(CascadeController(path, **lead))
    return predictive(
        config,
        reference.path,
        run=config.run,
        system=config.system.name,
        effects=_effects(config),
        lead=LEAD if config.lead is None else config.lead,
    )


# --- the link to a vehicle, the vehicle, and how a flight ended -------------------------------------------------------


def key(config: DictConfig) -> bytes | None:
    """The signing key of the group `link`; ConfigError where the file is not there or empty."""
    if config.key_file is None:
        return None
    file = Path(config.key_file)
    if not file.is_file():
        raise ConfigError(f"`link.key_file`: {file} does not exist; expected a file with the signing key.")
    return signing_key(file.read_text(encoding="utf-8").strip())


def connection(config: DictConfig) -> Callable[[], links.Link]:
    """What opens the link of the group `link`, whose signing key is read now: before anything is connected to."""
    return partial(links.open_link, config.url, expose=config.expose, target=config.system, key=key(config))


def body(plant: DictConfig, *, seed: int) -> Body:
    """The group `plant` as what a simulated vehicle flies; ConfigError for options that it does not have."""
    from nsde_torch.px4.simulator.body import Body

    if plant.kind == "learned" or plant.dt is not None or plant.state_latency:
        raise ConfigError(
            "a vehicle is plant=hexacopter or plant=quadrotor, without plant.dt and plant.state_latency (which nsde "
            "close-loop has with by=plant)."
        )
    given = build.options(plant)
    how = {name: given[name] for name in ("effects", "declared_only", "process_noise", "latency")}
    return Body(plant.system or "hexacopter", seed=seed, **how)


def limits(config: DictConfig) -> Limits:
    """The group `limits`; ConfigError for a fence that is none."""
    return Limits(**{**build.shared(Limits, config), "fence": build.fence(config, "limits")})


def setpoints(config: DictConfig) -> SetpointLimits:
    """Bounds of the commands that are sent, of the group `limits`; ConfigError for a throttle that is no pair."""
    given = build.shared(SetpointLimits, config)
    if len(given["throttle"]) != 2 or not given["throttle"][0] < given["throttle"][1]:
        raise ConfigError(f"`limits.throttle` takes [lowest, highest]; got {config.throttle}.")
    return SetpointLimits(**{**given, "tilt": radians(max(config.tilt - 5.0, 5.0))})


_STOPPED = ("stop", "stopped")
_TAKEN = ("mode", "setpoints", "disarmed", "link", "late")
"""Troubles after which the vehicle was the operator's or PX4's, and not ours."""


def check_end(outcome: FlightOutcome, *, whole: bool = False) -> None:
    """Pass a flight that was flown by us alone and is seen to stand, whatever limit it may have tripped.

    With `whole` it must have been flown to its end, too. LinkError: it was refused before it began. EndedError: it
    was not seen to land, was stopped, or the vehicle was taken from us.
    """
    trouble = outcome.trouble
    if trouble is not None and trouble.kind == REFUSED:
        raise LinkError(trouble.text)
    why = "the reference was not flown to its end" if trouble is None else trouble.text
    stopped = trouble is not None and trouble.kind in _STOPPED
    if stopped and not outcome.begun:
        raise EndedError(f"the flight was stopped before it began: {why}", INTERRUPTED)
    if not outcome.landed:
        raise EndedError(f"the vehicle was NOT seen to land: {why}", NOT_LANDED)
    if stopped:
        raise EndedError(f"the flight was stopped, and landed: {why}", INTERRUPTED)
    if (trouble is not None and trouble.kind in _TAKEN) or (whole and (trouble or not outcome.tracked)):
        raise EndedError(f"the flight went wrong, and landed: {why}", FLIGHT_ENDED)
