"""Within what an experiment is planned: the fence and speeds that were asked for, and no faster turns than are sent."""

from __future__ import annotations

from omegaconf import DictConfig

from nsde_torch.control import feasible
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight.options import Limits
from nsde_torch.px4.flight.safety import MARGIN
from nsde_torch.systems import System

from .. import build


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
