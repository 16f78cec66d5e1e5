"""What may differ between runs, or change within one: parameters, the mass, steady forces, zeros, sizes of effects.

Each is some columns of what parameters do to the innovations: of the physics, or of an effect that is no part of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.candidates import candidate_names, effect_of, joined, starts
from nsde_torch.diagnosis.joint_selection import FittedPhysics
from nsde_torch.diagnosis.search import Search
from nsde_torch.effects import Effect, Port
from nsde_torch.effects.by_run import MASS, OF_EACH_RUN, ByRun, RunInertia
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import joined_name, split_name
from nsde_torch.errors import NsdeError
from nsde_torch.inference.sensitivity import grams
from nsde_torch.systems import System
from nsde_torch.systems.in_run import OVER_MASS, may_differ, of_mass
from nsde_torch.systems.parameters import Place

_ROWS = 5  # of the data, at which formulas are asked whether a parameter may differ between rows


@dataclass(frozen=True)
class PossibleDifference:
    """Something that may differ between runs."""

    system: System  # the physics; with what is no part of it yet
    # parameter that differs (`RunDifference.target`), or several with a comma between, or name of an effect with a size
    # for each run
    target: str
    turn: Array  # columns of the table that change together (K, k)
    new: bool  # whether the first run has numbers too: of what is no part of the physics yet


@dataclass(frozen=True)
class ColumnsBeside:
    """Columns of what may differ, beside those of the physics."""

    candidates: list[PossibleDifference]
    table: Tensor  # what they do to the steps (T, C, ne, K)
    blocks: Array  # Gram matrices of [e, columns] by block of time (B, 1 + K, 1 + K)


@torch.no_grad()
def columns_beside(
    search: Search, place: FittedPhysics, *, together: bool = False, steady: bool = False
) -> ColumnsBeside:
    """Columns of all that may differ, from the optimum of some physics: of effects, of the candidates alone.

    Of all its own parameters `together` too; of what is no part of it, of `steady` forces and zeros alone.
    """
    space, about, vector = place.at.of.space, place.at.about, place.best.vector
    tables = [space.columns(about.x, about.slopes, range(len(vector)), about.after)]
    known = dict(zip(vector.labels, place.best.theta.tolist(), strict=True))
    new: list[tuple[str, System, int, int]] = []
    at = len(vector)
    for target, system, label in _not_there(search, place, steady):
        own = place.at.of.of(system)
        own.space.use(own.vector.inside(own.vector.first_values(known)))
        labels = [(name, name.partition("[")[0]) for name in own.vector.labels]
        columns = [j for j, names in enumerate(labels) if label in names]
        tables.append(own.space.columns(about.x, about.slopes, columns, about.after).float())
        new.append((target, system, at, len(columns)))
        at += len(columns)
    space.use(place.best.theta)
    apart = [slice(1 + a, 1 + a + k) for _, _, a, k in new]
    table = torch.cat([t.float() for t in tables], -1)
    held = grams(space, place.at.levels, about, place.at.at, table, apart=apart)
    candidates = [
        PossibleDifference(s, target, np.eye(at)[:, a : a + k], split_name(target)[0] != RunInertia.name)
        for target, s, a, k in new
    ]
    candidates += _of_the_physics(place, at, together)
    return ColumnsBeside(candidates, table, held.blocks)


def _not_there(search: Search, place: FittedPhysics, steady: bool) -> Iterator[tuple[str, System, str]]:
    """What is no part of the physics and has one size: what differs, the physics with it, and the label of its size.

    Steady forces and zeros alone, if `steady`.
    """
    system = place.system
    for name in candidate_names(system, search.candidates):
        if steady and split_name(name)[0] not in OF_EACH_RUN:
            continue
        cls = system.effect_class(name)
        (law, coordinate), found = split_name(name), starts(system, name, place.at.of.sizes, ())
        simpler = next((system.effect_class(n) for n in cls.includes if n in system.effect_names), None)
        if simpler is None:
            sizes = cls.size_names()
        else:  # what it has beyond a part of the physics, at which it is that part: the wind, beside the drag
            shared = cls.shared(simpler)
            sizes = tuple(key for key in cls.PARAMETERS if key not in shared)
            found = [{**start, **dict.fromkeys(sizes, 0.0)} for start in found[-1:]]
        if len(sizes) != 1 or cls.exogenous or not _acts_linearly(cls):
            continue
        each = OF_EACH_RUN.get(law, RunInertia.name if law in RunInertia.includes else None)
        target = f"{name}/{sizes[0]}" if each is None else joined_name(each, coordinate)
        for start in found:
            try:
                there = joined(system, name, start)
            except NsdeError:
                continue
            if effect_of(there, name).n_memory or (each is None and not _may_differ(place, there, target)):
                break
            yield target, there, f"{name}.{sizes[0]}"


def _may_differ(place: FittedPhysics, system: System, target: str) -> bool:
    """Whether the formulas of a system take a number for each row of some parameter."""
    steps = place.at.of.space.steps
    some = torch.linspace(0, len(steps) - 1, _ROWS).long()
    plain = system.without_effects(*(str(e.name) for e in system.effects if isinstance(e, ByRun)))
    u = steps.u[some, : system.nu + len(plain.exogenous)]
    return may_differ(plain, target, steps.x0[some, : system.nx].double(), u.double())


def _of_the_physics(place: FittedPhysics, whole: int, together: bool) -> Iterator[PossibleDifference]:
    """Parameters of the machine, sizes of its effects, and its mass, of a table of so many columns.

    `together`, all its own parameters too, unless the machine says what a load changes: one at the tip of an arm
    changes inertias and weights of both links, and no single parameter explains it. Of a quadrotor that lacked nothing,
    gains that feedback biases in each run anew were differences of four (closed_loop.py --seed 91, case 52).
    """
    system, vector, theta = place.system, place.best.vector, place.best.theta
    differing = {getattr(e, "target", "") for e in system.effects}
    mass, every = np.zeros((whole, 1)), np.eye(whole)
    machine: list[Place] = []
    for at in vector.places:
        name, dot, own = at.name.rpartition(".")
        effect = effect_of(system, name) if dot else None
        if effect is not None and (not _may_differ_in(effect, own) or is_law(name)):
            continue
        if own in system.over_mass if effect is None else effect.port in OVER_MASS:
            mass[at.columns, 0] = -theta[at.columns]
        target = f"{name}/{own}" if dot else own
        law, coordinate = split_name(name)
        if law in OF_EACH_RUN:
            each = joined_name(OF_EACH_RUN[law], coordinate)
            yield PossibleDifference(system, each, every[:, at.columns], False)
        elif target not in differing and _may_differ(place, system, target):
            yield PossibleDifference(system, target, every[:, at.columns], False)
            if (
                effect is None
                and np.isin(np.arange(at.columns.start, at.columns.stop), place.best.free).all()
            ):
                machine.append(at)
    if together and len(machine) > 1 and not system.over_mass:
        turn = np.concatenate([every[:, at.columns] for at in machine], 1)
        yield PossibleDifference(system, ",".join(at.name for at in machine), turn, False)
    if system.over_mass and of_mass(system, MASS) and MASS not in differing and int((mass != 0).sum()) > 1:
        yield PossibleDifference(system, MASS, mass, False)


def _acts_linearly(cls: type[Effect]) -> bool:
    """Whether an effect does not act on inputs, or is linear in its sizes there, as the loss of each motor is."""
    return cls.port is not Port.INPUT or (not cls.drifts and set(cls.size_names()) == set(cls.amplitudes))


def _may_differ_in(effect: Effect, own: str) -> bool:
    """Whether a parameter says how strong an effect is, or one step fits it, that acts at once."""
    sized = own in (*effect.size_names(), *effect.smooth) and not isinstance(effect, ByRun)
    return sized and _acts_linearly(type(effect)) and effect.n_memory == 0
