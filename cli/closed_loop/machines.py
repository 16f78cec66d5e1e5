"""Who flies: the simulated vehicle in virtual time, the plant of `nsde track`, or a vehicle over MAVLink.

A controller knows the declared physics with the values of the plant, and the effects that it is given.
"""

import json
from math import inf
from pathlib import Path
from typing import Any, final

from omegaconf import DictConfig

from nsde_torch.control import feasible
from nsde_torch.control.controller import Controller
from nsde_torch.control.loop import DECLARED, knowledge, write_log
from nsde_torch.control.loop import fly as fly_plant
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.controller import FlightController
from nsde_torch.px4.flight.flying import fly as fly_vehicle
from nsde_torch.px4.flight.predictive import PredictiveController, told
from nsde_torch.px4.flight.safety import MARGIN
from nsde_torch.px4.options import FlightOptions, Limits
from nsde_torch.px4.simulator.simulated import fly_simulated
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.machines import plant_effects

from .. import build, fly_build, track_build
from ..hydra_command import say

LINK, HAND, PLANT = "link", "hand", "plant"


def needed(effects: list[Any], by: str) -> list[Any]:
    """Effects that a controller needs to know, in one order: those of the same share what is compiled."""
    known = effects if by == PLANT else told(effects)
    return sorted(known, key=lambda entry: str(next(iter(entry))))


def physics(config: DictConfig, effects: list[Any]) -> System:
    """What a controller knows that is given some effects; ConfigError for one that the machine cannot have."""
    known = knowledge(DECLARED, config.plant.system, effects=effects)
    assert isinstance(known, System)
    return known


def true_effects(config: DictConfig) -> list[Any]:
    """Effects that the simulated machine has beside the declared physics, with their values."""
    given = build.options(config.plant)["effects"]
    found = plant_effects(config.plant.system, effects=given, declared_only=config.plant.declared_only)
    return [{name: values} for name, values in found.items()]


@final
class VirtualVehicle:
    """The simulated vehicle with link, state machine and logs of a PX4, in virtual time; `delay` covers lags."""

    def __init__(self, config: DictConfig) -> None:
        self._config = config
        self._controllers: dict[str, Controller] = {}
        fly_build.body(config.plant, seed=0)  # what the machine cannot be is said before anything is flown

    def fly(self, path: FlightPath, effects: list[Any], *, seed: int, log: Path) -> dict[str, Any]:
        """Fly once from the place of take-off, with effects that the controller is given; the log is a CSV file.

        What was measured: `tracked`, `rmse_m`, `trouble`, `track` and more.
        """
        c = self._config
        body, controller = fly_build.body(c.plant, seed=seed), self._controller(path, effects)
        how = {"period": c.mpc.period, "sensor_noise": c.plant.sensor_noise}
        report = fly_simulated(body, controller, PathPoints(path), seed=seed, log=log, **how)
        return {**report.as_dict(), "track": _rounded(report.track)}

    def _controller(self, path: FlightPath, effects: list[Any]) -> FlightController:
        """The solver is made once for all flights with the same knowledge."""
        key = json.dumps(effects)
        c = self._config
        if key not in self._controllers:
            self._controllers[key] = Controller(physics(c, effects), **track_build.planning(c.mpc), say=say)
        return PredictiveController(self._controllers[key], Reference(path), delay=c.delay, lead=c.lead)


@final
class TrackedPlant:
    """The plant of `nsde track`, motors commanded directly."""

    def __init__(self, config: DictConfig) -> None:
        self._config = config
        track_build.plant(config.plant, physics(config, []), seed=0)

    def fly(self, path: FlightPath, effects: list[Any], *, seed: int, log: Path) -> dict[str, Any]:
        """See `VirtualVehicle.fly`."""
        c, reference = self._config, Reference(path)
        known = physics(c, effects)
        plant = track_build.plant(c.plant, known, seed=seed)
        made: dict[str, Any] = {"batch": 1, "sample": plant.dt}
        autopilot = track_build.autopilot(DECLARED, known, c, reference, **made, say=say)
        late, span = c.plant.state_latency, path.duration
        flight = fly_plant(autopilot, plant, reference, state_latency=late, duration=span)
        (written,) = write_log([flight], known, log.parent / f".{log.stem}")
        log.parent.mkdir(parents=True, exist_ok=True)
        written.replace(log)
        written.parent.rmdir()
        lost, t, x = float(flight.lost[0]), flight.t, flight.x[:, 0]
        errors = (x[:, :3] - flight.ref[:, :3]).norm(dim=1)
        whole = lost == inf
        return {
            "tracked": whole,
            "trouble": None if whole else {"kind": "lost", "text": f"the machine was lost at {lost:.1f} s"},
            "rmse_m": float(errors.square().mean().sqrt()) if whole else None,
            "position_error_max_m": float(errors.max()) if whole else None,
            "track": _rounded([(float(a), *row) for a, row in zip(t, x.tolist(), strict=True)]),
        }


@final
class LinkedVehicle:
    """A vehicle over MAVLink in real time, `nsde vehicle` or a PX4; ConfigError for limits that cannot be kept."""

    def __init__(self, config: DictConfig) -> None:
        self._config, self._connect = config, fly_build.connection(config.link)
        self._limits, self._setpoints = fly_build.limits(config.limits), fly_build.setpoints(config.limits)
        if config.experiments:
            check_inside(config.experiment, self._limits)
        system = physics(config, [])
        assert isinstance(system, Multirotor)
        self._motors = system.nu

    def fly(self, path: FlightPath, effects: list[Any], *, seed: int, log: Path) -> dict[str, Any]:
        """See `VirtualVehicle.fly`; EndedError: stopped, or the vehicle was taken from us or is not seen to stand."""
        c = self._config
        check_path(path, physics(c, []), self._limits, dt=track_build.problem(c.mpc).dt)
        # the solver is compiled and warm before the vehicle is spoken to
        runner = fly_build.predictive(
            c, path, run=DECLARED, system=c.plant.system, effects=effects, lead=c.lead
        )
        try:
            runner.wait()
            with self._connect() as link:
                # an experiment ends anywhere, and the next flight has its fence about where it takes off
                bounds: dict[str, Any] = {"limits": self._limits, "options": FlightOptions(come_back=True)}
                bounds |= {"setpoints": self._setpoints, "motors": self._motors}
                report = fly_vehicle(link, runner, PathPoints(path), log=log, **bounds, say=say)
        finally:
            runner.close()
        fly_build.check_end(report.outcome)
        return {**report.as_dict(), "track": _rounded(report.track)}


FlyingMachine = VirtualVehicle | TrackedPlant | LinkedVehicle
MACHINES: dict[str, type[FlyingMachine]] = {
    "vehicle": VirtualVehicle,
    PLANT: TrackedPlant,
    LINK: LinkedVehicle,
}
"""Who flies, by `by=`; a person flies no machine of ours."""


def _rounded(track: Any) -> list[list[float]]:
    return [[round(float(v), 6) for v in row] for row in track]


# within what an experiment is planned: fence and speeds that were asked for, no faster turns than are sent


def plan_limits(config: DictConfig) -> dict[str, list[float]]:
    """Lowest and highest value of each state of a plan, by its name."""
    e = config.experiment
    limits = {f"p_{axis}": list(pair) for axis, pair in zip("xyz", build.fence(e, "experiment"), strict=True)}
    limits |= {f"v_{axis}": [-e.speed, e.speed] for axis in "xyz"}
    for axis in "xyz":
        group, _, key = limit_key(f"w_{axis}", config).partition(".")
        limits[f"w_{axis}"] = [-config[group][key], config[group][key]]
    return limits


def limit_key(state: str, config: DictConfig) -> str:
    """The key that bounds a state (`p_x`, `v_x`, `w_x`) of a plan: over a link no faster turns than are sent."""
    if state[0] != "w":
        return {"p": "experiment.fence", "v": "experiment.speed"}[state[0]]
    sent = "yaw_rate" if state == "w_z" else "rate"
    slower = config.by == "link" and config.limits[sent] < config.experiment.rate
    return f"limits.{sent}" if slower else "experiment.rate"


def check_inside(experiment: DictConfig, limits: Limits) -> None:
    """Refuse experiments that may leave what a flight is ended by; the ConfigError names both keys."""
    fence = build.fence(experiment, "experiment")
    for axis, (low, high), (lowest, highest) in zip("xyz", fence, limits.fence, strict=True):
        # a path nearer to the fence's top is refused before take-off
        highest -= MARGIN if axis == "z" else 0.0
        if low < lowest or high > highest + 1e-6:
            raise ConfigError(
                f"`experiment.fence` reaches from {low:g} to {high:g} m along {axis}, beyond `limits.fence`, where a "
                f"flight is ended: a flight may be planned from {lowest:g} to {highest:g} m. Make the first smaller, "
                "or the second larger."
            )
    if experiment.speed > limits.speed:
        raise ConfigError(
            f"`experiment.speed` is {experiment.speed:g} m/s, beyond `limits.speed` of {limits.speed:g} m/s, where a "
            "flight is ended."
        )


def check_path(path: FlightPath, machine: System, limits: Limits, *, dt: float) -> None:
    """Refuse a path that would be ended on the way; the ConfigError names the limit."""
    asked = feasible.envelope(Reference(path), Predictor(machine, dt=dt))
    for name, most, limit, unit in (
        ("tilt", asked.tilt, limits.tilt, "deg"),
        ("speed", asked.speed, limits.speed, "m/s"),
    ):
        if most > limit:
            raise ConfigError(
                f"the path {path.name!r} asks for a {name} of up to {most:.2g} {unit}, and `limits.{name}={limit:g}` "
                f"ends a flight there. Start the same command again with a larger `limits.{name}`."
            )
