"""`nsde vehicle`: be a simulated PX4 vehicle, for nsde fly and its tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nsde_torch.errors import ConfigError
from nsde_torch.px4.options import CLOCK, SensorErrors

from ..hydra_command import Config, HydraCommand, Job, say
from ..keys import group, key, mirrors
from ..schemas import FlownPlantConfig, LinkConfig

if TYPE_CHECKING:
    from nsde_torch.px4.simulator.body import Body


@mirrors(SensorErrors)
class SensorsConfig:
    """What the sensors of a simulated vehicle get wrong."""


@dataclass
class VehicleConfig:
    hil: str | None = key(
        None,
        "be the simulator of a real PX4 instead, which connects here: tcpin:127.0.0.1:4560 (`--hil` says the same)",
    )
    seed: int = key(0, "seed of gusts and noise", low=0)
    duration: float | None = key(None, "how long to run; null: until Ctrl-C", unit="s", above=0)
    parameters: dict[str, Any] = key({}, "values of PX4's parameters, parameters.COM_OF_LOSS_T=0.5")
    clock: float = key(
        CLOCK, "seconds of its clock in one of ours; PX4's own simulator runs as slow", above=0, high=2
    )
    threads: int = key(1, "CPU threads of torch", low=1)
    plant: FlownPlantConfig = group(FlownPlantConfig, "the machine that it flies")
    link: LinkConfig = group(LinkConfig, "how it is reached")
    sensors: SensorsConfig = group(
        SensorsConfig, "what its sensors get wrong; plant.sensor_noise is a factor"
    )


def _keys(arguments: Sequence[str]) -> list[str]:
    """`--hil URL` and `--hil=URL` as the key that they are."""
    out: list[str] = []
    words = iter(arguments)
    for word in words:
        if word == "--hil":
            word = f"--hil={next(words, '')}"
        out.append(word[2:] if word.startswith("--hil=") else word)
    return out


COMMAND = HydraCommand(
    name="vehicle",
    schema=VehicleConfig,
    groups={"plant": "hexacopter", "link": "vehicle", "sensors": "default"},
    words=_keys,
)


def run(config: Config, job: Job) -> None:
    """Be a vehicle; ConfigError for what is no multirotor, or options that it does not have."""
    from nsde_torch.px4.simulator.autopilot import PARAMETERS

    from .. import build, fly_build

    body = fly_build.body(config.plant, seed=config.seed)
    parameters = build.options(config)["parameters"]
    errors = SensorErrors(**build.options(config.sensors))
    unknown = sorted(set(parameters) - set(PARAMETERS))
    if unknown:
        raise ConfigError(f"`parameters` names {unknown}; the vehicle has {', '.join(PARAMETERS)}.")
    wrong = sorted(k for k, v in parameters.items() if isinstance(v, bool) or not isinstance(v, (int, float)))
    if wrong:
        raise ConfigError(f"`parameters.{wrong[0]}` takes a number; got {parameters[wrong[0]]!r}.")
    if config.hil is not None:
        _simulate(config, body, errors)
    else:
        _fly(config, body, parameters, errors)


def _simulate(config: Config, first: Body, errors: SensorErrors) -> None:
    from nsde_torch.px4.link.connection import open_transport
    from nsde_torch.px4.simulator.hil import HilPlant, HilServer, airframe

    from ..fly_build import body

    if not config.hil.startswith("tcpin:"):
        raise ConfigError(f"`hil` takes tcpin:HOST:PORT, where PX4 connects; got {config.hil!r}.")
    seed, noise = config.seed, config.plant.sensor_noise
    transport = open_transport(config.hil, expose=config.link.expose, name="hil")

    def plant() -> HilPlant:
        return HilPlant(body(config.plant, seed=seed), seed=seed, noise=noise, errors=errors)

    server = HilServer(plant, transport, say=say)
    say(
        f"a {first.system.name} as PX4's simulator on {config.hil}; Ctrl-C ends it. PX4 must know the machine:"
    )
    for name, value in airframe(first.system, first.hover_throttle()).items():
        say(f"  param set {name} {value:g}")
    with closing(transport), suppress(KeyboardInterrupt):
        server.run(_ends(config.duration))


def _ends(duration: float | None) -> Callable[[], bool]:
    end = None if duration is None else time.monotonic() + duration
    return lambda: end is not None and time.monotonic() >= end


def _fly(config: Config, body: Body, parameters: dict[str, float], errors: SensorErrors) -> None:
    from nsde_torch.px4.link.connection import open_transport
    from nsde_torch.px4.simulator.autopilot import SimulatedAutopilot
    from nsde_torch.px4.simulator.simulated import Vehicle

    from .. import fly_build

    transport = open_transport(config.link.url, expose=config.link.expose)
    autopilot = SimulatedAutopilot(
        body,
        system=config.link.system or 1,
        key=fly_build.key(config.link),
        seed=config.seed,
        sensor_noise=config.plant.sensor_noise,
        stream=transport.stream,
        parameters=parameters,
        errors=errors,
    )
    vehicle = Vehicle(autopilot, transport, speed=config.clock)
    say(f"a simulated {body.system.name} on {config.link.url}; Ctrl-C ends it")
    with closing(transport), suppress(KeyboardInterrupt):
        vehicle.run(_ends(config.duration))
    lost = f", {vehicle.slipped:.1f} s lost to a busy machine" if vehicle.slipped else ""
    print(f"ran {autopilot.time:.1f} s{lost}")
