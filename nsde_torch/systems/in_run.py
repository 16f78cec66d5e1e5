"""Parameters of a machine as they are in the run of each row, where effects say that they differ between runs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from nsde_torch.effects import by_run
from nsde_torch.effects.base import Effect, Parametrised, Port
from nsde_torch.effects.law import split_name
from nsde_torch.errors import ConfigError

if TYPE_CHECKING:
    from nsde_torch.systems.base import System

_MOST = 0.95  # of the way to its bound that a number which is drawn may take a parameter
OVER_MASS = (Port.FORCE, Port.BODY_FORCE)  # ports of forces over the mass


@contextmanager
def in_its_run(system: System, effects: Sequence[int], u: Tensor) -> Iterator[Tensor | None]:
    """Give every row the parameters of its run, and yield what forces over the mass are multiplied by (N, 1).

    Of inputs and logged channels (N, nu + n), and the numbers of its effects on the port `parameter`.
    """
    column = system.nu + system.exogenous.index(by_run.RUN)
    changed: list[tuple[Parametrised, str]] = []
    lighter = None
    try:
        for k in effects:
            effect = system.effects[k]
            assert isinstance(effect, by_run.RunDifference)
            change = effect.of_run(u[:, column : column + 1])
            if of_mass(system, effect.target):
                lighter = 1.0 / (1.0 + change)
                turned, own = _times(lighter), [(cast(Parametrised, system), n) for n in system.over_mass]
            else:
                turned, own = _plus(change), [owner_of(system, effect.target)]
            for module, name in own:
                before = module.in_run.get(name)
                module.in_run[name] = turned if before is None else _both(before, turned)
                changed.append((module, name))
        yield lighter
    finally:
        for module, name in changed:
            module.in_run.pop(name, None)


def row_by_row(
    system: System, function: Callable[..., Tensor], *rows: Tensor | Mapping[Port, Tensor]
) -> Tensor:
    """A function of the machine (N, k), of rows (N, ...), with parameters of each, whatever way it is written in.

    A formula that takes columns of states apart, or puts a matrix together, has no place for a number of each row.
    """
    values = {name: system.value(name) for name in system.declared_parameters()}
    several = {name: value for name, value in values.items() if value.dim() > 1}
    before = dict(system.in_run)

    def one(own: dict[str, Tensor], *row: Tensor | Mapping[Port, Tensor]) -> Tensor:
        system.in_run.update({name: lambda _, value=value: value for name, value in own.items()})  # type: ignore[misc]
        return function(
            *(p[None] if isinstance(p, Tensor) else {k: v[None] for k, v in p.items()} for p in row)
        )[0]

    try:
        out: Tensor = torch.func.vmap(one)(several, *rows)
    finally:
        system.in_run.clear()
        system.in_run.update(before)
    return out


def of_mass(system: System, target: str) -> bool:
    """Whether a target is what forces are over, and no parameter of the machine's own that is called `mass`."""
    return target == by_run.MASS and by_run.MASS not in system.declared_parameters()


def owner_of(system: System, target: str) -> tuple[Parametrised, str]:
    """The machine or the effect that has a parameter, and the name of it there; a ConfigError where there is none."""
    effect, _, own = target.rpartition("/")
    owner: Parametrised | None = system
    if effect:
        owner = next((e for e in system.effects if isinstance(e, Effect) and e.name == effect), None)
    if owner is None or own not in owner.declared_parameters():
        raise ConfigError(
            f"{by_run.difference_name(target)!r} is of a parameter that {system.name!r} with these effects does not "
            "have."
        )
    return owner, own


def difference_on(system: System, target: str) -> type[by_run.RunDifference]:
    """The effect that a parameter of a machine differs between runs, in its unit.

    A ConfigError where there is no such parameter, or the machine does not say what goes with its mass.
    """
    if of_mass(system, target):
        if not system.over_mass:
            raise ConfigError(
                f"system {system.name!r} does not say which parameters go with its mass (`over_mass`)."
            )
        return by_run.difference_class(by_run.MASS)
    owner, own = owner_of(system, target)
    width = owner.raw[own].numel()
    return by_run.difference_class(target, width, owner.parameter(own).unit, owner.scale_of(own))


def in_new_runs(system: System, spread: Mapping[str, Sequence[float]], draws: Tensor) -> System:
    """A copy of a machine each row of which is in a run of its own that nobody has seen.

    It reads the column `run`, whatever stands there. `spread` has the standard deviations of what differs between runs,
    by target (an effect with a size for each run, or a parameter, see `RunDifference.target`), and `draws` are standard
    normal numbers of each row (N, n), n of all targets together.
    """
    out = system.reading(by_run.RUN)
    made = {
        target: out.make_effect(target)
        if split_name(target)[0] in by_run.BY_RUN
        else difference_on(out, target)()
        for target in spread
    }
    out = out.with_effects(*made.values())
    own = {str(effect.name): effect for effect in out.effects}
    first = 0
    for target, std in spread.items():
        effect = own[str(made[target].name)]
        assert isinstance(effect, by_run.ByRun)
        effect.drawn = draws[:, first : first + len(std)] * draws.new_tensor(std)
        first += len(std)
        if of_mass(system, target):
            effect.drawn = effect.drawn.clamp_min(-_MOST)
        elif isinstance(effect, by_run.RunDifference):
            owner, name = owner_of(system, target)
            value, low = owner.value(name), owner.parameter(name).low
            if low is not None:
                effect.drawn = effect.drawn.maximum(_MOST * (low - value))
    return out


def _plus(change: Tensor) -> Callable[[Tensor], Tensor]:
    return lambda value: value + change.to(value.dtype)


def _times(factor: Tensor) -> Callable[[Tensor], Tensor]:
    return lambda value: value * factor.to(value.dtype)


def _both(first: Callable[[Tensor], Tensor], then: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda value: then(first(value))


@torch.no_grad()
def may_differ(system: System, target: str, x: Tensor, u: Tensor) -> bool:
    """Whether a machine's formulas take a value for each row in the place of one for all, at some rows.

    The machine has no effects on the port `parameter`; states (N, nx) are in double precision, with inputs and logged
    channels (N, nu + n).
    """
    made = difference_on(system, target)
    if not made.width:  # a number for each input, of a machine that has none
        return False
    effect = made({"change": [0.1] * made.width}).to(x.dtype)
    effect.set_value("change", 0.1 * effect.scale_of("change"))
    machine = system.reading(by_run.RUN).to(x.dtype).with_effects(effect)
    run = torch.arange(len(x), dtype=x.dtype)[:, None] % 2.0
    wide = torch.cat((u, run), 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of shapes that nobody meant
            rows = machine.drift(0.0, machine.augment(x, wide), wide)
        each = [
            machine.drift(0.0, machine.augment(a, b), b)
            for a, b in zip(x.split(1), wide.split(1), strict=True)
        ]
    except (RuntimeError, IndexError, ValueError):
        return False
    return rows.shape[0] == len(x) and bool(torch.allclose(rows, torch.cat(each), rtol=1e-9, atol=1e-12))
