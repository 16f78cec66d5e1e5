"""From the groups `link` and `limits` to the objects of the library."""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from math import radians
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight.safety import Limits
from nsde_torch.px4.flight.setpoint import SetpointLimits
from nsde_torch.px4.link.codec import signing_key

from . import build

say = partial(print, flush=True)
"""Takes a line about each step."""


def key(config: DictConfig) -> bytes | None:
    """The signing key of the group `link`.

    Raises:
        ConfigError: the file is not there or empty.
    """
    if config.key_file is None:
        return None
    file = Path(config.key_file)
    if not file.is_file():
        raise ConfigError(f"`link.key_file`: {file} does not exist; expected a file with the signing key.")
    return signing_key(file.read_text(encoding="utf-8").strip())


def limits(config: DictConfig) -> Limits:
    """The group `limits`.

    Raises:
        ConfigError: a fence that is none.
    """
    given = {f.name: config[f.name] for f in fields(Limits) if f.name in config}
    return Limits(**{**given, "fence": _fence(build.options(config)["fence"])})


def setpoints(config: DictConfig) -> SetpointLimits:
    """Bounds of what is sent, of the group `limits`.

    Raises:
        ConfigError: a throttle that is no pair.
    """
    throttle = tuple(config.throttle)
    if len(throttle) != 2 or not throttle[0] < throttle[1]:
        raise ConfigError(f"`limits.throttle` takes [lowest, highest]; got {list(throttle)}.")
    return SetpointLimits(
        rate=config.rate,
        yaw_rate=config.yaw_rate,
        throttle=(throttle[0], throttle[1]),
        tilt=radians(max(config.tilt - 5.0, 5.0)),
    )


def _fence(rows: Any) -> Any:
    good = isinstance(rows, list) and len(rows) == 3
    good = good and all(isinstance(r, list) and len(r) == 2 and float(r[0]) < float(r[1]) for r in rows)
    if not good:
        raise ConfigError(
            f"`limits.fence` takes [[x_low,x_high],[y_low,y_high],[z_low,z_high]]; got {rows!r}."
        )
    return tuple((float(a), float(b)) for a, b in rows)
