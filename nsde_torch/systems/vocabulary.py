"""What a law that is written as text may speak of, for each system: its variables and its ports."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import TYPE_CHECKING

from torch import Tensor

from nsde_torch.columns import join_columns
from nsde_torch.effects import units
from nsde_torch.effects.base import Effect, Port
from nsde_torch.effects.expression import FEATURES, TIME, UP, Rows, Source, Vocabulary
from nsde_torch.rotation import gravity_direction
from nsde_torch.systems.in_run import row_by_row
from nsde_torch.systems.names import MIXED

if TYPE_CHECKING:
    from nsde_torch.systems.base import System

_AXES = ("x", "y", "z")


@cache
def vocabulary(cls: type[System]) -> Vocabulary:
    """Variables and ports of a system: states, features, inputs, inputs mixed as its motors are, and the time."""
    out: dict[str, tuple[str, Source]] = {}
    for k, (name, unit) in enumerate(zip(cls.state_names, cls.state_units, strict=True)):
        out[name] = (unit, Source("state", k))
    for k, (name, unit) in enumerate(zip(cls.feature_names, cls.feature_units, strict=True)):
        out.setdefault(name, (unit, Source(FEATURES, k)))
    if cls.quaternion is not None:
        for k, axis in enumerate(_AXES):
            out.setdefault(f"up_{axis}", ("1", Source(UP, k)))
    for k, (name, unit) in enumerate(zip(cls.input_names, cls.input_units, strict=True)):
        out.setdefault(name, (unit, Source("input", k)))
    for name, weights in zip(MIXED, getattr(cls, "mixing", ()), strict=False):
        out.setdefault(name, ("1", Source("mixed", 0, tuple(weights))))
    out.setdefault("time", ("s", Source(TIME)))
    return Vocabulary(
        cls.name,
        tuple((name, unit, source) for name, (unit, source) in out.items()),
        tuple(_ports(cls).items()),
        tuple(offered(cls).items()),
    )


def offered(cls: type[System]) -> dict[str, int]:
    """Columns that effects on force ports may read beside state and input (see `System.quantities`)."""
    up = {UP: 3} if cls.quaternion is not None else {}
    return {**cls.quantities, FEATURES: len(cls.feature_names), **up}


def quantity_of(system: System, name: str, x: Tensor, u: Tensor) -> Tensor:
    """One of the quantities that a system offers (N, its columns), from state and applied input."""
    if name == FEATURES:
        return system.features(x)
    if name == UP and system.quaternion is not None:
        return gravity_direction(x[:, system.quaternion])
    quantity = partial(system.quantity, name)
    return row_by_row(system, quantity, x, u) if system.in_run else quantity(x, u)


def seen_by(system: System, effect: Effect, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
    """What an effect on a force port, which need not be one of the system's, would be given as its input.

    That is (N, nu + what it reads), at a time [s], from state and memory (N, nz) and from input and exogenous channels
    (N, nu + n_exogenous).
    """
    columns = [system.nu + system.exogenous.index(name) for name in effect.exogenous]
    return given(system, effect, columns, z[:, : system.nx], system.applied(t, z, u), u)


def given(
    system: System, effect: Effect, columns: Sequence[int], x: Tensor, command: Tensor, u: Tensor
) -> Tensor:
    """What an effect is given as its input: the command so far, its logged columns of `u`, its quantities."""
    if not columns and not effect.quantities:
        return command
    read = (quantity_of(system, name, x, command) for name in effect.quantities)
    return join_columns((command, *(u[:, c : c + 1] for c in columns), *read))


def named_inputs(system: System, u: Tensor) -> dict[str, Tensor]:
    """Inputs (N,) of rows (N, nu + n_exogenous) by name, mixed as motors are where the machine has some."""
    mix, own = getattr(system, "mix", None), u[:, : system.nu]
    if mix is not None:
        return dict(zip(MIXED, (own @ mix.to(own)).T, strict=True))
    return dict(zip(system.input_names, own.T, strict=True))


def _ports(cls: type[System]) -> dict[str, Rows]:
    known = {port: residual.unit for port, residual in cls.residual_ports.items()}
    of_rows = {(at.port, at.row): dict(at.units)["force"] for at in cls.bound_coordinates()}
    forces = {Port.WORLD_FORCE: known.get(Port.BODY_FORCE, known.get(Port.FORCE, ""))}
    out: dict[str, Rows] = {}
    for port, width in cls.ports.items():
        at = {c.row: c.declared for c in cls.bound_coordinates() if c.port is port}
        names = tuple(at[k] for k in range(width)) if len(at) == width else tuple(map(str, range(width)))
        if len(at) != width and width == len(_AXES):
            names = _AXES
        names = ("",) if width == 1 else names
        unit = known.get(port) or forces.get(port, "")
        out[port.value] = Rows(names, tuple(of_rows.get((port, k), unit) for k in range(width)))
    only = len(cls.input_names) == 1
    out[Port.INPUT.value] = Rows(("",) if only else cls.input_names, cls.input_units)
    rates = tuple(units.of("state/s", {"state": unit}) for unit in cls.state_units)
    out[Port.RATE.value] = Rows(cls.state_names, rates)
    return out
