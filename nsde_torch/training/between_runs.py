"""What differs between the runs that a model is trained on, and so will differ in a run that it has not seen.

    e_r = J theta + sum_c J_c d_cr + noise in run r,      d_cr ~ N(0, tau_c^2)

Candidates c are the parameters of the physics, a steady force, and the zero of a position. One pass of the likelihood
leaves the Gram matrix of each run; with these, all d are integrated out in closed form, as in a linear mixed model
(Harville, JASA 72 (1977)): with G_r of [e, theta | c], M_r of c, T = diag(tau^2) and W_r = (T^-1 + M_r)^-1,

    log p = -1/2 [e'e](G) - 1/2 log|[theta'theta](G)| - 1/2 sum_r log|I + T M_r|,
    G = sum_r G_r - G_r[:, c] W_r G_r[c, :]

after theta has been fitted to it. The tau that raises this most joins, until none does beyond chance. What a model does
with them: physics is fitted with numbers for each run, networks and noise learn what is left, and a prediction draws
numbers of its own for each path (`nsde_torch.systems.in_run.in_new_runs`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import chdtri, ndtri, stdtrit

from nsde_torch.arrays import Array, Labels
from nsde_torch.data import Run
from nsde_torch.effects import Effect, Port
from nsde_torch.effects.by_run import BY_RUN, MASS, OF_EACH_RUN, RUN, ByRun, target_of
from nsde_torch.effects.law import joined_name, split_name
from nsde_torch.inference import MaximumLikelihood, Optimum
from nsde_torch.inference.functions import Functions, seen_by_networks
from nsde_torch.inference.sensitivity import Grams, grams, half_squares, solved
from nsde_torch.systems import System
from nsde_torch.systems.coordinates import no_zero
from nsde_torch.systems.in_run import OVER_MASS, difference_on, may_differ, of_mass
from nsde_torch.systems.parameters import ParameterVector

FEWEST = 3
"""Runs from which a spread between them is estimated: of two, Student's t is 3.8 times as wide as a normal law."""
# nothing differs in 25 springs of one machine and 8 with a dry friction that nobody declared (results/models.md)
_CHANCE = 0.01  # of a spread where there is none, among all candidates
_SPREADS = np.geomspace(0.5, 500.0, 25)  # tau, in standard errors of a number of one run
_ROWS = 5  # of the data, at which formulas are asked whether a parameter may differ between rows
_LEVEL = 0.9


@torch.no_grad()
def differing(at: Optimum, beside: Functions | None) -> list[str]:
    """Targets of what surely differs between runs, the surest first.

    At the optimum of the physics, whose theta is in use; held against the functions that were learned `beside` it.
    """
    space, about, vector = at.of.space, at.about, at.of.vector
    owner, _ = space.chunks.places()
    if len(np.unique(owner)) < FEWEST:
        return []
    system = vector.at(at.theta)
    tables = [space.columns(about.x, about.slopes, range(len(vector)), about.after).float()]
    candidates = _of_the_physics(at, system)
    able = system.able_effects()
    # of which there may be another in each run; a zero that a steady force is the same as is none
    steady = [
        name
        for name, effect in able.items()
        if split_name(name)[0] in OF_EACH_RUN and not (effect.port is Port.POSITION and no_zero(system, name))
    ]
    names = [name for name in steady if name not in system.effect_names]
    if names:
        wider = at.of.of(system.with_effects(*(system.make_effect(name) for name in names)))
        known = dict(zip(vector.labels, at.theta.tolist(), strict=True))
        wider.space.use(wider.vector.inside(wider.vector.first_values(known)))
        for name in names:
            own, first = wider.vector.of(name), sum(table.shape[-1] for table in tables)
            tables.append(wider.space.columns(about.x, about.slopes, own, about.after).float())
            law, coordinate = split_name(name)
            candidates[joined_name(OF_EACH_RUN[law], coordinate)] = first + np.arange(len(own))
        space.use(at.theta)
    forces = _forces(at, system, beside)
    held = grams(space, at.levels, about, at.at, torch.cat(tables, -1), forces=forces)
    of_runs = np.stack([held.blocks[owner == run].sum(0) for run in np.unique(owner)])
    count, size = len(vector), of_runs.shape[1]
    shared = np.concatenate(([0], 1 + at.free, np.arange(size - len(forces), size)))
    inflation = Grams(held.blocks[:, : 1 + count, : 1 + count], held.rows, count).inflation(at.free)
    over_mass = _over_mass(at.of.vector, system)
    if system.over_mass and np.isin(over_mass, at.free).all() and len(over_mass) > 1:
        turn = np.column_stack((np.eye(size), np.zeros(size)))
        turn[1 + over_mass, size] = -at.theta[over_mass]
        of_runs = turn.T @ of_runs @ turn
        candidates[MASS] = np.array([size - 1])
    return _chosen(of_runs / inflation, shared, candidates)


def _over_mass(vector: ParameterVector, system: System) -> Labels:
    """Columns of the parameters that go with 1 / mass: the machine's own, and sizes of forces over the mass."""
    effects = {str(e.name): e for e in system.effects if isinstance(e, Effect)}
    out: list[int] = []
    for place in vector.places:
        name, dot, own = place.name.rpartition(".")
        of_effect = dot and effects[name].port in OVER_MASS and own in effects[name].size_names()
        if of_effect if dot else own in system.over_mass:
            out += range(place.columns.start, place.columns.stop)
    return np.array(out, dtype=np.int64)


def _of_the_physics(at: Optimum, system: System) -> dict[str, Labels]:
    """Parameters that one number for each row fits, of those that the data show, with their columns."""
    steps, vector = at.of.space.steps, at.of.vector
    some = torch.linspace(0, len(steps) - 1, _ROWS).long()
    x, u = steps.x0[some, : system.nx].double(), steps.u[some].double()
    effects = {str(e.name): e for e in system.effects if isinstance(e, Effect)}
    out = {}
    for place in vector.places:
        name, dot, own = place.name.rpartition(".")
        effect = effects[name] if dot else None
        columns = np.arange(place.columns.start, place.columns.stop)
        if not np.isin(columns, at.free).all():
            continue
        if effect is not None and (
            own not in effect.size_names() or effect.port is Port.INPUT or effect.n_memory
        ):
            continue
        target = f"{name}/{own}" if dot else own
        if may_differ(system, target, x, u):
            out[target] = columns
    return out


def _forces(at: Optimum, system: System, beside: Functions | None) -> list[tuple[int, torch.Tensor]]:
    """The force of the functions on each disturbance that has some, at the steps (T, C, 1)."""
    if beside is None:
        return []
    variables, about, chunks = seen_by_networks(system), at.about, at.of.space.chunks
    middle = at.of.space.midway(about.x, about.after)
    flat = variables.values(middle.flatten(0, 1), chunks.u.flatten(0, 1)).numpy()
    values = {name: flat[:, k] for k, name in enumerate(variables.names)}
    ports = sorted({g.port for g in beside.groups if g.kind != "past"})
    forces = {k: torch.from_numpy(beside.force(values, k)[0]).double() for k in ports}
    return [(k, force.view(*about.x.shape[:2], 1)) for k, force in forces.items()]


def _chosen(of_runs: Array, shared: Labels, candidates: Mapping[str, Labels]) -> list[str]:
    """Targets that raise the likelihood beyond chance, of candidates with their columns of the Gram matrices."""
    enough = 0.5 * float(chdtri(1, 2.0 * _CHANCE / max(len(candidates), 1)))
    information = {name: float(of_runs[:, 1 + c, 1 + c].mean()) for name, c in candidates.items()}
    chosen: dict[str, float] = {}  # with the variance

    def likelihood(some: Mapping[str, float]) -> float:
        columns = np.concatenate([np.arange(0), *(1 + candidates[name] for name in some)])
        variance = np.concatenate([np.zeros(0), *(np.full(len(candidates[n]), v) for n, v in some.items())])
        return _log_likelihood(of_runs, shared, columns, variance)

    now = likelihood({})
    while True:
        found = [
            (likelihood({**chosen, name: variance}), name, variance)
            for name, size in information.items()
            if name not in chosen and size > 0
            for variance in (np.square(_SPREADS) / size).tolist()
        ]
        best, name, variance = max(found, key=lambda f: f[0], default=(-np.inf, "", 0.0))
        if not best - now > enough:
            return list(chosen)
        chosen[name], now = variance, best


def _log_likelihood(of_runs: Array, shared: Labels, columns: Labels, variance: Array) -> float:
    """Restricted log likelihood, up to a constant; see the module docstring.

    Of Gram matrices of each run (R, n, n), columns of e and of what all runs share, and columns (k,) of what differs
    with its variances (k,).
    """
    inner = of_runs[:, columns[:, None], columns]
    across = of_runs[:, shared[:, None], columns]
    root = np.sqrt(variance)
    unit = np.eye(len(columns)) + root[:, None] * inner * root
    left = across * root
    total = (of_runs[:, shared[:, None], shared] - left @ np.linalg.solve(unit, left.swapaxes(1, 2))).sum(0)
    scale = np.diag(of_runs.sum(0))[shared].clip(1e-300)[1:]
    shown = total[1:, 1:] / np.sqrt(scale * scale[:, None])
    sizes = np.linalg.slogdet(unit)[1].sum() + np.linalg.slogdet(shown + 1e-12 * np.eye(len(shown)))[1]
    return float(-half_squares(total, solved(total)) - 0.5 * sizes)


# ---- physics with numbers for each run -----------------------------------------------------------------


def numbered(runs: Sequence[Run], system: System) -> list[Run]:
    """Runs with their number behind the inputs and the channels that a system reads."""
    at = system.nu + len(system.exogenous)
    out = []
    for number, run in enumerate(runs):
        column = np.full(len(run), float(number))
        u = np.column_stack((run.u[:, :at], column, run.u[:, at:]))
        out.append(replace(run, u=u, extra={**run.extra, RUN: column}))
    return out


def with_numbers(system: System, targets: Sequence[str], runs: int) -> System:
    """The machine with numbers for each run, all nothing; it reads the number of the run."""
    system = system.reading(RUN)
    made: list[Effect] = []
    for target in targets:
        steady = split_name(target)[0] in BY_RUN
        cls = system.effect_class(target) if steady else difference_on(system, target)
        assert issubclass(cls, ByRun)
        values: dict[str, float | list[float]] = {cls.numbers(): [0.0] * (cls.width * (runs - cls.first))}
        made.append(system.make_effect(target, values) if steady else cls(values))
    return system.with_effects(*made)


@dataclass(frozen=True)
class RunSpread:
    """How far something differs between runs."""

    target: str
    of_runs: tuple[tuple[float, ...], ...]
    """Its numbers in each run; of a parameter, less the mean of all runs."""
    std: tuple[float, ...]
    """Standard deviations of a normal law whose 90 % interval holds a run that was not seen (Student's t)."""
    unit: str


def spreads(system: System) -> list[RunSpread]:
    """What differs between runs, of a machine whose numbers for each run were fitted."""
    out = []
    for effect in system.effects:
        if not isinstance(effect, ByRun):
            continue
        key = effect.numbers()
        each = effect.value(key).detach().double().reshape(effect.width, -1).T.numpy()
        each = np.concatenate((np.zeros((effect.first, effect.width)), each))
        count = len(each)
        if of_mass(system, target_of(str(effect.name))):  # relative to the mean
            each = (1.0 + each) / (1.0 + each.mean(0)) - 1.0
        if target_of(str(effect.name)):  # about the mean, which is not known better than by these runs
            each = each - each.mean(0)
            square, degrees = np.square(each).sum(0) / (count - 1) * (1.0 + 1.0 / count), count - 1
        else:  # about nothing
            square, degrees = np.square(each).mean(0), count
        wider = stdtrit(degrees, 0.5 + 0.5 * _LEVEL) / ndtri(0.5 + 0.5 * _LEVEL)
        std = tuple((wider * np.sqrt(square)).tolist())
        target = target_of(str(effect.name)) or str(effect.name)
        out.append(RunSpread(target, tuple(map(tuple, each.tolist())), std, effect.parameter(key).unit))
    return out


def means(vector: ParameterVector, numbers: System) -> Array:
    """Declared parameters, of a machine with numbers for each run: the mean over the runs where they differ."""
    fitted, out = numbers.all_declared(), np.empty(len(vector))
    shifts: dict[str, Array] = {}
    heavier = 0.0
    for effect in numbers.effects:
        if isinstance(effect, ByRun) and target_of(str(effect.name)):
            each = effect.value("change").detach().double().reshape(effect.width, -1).numpy()
            shift = each.sum(1) / (each.shape[1] + 1)
            if of_mass(numbers, target_of(str(effect.name))):
                heavier = float(shift[0])
            shifts[target_of(str(effect.name)).replace("/", ".")] = shift
    for place in vector.places:
        value = fitted[place.name][0].detach().double().numpy()
        out[place.columns] = value + shifts.get(place.name, 0.0)
    out[_over_mass(vector, numbers)] /= 1.0 + heavier
    return out


def covariance_of_means(vector: ParameterVector, fitted: MaximumLikelihood) -> Array:
    """Covariance (k, k) of the declared parameters that `means` gives, from that of a fit with numbers for each run."""
    by_run, theta = fitted.vector, fitted.theta
    centre, slopes = means(vector, by_run.at(theta)), []
    for j in fitted.free:
        moved, h = theta.copy(), 1e-3 * by_run.scale[j]
        moved[j] += h
        slopes.append((means(vector, by_run.at(moved)) - centre) / h)
    table = np.array(slopes).reshape(-1, len(vector))
    return np.asarray(table.T @ fitted.spread.covariance @ table)
