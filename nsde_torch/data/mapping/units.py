"""Units of columns to those of a system: products of what `SIZES` knows."""

from __future__ import annotations

import math

from nsde_torch.effects.units import powers
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import did_you_mean

GRAVITY = 9.80665
"""Standard acceleration of gravity [m/s2], of which `g` is the unit."""
SIZES: dict[str, tuple[float, dict[str, int]]] = {
    "m": (1.0, {"m": 1}),
    "mm": (1e-3, {"m": 1}),
    "cm": (1e-2, {"m": 1}),
    "km": (1e3, {"m": 1}),
    "ft": (0.3048, {"m": 1}),
    "s": (1.0, {"s": 1}),
    "ms": (1e-3, {"s": 1}),
    "us": (1e-6, {"s": 1}),
    "ns": (1e-9, {"s": 1}),
    "min": (60.0, {"s": 1}),
    "h": (3600.0, {"s": 1}),
    "rad": (1.0, {}),
    "mrad": (1e-3, {}),
    "deg": (math.pi / 180.0, {}),
    "cdeg": (math.pi / 18000.0, {}),
    "rev": (2.0 * math.pi, {}),
    "rpm": (2.0 * math.pi / 60.0, {"s": -1}),
    "g": (GRAVITY, {"m": 1, "s": -2}),
    "kg": (1.0, {"kg": 1}),
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "mN": (1e-3, {"kg": 1, "m": 1, "s": -2}),
    "V": (1.0, {"V": 1}),
    "mV": (1e-3, {"V": 1}),
    "A": (1.0, {"A": 1}),
    "mA": (1e-3, {"A": 1}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "%": (0.01, {}),
}
"""Size in SI and dimension of each unit; angles have none."""
ALIASES = {
    "dps": "deg/s", "degrees": "deg", "degree": "deg", "radians": "rad", "meters": "m", "meter": "m", "metres": "m",
    "rps": "rev/s", "hz": "1/s", "Hz": "1/s", "m/s/s": "m/s2", "m/s^2": "m/s2", "volts": "V",
    "percent": "%", "µs": "us", "": "1",
}  # fmt: skip


def known(unit: str) -> bool:
    """Whether a unit can be read."""
    return _size(unit) is not None


def factor(unit: str, target: str, *, what: str) -> float:
    """What numbers in `unit` are multiplied by to be in `target`.

    Args:
        unit: Of the column.
        target: Of the system.
        what: Whose unit it is, for messages.

    Raises:
        ConfigError: a unit that is unknown, or of another dimension.
    """
    own, wanted = _size(unit), _size(target)
    if own is None:
        raise ConfigError(
            f"{what}: the unit {unit!r} is unknown; known are {', '.join(SIZES)}, and products such as "
            f"deg/s.{did_you_mean(unit, SIZES)}"
        )
    if wanted is None or ALIASES.get(unit, unit) == target:
        return 1.0
    if own[1] != wanted[1]:
        raise ConfigError(f"{what}: the unit {unit!r} is none of {target!r}: it measures something else.")
    return own[0] / wanted[0]


def _size(unit: str) -> tuple[float, dict[str, int]] | None:
    factors = powers(ALIASES.get(unit.strip(), unit.strip()))
    if factors is None:
        return None
    size, dimension = 1.0, dict[str, int]()
    for name, power in factors.items():
        if name not in SIZES:
            return None
        size *= SIZES[name][0] ** power
        for base, times in SIZES[name][1].items():
            dimension[base] = dimension.get(base, 0) + power * times
    return size, {base: times for base, times in dimension.items() if times}
