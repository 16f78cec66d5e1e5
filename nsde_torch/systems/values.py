"""Values of parameters as a user writes them: `name` of the system, `effect.name` of an effect, or nested mappings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

Numbers = dict[str, float | list[float]]
Values = Mapping[str, float | list[float]]


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
    """Constants of the supplement for one system."""

    dt: float  # step of the model [s]
    horizon: int  # steps of a training window
    sigma_max: tuple[float, ...]  # largest diffusion, one per state [unit of the state per root second]
    ball_radius: float  # radius r of the ball of the convexity loss [standard deviations of the features]
    lambda_mu: float  # weight of the reward on strong convexity
    step: str  # name of the integrator


@dataclass(frozen=True)
class ErrorGroup:
    """Error channels that share a unit and are reported as one norm."""

    name: str  # for example "position"
    channels: tuple[int, ...]  # indices into the error channels
    unit: str  # unit of the report
    factor: float = 1.0  # from the channel's unit to that of the report (180/pi for degrees)

    def squares(self, errors: Tensor) -> Tensor:
        """Squared norm (...) of the group in errors (..., n_error), in the unit of the channels."""
        return errors[..., list(self.channels)].square().sum(-1)


@dataclass(frozen=True)
class ResidualPort:
    """A port that gets a learned residual network."""

    width: int  # outputs
    scale: float  # size of a typical residual in the unit of the port
    unit: str  # unit of the port
