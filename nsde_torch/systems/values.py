"""Values of parameters as a user writes them: `name` of the system, `effect.name` of an effect, or nested mappings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Numbers = dict[str, float | list[float]]


def dotted(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """`{effect: {name: 1}}` as `effect.name`, and `{law: {coordinate: {name: 1}}}` as `law[coordinate].name`."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{name}.")
            continue
        path = f"{prefix}{name}"
        parts = path.split(".")
        if len(parts) == 3 and "[" not in parts[0]:
            path = f"{parts[0]}[{parts[1]}].{parts[2]}"
        yield path, value


def split_values(values: Mapping[str, Any]) -> tuple[Numbers, dict[str, Numbers]]:
    """Values of the system's own parameters, and those of its effects."""
    own: Numbers = {}
    of_effects: dict[str, Numbers] = {}
    for path, value in dotted(values):
        effect, dot, name = path.partition(".")
        if dot:
            of_effects.setdefault(effect, {})[name] = value
        else:
            own[path] = value
    return own, of_effects


@dataclass(frozen=True)
class Defaults:
    """Constants of the supplement for one system.

    Args:
        dt: Step of the model [s].
        horizon: Steps of a training window.
        sigma_max: Largest diffusion, one per state [unit of the state per root second].
        ball_radius: Radius r of the ball of the convexity loss [standard deviations of the features].
        lambda_mu: Weight of the reward on strong convexity.
        step: Name of the integrator.
    """

    dt: float
    horizon: int
    sigma_max: tuple[float, ...]
    ball_radius: float
    lambda_mu: float
    step: str


@dataclass(frozen=True)
class ErrorGroup:
    """Error channels that share a unit and are reported as one norm.

    Args:
        name: For example "position".
        channels: Indices into the error channels.
        unit: Unit of the report.
        factor: From the channel's unit to that of the report (180/pi for degrees).
    """

    name: str
    channels: tuple[int, ...]
    unit: str
    factor: float = 1.0


@dataclass(frozen=True)
class ResidualPort:
    """A port that gets a learned residual network.

    Args:
        width: Outputs.
        scale: Size of a typical residual in the unit of the port.
        unit: Unit of the port.
    """

    width: int
    scale: float
    unit: str
