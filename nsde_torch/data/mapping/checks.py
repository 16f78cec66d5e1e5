"""Whether a mapping says the truth: the run that it makes against kinematics and gravity, in words.

What is looked for is another reading of the same columns that leaves a tenth of what the mapping's leaves; a unit, an
order of columns, axes. Nothing here knows the machine beyond that its thrust holds it up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data.mapping.kinematic import (
    SOUND_ATTITUDE,
    SOUND_VELOCITY,
    AttitudeWay,
    VelocityWay,
    attitude_left,
    attitude_ways,
    lean,
    velocity_left,
    velocity_ways,
)
from nsde_torch.data.raw import RawRun
from nsde_torch.data.system_info import SystemInfo, derivative_columns, rate_columns

Array = NDArray[np.float64]

_BETTER = 10.0
_SIZES = (1e-3, 1e-2, 0.3048, 1.0 / 0.3048, 1e2, 1e3)
"""Factors that a forgotten unit would be."""
_LEAN_WORDS = {
    "down": "positions are turned by 180 deg about the vertical against the attitude, or the body's third axis points "
    "down: check `frames` (NED for ENU, FRD for FLU)",
    "turned by 90 deg": "positions are turned by 90 deg about the vertical against the attitude",
    "turned by -90 deg": "positions are turned by -90 deg about the vertical against the attitude",
    "exchanged": "east and north of positions are exchanged against the attitude: one of them is NED and the other ENU",
    "exchanged and reversed": "east and north of positions are exchanged and reversed against the attitude",
    "reversed in x": "the first axis of positions has the opposite sign of the attitude's",
    "reversed in y": "the second axis of positions has the opposite sign of the attitude's (a left-handed frame)",
}


@dataclass(frozen=True)
class LogCheck:
    """One check of a mapping.

    Args:
        name: What was checked.
        passed: True, False, or None where the log does not tell.
        text: The result, one sentence.
    """

    name: str
    passed: bool | None
    text: str


def checks(system: SystemInfo, run: RawRun) -> list[LogCheck]:
    """What kinematics and gravity say of a run that a mapping made.

    Args:
        system: The machine.
        run: In the system's units, axes and order.
    """
    out: list[LogCheck] = []
    q, rates = system.quaternion, rate_columns(system)
    attitude = None if q is None else run.x[:, q]
    if attitude is not None and rates is not None:
        out.append(_attitude(run.t, attitude, run.x[:, rates]))
    for group, (i, j) in derivative_columns(system).items():
        if not np.isfinite(run.x[:, j]).any():
            continue
        if len(i) == 3 and attitude is not None and "(world" in group:
            out += _velocity(run.t, attitude, run.x[:, i], run.x[:, j])
        else:
            for a, b in zip(i, j, strict=True):
                out.append(_axis(system, run, a, b))
    return out


def _attitude(t: Array, q: Array, w: Array) -> LogCheck:
    own = AttitudeWay("wxyz", "body to world", "rad/s", (1.0, 1.0, 1.0))
    ways = [own, *(way for way in attitude_ways(None, None) if way != own)]
    ways.append(AttitudeWay("wxyz", "body to world", "1/rad", (1.0, 1.0, 1.0)))
    left = [attitude_left(t, q, w * (180.0 / np.pi if way.unit == "1/rad" else 1.0), way) for way in ways]
    if not np.isfinite(left[0]):
        return LogCheck(
            "attitude and rates", None, "too little turning to compare the attitude with the rates."
        )
    k = int(np.nanargmin(left))
    if k and left[0] > SOUND_ATTITUDE and _BETTER * left[k] < left[0]:
        return LogCheck(
            "attitude and rates",
            False,
            f"the rates leave {left[0]:.0%} of the attitude's turning, and {left[k]:.1%} if "
            f"{_attitude_words(ways[k])}.",
        )
    sound = True if left[0] <= SOUND_ATTITUDE else None
    told = f"the rates leave {left[0]:.1%} of the attitude's turning over 0.25 s"
    more = (
        "."
        if sound
        else ", and no other reading of these columns does much better: rates of another body, time or unit."
    )
    return LogCheck("attitude and rates", sound, told + more)


def _attitude_words(way: AttitudeWay) -> str:
    words = []
    if way.order == "xyzw":
        words.append("the quaternion has its scalar last (`order: xyzw`)")
    if way.turns == "world to body":
        words.append("it turns the world into the body (`turns: world to body`)")
    if way.unit == "deg/s":
        words.append("the rates are in deg/s (`unit: deg/s`)")
    if way.unit == "1/rad":
        words.append("the rates are in rad/s (`unit: rad/s`)")
    if way.signs[1] < 0:
        words.append("the rates are those of the other body axes (FRD for FLU: `body` of one of them)")
    return " and ".join(words)


def _velocity(t: Array, q: Array, p: Array, v: Array) -> list[LogCheck]:
    ways = list(velocity_ways())
    left = [velocity_left(t, q, p, v, way) for way in ways]
    sizes = [velocity_left(t, q, p, factor * v, ways[0]) for factor in _SIZES]
    out = []
    if not np.isfinite(left[0]):
        out.append(
            LogCheck("position and velocity", None, "too little movement to compare position and velocity.")
        )
    else:
        k, size = int(np.nanargmin(left)), int(np.nanargmin(sizes))
        other = min(left[k], sizes[size])
        if left[0] > SOUND_VELOCITY and _BETTER * other < left[0]:
            by = f"{_SIZES[size]:g} times as large: a unit of one of them (`unit`)"
            words = _velocity_words(ways[k]) if left[k] <= sizes[size] else f"they are {by}"
            text = f"velocities leave {left[0]:.0%} of the movement, and {other:.1%} if {words}."
            out.append(LogCheck("position and velocity", False, text))
        else:
            sound = True if left[0] <= 5 * SOUND_VELOCITY else None
            text = f"velocities leave {left[0]:.1%} of the movement over 0.25 s"
            more = (
                "."
                if sound
                else ", and no other reading of these columns does much better: another unit, time or body."
            )
            out.append(LogCheck("position and velocity", sound, text + more))
    found = lean(t, q, p)
    name = "lean and acceleration"
    if found is None or found.way is None:
        out.append(
            LogCheck(
                name,
                None,
                "the log leans too little, or too alike, to tell the axes of attitude and positions.",
            )
        )
    elif found.way == "up" and found.up > 0:
        text = (
            f"the machine speeds up where its thrust leans ({found.left['up']:.0%} of the acceleration left)."
        )
        out.append(LogCheck(name, True, text))
    else:
        words = _LEAN_WORDS.get(found.way, "the world's third axis points down: check `frames.world`")
        rest = f"{found.left['up']:.0%} of the acceleration left"
        text = f"the machine does not speed up where its thrust leans ({rest}): {words}."
        out.append(LogCheck(name, False, text))
    return out


def _velocity_words(way: VelocityWay) -> str:
    if way.axes == "body":
        body = "" if way.signs[1] > 0 else " of the other handedness, FRD for FLU"
        return f"they are along the body's axes{body} (`axes: body`)"
    if way.places == (1, 0, 2):
        return "they are NED and the positions ENU, or the other way round (`world` of one of them)"
    return "their third axis has the opposite sign of the position's (one up, one down)"


def _axis(system: SystemInfo, run: RawRun, i: int, j: int) -> LogCheck:
    names = f"{system.state_names[i]} and {system.state_names[j]}"
    p, v = run.x[:, [i]], run.x[:, [j]]
    left = {
        factor: velocity_left(run.t, None, p, factor * v, VelocityWay("world", (0,), (1.0,)))  # type: ignore[arg-type]
        for factor in (1.0, -1.0, np.pi / 180.0, 180.0 / np.pi, 1e-3, 1e3)
    }
    if not np.isfinite(left[1.0]):
        return LogCheck(names, None, f"too little movement to compare {names}.")
    k = min(left, key=lambda factor: left[factor])
    if k != 1.0 and left[1.0] > SOUND_VELOCITY and _BETTER * left[k] < left[1.0]:
        words = "has the opposite sign" if k == -1.0 else f"is multiplied by {k:.4g}: a unit"
        rate = system.state_names[j]
        text = f"{rate} leaves {left[1.0]:.0%} of what {system.state_names[i]} moves, and {left[k]:.1%} if it {words}."
        return LogCheck(names, False, text)
    sound = True if left[1.0] <= 5 * SOUND_VELOCITY else None
    text = f"{system.state_names[j]} leaves {left[1.0]:.1%} of what {system.state_names[i]} moves over 0.25 s"
    return LogCheck(names, sound, text + ("." if sound else ", whatever its sign and unit."))
