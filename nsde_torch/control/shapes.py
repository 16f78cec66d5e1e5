"""The supplement's references as closed forms: circle and lemniscate, and hovering.

    circle       p = c + r (cos f, sin f)                 speed r f'
    lemniscate   p = c + (a sin f, b sin f cos f)         speed sqrt(a^2 + b^2) f' where the branches cross

The phase f starts and ends at rest: f' rises as a polynomial of degree 7 whose first three derivatives vanish at both
ends, so that the path has four continuous derivatives. Sizes are chosen such that the largest tilts are those of the
supplement's Figures 17 and 18 (32 deg; for the lemniscate 32 deg of roll and 19 deg of pitch).
"""

from __future__ import annotations

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.control.options import CircleOptions, HoverOptions, LemniscateOptions
from nsde_torch.control.reference import FlightPath
from nsde_torch.errors import ConfigError

GRID = 0.01
"""Step of references [s]."""

_CIRCLE, _LEMNISCATE, _HOVER = CircleOptions(), LemniscateOptions(), HoverOptions()


def _phase(duration: float, ramp: float, rate: float) -> Array:
    """f, f', f'' (3, n) on the grid: from rest to `rate` [rad/s], and back to rest, over `ramp` [s] each."""
    t = GRID * np.arange(round(duration / GRID) + 1)
    s = np.clip(np.minimum(t, t[-1] - t) / ramp, 0.0, 1.0)
    sign = np.where(t < 0.5 * t[-1], 1.0, -1.0)
    rise = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    slope = 140.0 * s**3 * (1.0 - s) ** 3 * sign / ramp
    # the integral of the rise, in closed form on both ramps
    integral = ramp * s**5 * (7.0 - 14.0 * s + 10.0 * s**2 - 2.5 * s**3)
    until = np.where(t < ramp, integral, 0.5 * ramp + (t - ramp))
    total = t[-1] - ramp
    f = np.where(t > t[-1] - ramp, total - integral, until)
    return np.stack((rate * f, rate * rise, rate * slope))


def _check(name: str, **positive: float) -> None:
    wrong = {k: v for k, v in positive.items() if not v > 0}
    if wrong:
        raise ConfigError(
            f"reference {name!r}: {', '.join(f'`{k}`={v:g}' for k, v in wrong.items())} must be above 0."
        )


def circle(
    *,
    speed: float = _CIRCLE.speed,
    duration: float = _CIRCLE.duration,
    radius: float = _CIRCLE.radius,
    height: float = _CIRCLE.height,
    yaw: float = _CIRCLE.yaw,
    ramp: float = _CIRCLE.ramp,
) -> FlightPath:
    """A circle at constant speed, while the heading turns once to `yaw` and back.

    Args:
        speed: Speed after the start [m/s].
        duration: From rest to rest [s].
        radius: Radius [m].
        height: Height [m].
        yaw: Farthest heading [deg].
        ramp: Time to reach the speed, and to lose it [s].

    Raises:
        ConfigError: a size is not positive, or the flight is shorter than its two ramps.
    """
    _check("circle", speed=speed, duration=duration, radius=radius, ramp=ramp)
    _long_enough("circle", duration, ramp)
    f, df, ddf = _phase(duration, ramp, speed / radius)
    c, s, zero = np.cos(f), np.sin(f), np.zeros_like(f)
    p = np.stack((radius * c, radius * s, zero + height), 1)
    v = np.stack((-radius * s * df, radius * c * df, zero), 1)
    a = radius * np.stack((-c * df**2 - s * ddf, -s * df**2 + c * ddf, zero), 1)
    share = np.linspace(0.0, 1.0, len(f))
    heading = np.deg2rad(yaw) * 0.5 * (1.0 - np.cos(2.0 * np.pi * share))
    about: dict[str, object] = {"speed": speed, "radius": radius, "height": height, "yaw": yaw}
    return FlightPath("circle", GRID, p, v, a, heading, about)


def lemniscate(
    *,
    speed: float = _LEMNISCATE.speed,
    duration: float = _LEMNISCATE.duration,
    length: float = _LEMNISCATE.length,
    width: float = _LEMNISCATE.width,
    height: float = _LEMNISCATE.height,
    yaw: float = _LEMNISCATE.yaw,
    ramp: float = _LEMNISCATE.ramp,
) -> FlightPath:
    """A figure of eight (Gerono's lemniscate), while the heading swings.

    Args:
        speed: Largest speed, where the branches cross [m/s].
        duration: From rest to rest [s].
        length: Half of its extent along x [m].
        width: Twice its half extent along y [m].
        height: Height [m].
        yaw: Farthest heading [deg].
        ramp: Time to reach the speed, and to lose it [s].

    Raises:
        ConfigError: a size is not positive, or the flight is shorter than its two ramps.
    """
    _check("lemniscate", speed=speed, duration=duration, length=length, width=width, ramp=ramp)
    _long_enough("lemniscate", duration, ramp)
    f, df, ddf = _phase(duration, ramp, speed / float(np.hypot(length, width)))
    c, s, c2, s2, zero = np.cos(f), np.sin(f), np.cos(2 * f), np.sin(2 * f), np.zeros_like(f)
    p = np.stack((length * s, 0.5 * width * s2, zero + height), 1)
    v = np.stack((length * c * df, width * c2 * df, zero), 1)
    a = np.stack((length * (c * ddf - s * df**2), width * (c2 * ddf - 2.0 * s2 * df**2), zero), 1)
    heading = np.deg2rad(yaw) * np.sin(2.0 * np.pi * np.linspace(0.0, 3.0, len(f)))
    about: dict[str, object] = {
        "speed": speed,
        "length": length,
        "width": width,
        "height": height,
        "yaw": yaw,
    }
    return FlightPath("lemniscate", GRID, p, v, a, heading, about)


def hover(
    *, duration: float = _HOVER.duration, height: float = _HOVER.height, yaw: float = _HOVER.yaw
) -> FlightPath:
    """Standing still.

    Args:
        duration: How long [s].
        height: Height [m].
        yaw: Heading [deg].
    """
    _check("hover", duration=duration)
    n = round(duration / GRID) + 1
    zero = np.zeros((n, 3))
    p = zero + np.array([0.0, 0.0, height])
    return FlightPath(
        "hover", GRID, p, zero, zero, np.full(n, np.deg2rad(yaw)), {"height": height, "yaw": yaw}
    )


def _long_enough(name: str, duration: float, ramp: float) -> None:
    if duration < 2.0 * ramp:
        raise ConfigError(
            f"reference {name!r}: `duration`={duration:g} s is shorter than two ramps of {ramp:g} s. Give "
            "more time, or a shorter `ramp`."
        )
