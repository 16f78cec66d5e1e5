"""What names of columns say: which vector a column is of, which of its axes, and in what unit.

`vel_x`, `vx`, `twist.linear.x`, `velocity[0]` and `v_x [m/s]` are all the first axis of a velocity.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from nsde_torch.data.streams import Stream
from nsde_torch.effects.units import powers
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import did_you_mean

GRAVITY = 9.80665  # standard acceleration of gravity [m/s2], of which `g` is the unit
_FORCE, _ACCELERATION = {"kg": 1, "m": 1, "s": -2}, {"m": 1, "s": -2}
SIZES: dict[str, tuple[float, dict[str, int]]] = {
    "m": (1.0, {"m": 1}), "mm": (1e-3, {"m": 1}), "cm": (1e-2, {"m": 1}), "km": (1e3, {"m": 1}),
    "ft": (0.3048, {"m": 1}),
    "s": (1.0, {"s": 1}), "ms": (1e-3, {"s": 1}), "us": (1e-6, {"s": 1}), "ns": (1e-9, {"s": 1}),
    "min": (60.0, {"s": 1}), "h": (3600.0, {"s": 1}),
    "rad": (1.0, {}), "mrad": (1e-3, {}), "deg": (math.pi / 180.0, {}), "cdeg": (math.pi / 18000.0, {}),
    "rev": (2.0 * math.pi, {}), "rpm": (2.0 * math.pi / 60.0, {"s": -1}), "g": (GRAVITY, _ACCELERATION),
    "kg": (1.0, {"kg": 1}), "N": (1.0, _FORCE), "mN": (1e-3, _FORCE),
    "V": (1.0, {"V": 1}), "mV": (1e-3, {"V": 1}), "A": (1.0, {"A": 1}), "mA": (1e-3, {"A": 1}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}), "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}), "%": (0.01, {}),
}  # fmt: skip
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
    """What numbers in `unit` are multiplied by to be in `target`; a ConfigError says `what` has a wrong unit."""
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


_UNIT = re.compile(r"\s*[\[\(]([^\]\)]*)[\]\)]\s*$")
_SUFFIX = re.compile(r"_(deg_s|deg_per_s|dps|deg|rad_s|rad|mps|m_s|rpm|mm|cm|pwm)$")
_SUFFIXES = {
    **dict.fromkeys(("deg_s", "deg_per_s", "dps"), "deg/s"), "rad_s": "rad/s", "mps": "m/s", "m_s": "m/s",
}  # fmt: skip

POSITION, VELOCITY, QUATERNION, EULER, RATES, ACCELERATION, MOTORS = (
    "position", "velocity", "quaternion", "euler", "rates", "acceleration", "motors",
)  # fmt: skip
_WORDS: dict[str, set[str]] = {
    POSITION: {"", "p", "pos", "position", "xyz", "translation", "loc", "location", "r"},
    VELOCITY: {"v", "vel", "velocity", "linear", "linvel", "linearvelocity", "speed", "dp"},
    QUATERNION: {"q", "quat", "quaternion", "orientation", "rotation", "rot", "att", "attitude"},
    EULER: {"", "rpy", "euler", "att", "attitude", "angle", "angles"},
    RATES: {
        "w", "omega", "gyro", "gyr", "gyroadc", "rate", "rates", "angvel", "angular", "angularvelocity", "angrate",
        "om", "bodyrate", "bodyrates", "av",
    },
    ACCELERATION: {"a", "acc", "accel", "acceleration", "linearacceleration", "accsmooth"},
    MOTORS: {
        "m", "u", "motor", "motors", "motorspeed", "motorspeeds", "motorcmd", "motorcommand", "motorcommands", "pwm",
        "rpm", "esc", "escrpm", "rotor", "rotors", "rotorspeed", "rotorspeeds", "cmd", "control", "output", "outputs",
        "actuator", "actuators", "throttle", "thrust", "motoromega", "motorrpm", "motorpwm", "mot", "omega",
        "angularvelocities", "erpm", "escerpm", "motorerpm", "speed", "speeds", "motorvel", "rotorvel",
    },
}  # fmt: skip
_PLAIN = {"data", "value", "values", "velocity", "normalized"}
"""Words that say nothing: the name of the stream does."""
_NOT_MEASURED = re.compile(
    r"(^|[^a-z])(sp|set_?point|setp|ref|reference|des|desired|target|ctrltarget|cmd_?vel|goal|err|error|cov|std|var|bias|offset|raw_?cmd|pid\w*"
    r"|cmd|command|commanded|demand)([^a-z]|$)|[a-z]_d$|[a-z](ref|des|desired|setpoint|target)$"
)
_FORMS = (
    re.compile(r"^(?P<stem>.*?)(?P<joint>[._/ ]?)\[(?P<axis>\d+)\]$"),
    re.compile(r"^(?P<stem>.*?)(?P<joint>[._/ ])(?P<axis>[wxyz])(?P<tail>_[a-z0-9]+)?$"),
    re.compile(r"^(?P<stem>.*?)(?P<joint>[._/ ]?)(?P<axis>\d{1,2})$"),
    re.compile(r"^(?P<stem>(?:.*[._/])?[a-z]{1,8}?)(?P<joint>)(?P<axis>[wxyz])(?P<tail>_[a-z0-9]+)?$"),
    re.compile(r"^(?P<stem>(?:.*[._/])?)(?P<joint>)(?P<axis>[xyz])$"),
)
_NED = re.compile(r"^(?P<stem>(?:.*[._/])?[pv])(?P<joint>)(?P<axis>[ned])$")
_TURNS = re.compile(
    r"^(?P<stem>.*?)(?P<joint>[._/ ]?)(?P<axis>roll|pitch|yaw|phi|theta|psi)(?P<tail>speed|_?rate)?$"
)


@dataclass(frozen=True)
class Named:
    """Columns that are one vector, by their names."""

    kind: str  # what it is, one of the constants of this module
    stream: str  # name of their stream
    columns: tuple[str, ...]  # in the order of the axes; of a quaternion in that of `order`
    unit: str | None = None  # as the names say; None: they do not
    order: str | None = None  # of a quaternion, `wxyz` or `xyzw`; None: numbered, so that it is not said
    down: bool = False  # whether the names say north, east, down
    measured: bool = True  # False for names that look like a setpoint or an error

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the columns with that of their stream."""
        return tuple(f"{self.stream}/{c}" if self.stream else c for c in self.columns)


def bare(name: str) -> tuple[str, str | None]:
    """A name without the unit in it, and the unit."""
    found = _UNIT.search(name)
    if found and found[1].strip() and not found[1].strip().isdigit() and known(found[1]):
        return name[: found.start()].strip(), found[1]
    ending = _SUFFIX.search(name.lower())
    if ending:
        unit = None if ending[1] == "pwm" else _SUFFIXES.get(ending[1], ending[1])
        return name[: ending.start()], unit
    return name, None


def is_measured(name: str) -> bool:
    """Whether the name of a column (without its unit) or of a vector is not that of a setpoint, reference or error."""
    return not _NOT_MEASURED.search(name.lower())


def vectors(stream: Stream) -> list[Named]:
    """The vectors in a stream, by the names of its columns."""
    groups: dict[tuple[str, str, str], dict[str, str]] = {}
    units: dict[tuple[str, str, str], str | None] = {}
    for column in stream.fields:
        name, unit = bare(column)
        for stem, joint, axis, tail in _splits(name.lower()):
            key = (stem, joint, tail)
            groups.setdefault(key, {})[axis] = column
            units[key] = stream.units.get(column) or unit
    found = [_named(stream.name, key, axes, units[key]) for key, axes in groups.items()]
    places = list(stream.fields)
    return sorted((one for one in found if one is not None), key=lambda one: places.index(one.columns[0]))


def _splits(name: str) -> Iterator[tuple[str, str, str, str]]:
    """Stem, joint, axis and tail of a name, each way that it can be read."""
    turned = _TURNS.match(name)
    if turned:
        axis = {"roll": "x", "phi": "x", "pitch": "y", "theta": "y", "yaw": "z", "psi": "z"}[turned["axis"]]
        yield turned["stem"] + "~", turned["joint"], axis, turned["tail"] or ""
        return
    down = _NED.match(name)
    if down:
        yield down["stem"], "", down["axis"], ""
    for form in _FORMS:
        found = form.match(name)
        if found:
            yield found["stem"], found["joint"], found["axis"], found.groupdict().get("tail") or ""
            return
    if name in ("p", "q", "r"):
        yield "pqr", "", {"p": "x", "q": "y", "r": "z"}[name], ""


def _named(stream: str, key: tuple[str, str, str], axes: dict[str, str], unit: str | None) -> Named | None:
    stem, _, tail = key
    word = _word(stem)
    if word in _PLAIN and _word(stream.replace("/", ".")) in _WORDS[MOTORS] and "x" not in axes:
        word = "motors"
    word = word or ("" if not stem.strip("._/ ") else stem)
    whole = f"{stream}/{stem.rstrip('._/ ~')}{tail}".lower()
    there = set(axes)

    def of(kind: str, in_order: Iterable[str] = "xyz", **more: Any) -> Named:
        given = {"unit": unit, "measured": is_measured(whole), **more}
        return Named(kind, stream, tuple(axes[a] for a in in_order), **given)

    if stem.endswith("~"):
        kind = RATES if tail or _word(stem[:-1]) in _WORDS[RATES] else EULER
        return of(kind) if set("xyz") <= there else None
    if stem == "pqr":
        return of(RATES, measured=True) if len(axes) == 3 else None
    if set("ned") <= there:
        return of(POSITION if stem.endswith("p") else VELOCITY, "ned", down=True)
    if set("wxyz") <= there and word in _WORDS[QUATERNION] | {""}:
        order = "wxyz" if next(iter(axes.values())) == axes["w"] else "xyzw"
        return of(QUATERNION, order, unit=None, order=order)
    vectors = (POSITION, VELOCITY, RATES, ACCELERATION)
    if set("xyz") <= there:
        return next((of(kind) for kind in vectors if word in _WORDS[kind]), None)
    digits = sorted((a for a in axes if a.isdigit()), key=int)
    numbers = [int(a) for a in digits]
    if not numbers or numbers != list(range(numbers[0], numbers[0] + len(numbers))) or numbers[0] > 1:
        return None
    for kind in {3: (*vectors, EULER), 4: (QUATERNION,)}.get(len(digits), ()):
        if word in _WORDS[kind] - {""}:
            return of(kind, digits)
    if word in _WORDS[MOTORS] and len(digits) >= 2:
        return of(MOTORS, digits, measured=not re.search(r"(^|[^a-z])(sp|setpoint)([^a-z]|$)", whole))
    return None


def _word(stem: str) -> str:
    """The last word of a stem, without what joins words; two words where the last says too little."""
    parts = [p for p in re.split(r"[./\s]+", stem.strip("._/ "))[-1].split("_") if p]
    squeezed = "".join(parts)
    every = set().union(*_WORDS.values())
    return next((word for word in (squeezed, *parts[-1:], *parts[:1]) if word in every), squeezed)


def pick(found: Sequence[Named], kind: str) -> list[Named]:
    """The vectors of a kind that are measured."""
    return [one for one in found if one.kind == kind and one.measured]
