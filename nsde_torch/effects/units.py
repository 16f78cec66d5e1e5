"""Products of units: the unit of a law's parameter from those of the coordinate that it is a law of.

(force) / (speed)     with force in rad/s2 and speed in rad/s     ->     1/s
"""

from __future__ import annotations

import re
from collections.abc import Mapping

_FACTOR = re.compile(r"([^\W\d_]+|%|°)\^?(-?\d+)?")

Powers = dict[str, int]


def of(law: str, units: Mapping[str, str]) -> str:
    """The unit that `force/speed2` is, each word of which represents a unit.

    Args:
        law: Product of words, at most one `/`, powers behind them; words that `units` lacks are units themselves.
        units: Unit that each word represents.

    Returns:
        The unit, its powers collected; `(unit)/(unit)` in words where a unit is none that can be read.
    """
    out: Powers = {}
    for word, power in (powers(law) or {}).items():
        own = powers(units.get(word, word))
        if own is None:
            return re.sub(r"[a-z]{2,}", lambda m: f"({units.get(m[0], m[0])})", law)
        for unit, times in own.items():
            out[unit] = out.get(unit, 0) + power * times
    return written(out)


def written(factors: Powers) -> str:
    """The unit of collected powers."""
    above = [_written(unit, times) for unit, times in factors.items() if times > 0]
    below = [_written(unit, -times) for unit, times in factors.items() if times < 0]
    if not below:
        return " ".join(above) or "1"
    under = below[0] if len(below) == 1 else f"({' '.join(below)})"
    return f"{' '.join(above) or '1'}/{under}"


def _written(unit: str, power: int) -> str:
    return unit if power == 1 else f"{unit}{power}"


def divided(one: Powers, by: Powers) -> Powers:
    """The quotient of two units, common factors cancelled."""
    out = {unit: one.get(unit, 0) - by.get(unit, 0) for unit in (*one, *by)}
    return {unit: power for unit, power in out.items() if power}


def powers(unit: str) -> Powers | None:
    """Powers of the factors of a unit; None if it cannot be parsed."""
    out: Powers = {}
    for place, part in enumerate(unit.split("/")):
        for factor in part.strip().strip("()").replace("*", " ").split():
            if factor == "1":
                continue
            found = _FACTOR.fullmatch(factor)
            if found is None:
                return None
            power = int(found[2] or 1) * (-1 if place else 1)
            out[found[1]] = out.get(found[1], 0) + power
    return out
