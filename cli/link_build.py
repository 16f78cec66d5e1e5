"""The link to a vehicle: its settings, and how a flight ended."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight.phases import REFUSED, FlightOutcome
from nsde_torch.px4.flight.safety import Limits
from nsde_torch.px4.flight.setpoint import SetpointLimits
from nsde_torch.px4.link import connection as links
from nsde_torch.px4.link.codec import signing_key
from nsde_torch.px4.link.transport import LinkError

from . import build
from .exit_status import FLIGHT_ENDED, INTERRUPTED, NOT_LANDED, EndedError

if TYPE_CHECKING:
    from nsde_torch.px4.simulator.body import Body


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
    return Body(
        plant.system or "hexacopter",
        seed=seed,
        effects=build.options(plant)["effects"],
        declared_only=plant.declared_only,
        process_noise=plant.process_noise,
        latency=plant.latency,
    )


def limits(config: DictConfig) -> Limits:
    """The group `limits`; ConfigError for a fence that is none."""
    return Limits(**{**build.shared(Limits, config), "fence": build.fence(config, "limits")})


def setpoints(config: DictConfig) -> SetpointLimits:
    """Bounds of the commands that are sent, of the group `limits`; ConfigError for a throttle that is no pair."""
    throttle = tuple(config.throttle)
    if len(throttle) != 2 or not throttle[0] < throttle[1]:
        raise ConfigError(f"`limits.throttle` takes [lowest, highest]; got {list(throttle)}.")
    return SetpointLimits(
        rate=config.rate,
        yaw_rate=config.yaw_rate,
        throttle=(throttle[0], throttle[1]),
        tilt=radians(max(config.tilt - 5.0, 5.0)),
    )


_STOPPED = ("stop", "stopped")
_TAKEN = ("mode", "setpoints", "disarmed", "link", "late")
"""Troubles after which the vehicle was the operator's or PX4's, and not ours."""


def check_end(outcome: FlightOutcome) -> None:
    """Pass a flight that was flown by us alone and is seen to stand, whatever limit it may have tripped.

    Raises:
        LinkError: it was refused before it began.
        EndedError: it was not seen to land, was stopped, or the vehicle was taken from us.
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
    if trouble is not None and trouble.kind in _TAKEN:
        raise EndedError(f"the flight went wrong, and landed: {why}", FLIGHT_ENDED)
