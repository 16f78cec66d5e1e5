"""What the data layer asks of a system: names, units, and which columns are derivatives of which."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, Protocol, cast

from nsde_torch.errors import ConfigError

RATE_NAMES = ("w_x", "w_y", "w_z")
"""State names of the body rates [rad/s] that go with a quaternion `w x y z` (body to world)."""


class SystemInfo(Protocol):
    """The part of a system that readers and checks need; every `nsde_torch.systems.System` satisfies it."""

    @property
    def name(self) -> str: ...  # for messages and for recognising published files
    @property
    def state_names(self) -> tuple[str, ...]: ...
    @property
    def state_units(self) -> tuple[str, ...]: ...  # `rad` marks an angle that may be logged wrapped
    @property
    def input_names(self) -> tuple[str, ...]: ...
    @property
    def input_units(self) -> tuple[str, ...]: ...
    @property
    def exogenous(self) -> tuple[str, ...]: ...  # columns that effects read; behind the inputs, in this order
    @property
    def quaternion(self) -> slice | None: ...  # columns of a unit quaternion `w x y z`
    @property
    def position_derivatives(self) -> tuple[tuple[str, str, str], ...]: ...
    # (position, velocity, frame) for which d position / dt = velocity
    @property
    def optional_inputs(self) -> tuple[str, ...]: ...  # those that a file may lack, and that are then zero


def all_columns(systems: Sequence[SystemInfo]) -> SystemInfo:
    """The first system, with the further columns that any of them reads."""
    first = systems[0]
    every = tuple(dict.fromkeys(name for system in systems for name in system.exogenous))
    if every == tuple(first.exogenous):
        return first
    return changed(first, exogenous=every)


def changed(system: SystemInfo, **changes: Any) -> SystemInfo:
    """A system as readers see it, with some of its attributes replaced."""
    own = {n: getattr(system, n) for n, kind in vars(SystemInfo).items() if isinstance(kind, property)}
    return cast(SystemInfo, SimpleNamespace(**{**own, **changes}))


def rate_pairs(system: SystemInfo) -> list[tuple[int, int]]:
    """Columns (position, rate) of `position_derivatives`."""
    names = list(system.state_names)
    return [(names.index(p), names.index(v)) for p, v, _ in system.position_derivatives]


def rate_columns(system: SystemInfo) -> slice | None:
    """Columns of the body rates that belong to the quaternion, or None where there is no such pair."""
    names = tuple(system.state_names)
    first = names.index(RATE_NAMES[0]) if RATE_NAMES[0] in names else 0
    found = system.quaternion is not None and names[first : first + 3] == RATE_NAMES
    return slice(first, first + 3) if found else None


def moving_columns(system: SystemInfo) -> tuple[list[int], slice] | None:
    """Columns of the velocity and of the body rates of a vehicle that turns freely; None of other machines."""
    names, rates = list(system.state_names), rate_columns(system)
    if rates is None or not {"v_x", "v_y", "v_z"} <= set(names):
        return None
    return [names.index(n) for n in ("v_x", "v_y", "v_z")], rates


def derivative_columns(system: SystemInfo) -> dict[str, tuple[list[int], list[int]]]:
    """Columns (positions, velocities) by group; a group has one frame, one unit and one name, so that norms exist.

    Of `yaw` and `pitch`, or of `q1` and `q2`, each is a group: they have sensors of their own, and no common name (both
    rates of a gimbal that were late were "yaw is late against yaw").
    """
    groups: dict[str, list[tuple[int, int]]] = {}
    frames = [frame for _, _, frame in system.position_derivatives]
    for frame, (i, j) in zip(frames, rate_pairs(system), strict=True):
        unit = system.state_units[i]
        kind = "angle" if unit == "rad" else "position"
        groups.setdefault(f"{kind} ({frame}, {unit})", []).append((i, j))
    out: dict[str, tuple[list[int], list[int]]] = {}
    for group, pairs in groups.items():
        positions, rates = [p for p, _ in pairs], [v for _, v in pairs]
        names = [[system.state_names[k] for k in some] for some in (positions, rates)]
        if len(pairs) == 1 or all(len({common_name([n, n]) for n in some}) == 1 for some in names):
            out[group] = positions, rates
            continue
        kind, _, rest = group.partition(" ")
        out |= {f"{kind} {system.state_names[a]} {rest}": ([a], [b]) for a, b in pairs}
    return out


def common_name(names: Sequence[str]) -> str:
    """What several states are called together: `p` for `p_x`, `p_y` and `p_z`."""
    return names[0] if len(names) == 1 else names[0].rsplit("_", 1)[0]


def channel_columns(system: SystemInfo, channel: str) -> list[int]:
    """Columns of a state, or of all whose common name this is; an attitude moves as one (else a ConfigError)."""
    names = list(system.state_names)
    of_attitude = [] if system.quaternion is None else names[system.quaternion]
    if channel in of_attitude:
        raise ConfigError(
            f"{channel!r} is a part of an attitude; name it whole: {common_name(of_attitude)!r}."
        )
    if channel in names:
        return [names.index(channel)]
    out = [k for k, name in enumerate(names) if name.startswith(channel + "_")] if channel else []
    if not out:
        vectors = sorted({n.rsplit("_", 1)[0] for n in names if n not in of_attitude} - set(names))
        whole = [*([common_name(of_attitude)] if of_attitude else []), *(v for v in vectors if v)]
        raise ConfigError(
            f"{channel!r} is no state of system {system.name!r}; states: {', '.join(names)}"
            + (f"; several at once: {', '.join(whole)}." if whole else ".")
        )
    return out
