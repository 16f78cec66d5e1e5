"""Residual networks from functions that the likelihood chose (`nsde_torch.inference.functions`).

A network is what flies, is exported and is planned with; a linear basis is what can be chosen by evidence. So the
functions are found first, and each port's network is fitted to their sum: over the data as they are, beyond them as far
as they are known there, and fading from one and a half of their range on: the model returns to its physics. A network
sees only what was chosen for its port.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nsde_torch.arrays import Array
from nsde_torch.effects import Port
from nsde_torch.evaluation.one_step import Residuals
from nsde_torch.inference import Optimum
from nsde_torch.inference.functions import BasisGroup, Functions, learned, seen_by_networks
from nsde_torch.models.networks import MLP
from nsde_torch.models.neural_sde import NeuralSDE

_FIT_ROWS = 1000  # points of the data that a network is fitted at
_BEYOND = 300  # and points beyond their range
_REACH, _FADE = 4.0, 1.0  # half ranges that those go to, and over which the force fades
_STEPS, _SETTLED, _PATIENCE, _MOST_DAMPING = 120, 1e-3, 10, 1e8  # of the fit of a network
_STARTS, _TRIED = 3, 30  # beginnings, and the steps after which the best of them goes on
_THINNED = 4  # one in so many points does for these steps
# faded from 1, the hardening spring of seed 2 of bench_networks.py (held-out run 40 % beyond the data) has a share of
# 0.22, with 1.5 it has 1.00
_MARGIN = 1.5  # half ranges from which the force fades
_DECAY = 1e-9  # of the squares of the network's weights
_EXACT = 1e-5  # mean square that is left, of a target of size 1: a law to a third of a percent
_NEAR, _LESS = 0.1, 0.02  # weights of points beyond the data, inside the margin and outside


@dataclass(frozen=True)
class Distilled:
    """Networks that were fitted to functions."""

    functions: Functions
    # by port, as plain values: what its network wins on blocks of time left out [nats], the standard error of that
    # over blocks, whether it is kept, and the variables that it sees
    networks: dict[str, dict[str, Any]]
    spread: Array
    """Standard error of the networks' change over a step, by channel that forces move (root mean square)."""
    score: float  # minus the log density of a step and channel, on blocks of time left out [nats]
    steps: int  # steps of the fits of the networks
    chosen: list[dict[str, Any]]  # the groups of functions, as plain values: port, its row, variables, kind


def functions_of(
    model: NeuralSDE, at: Optimum, *, among: Sequence[Mapping[str, Any]] | None = None
) -> Functions:
    """What the likelihood finds beside the optimum, among all functions or these groups (`Distilled.chosen`)."""
    space = at.of.space
    ports = [k for k, (port, _) in enumerate(space.disturbances) if port in model.residual_ports]
    groups = None
    if among is not None:  # of the disturbances that there are
        rows = {(port.value, j): k for k, (port, j) in enumerate(space.disturbances)}
        places = [(rows.get((g["port"], g["row"])), g) for g in among]
        groups = [BasisGroup(k, tuple(g["variables"]), g["kind"]) for k, g in places if k is not None]
    return learned(at, seen_by_networks(at.of.vector.system), ports, among=groups)


def fit_functions(model: NeuralSDE, found: Functions, at: Optimum, left: Residuals) -> Distilled:
    """Fit residual networks, in place, to functions; `left` is what the physics leaves, for the size of the doubt."""
    space, system = at.of.space, at.of.vector.system
    names = system.network_names
    seen = system.network_features(left.states.double()).numpy()
    values = {name: seen[:, k] for k, name in enumerate(names)}
    networks: dict[str, dict[str, Any]] = {}
    variance, column, steps = np.zeros(len(left.rows)), 0, 0
    for port, width in left.ports:
        rows = {j: k for k, (of, j) in enumerate(space.disturbances) if of is port and k in found.nats}
        own = {v for g in found.groups if g.port in rows.values() and g.kind != "past" for v in g.variables}
        variables = tuple(name for name in names if name in own)
        networks[port.value] = {
            "nats": sum(found.nats[k] for k in rows.values()),
            "standard_error": sum(found.error[k] ** 2 for k in rows.values()) ** 0.5,
            "kept": bool(rows),
            "variables": list(variables),
        }
        steps += _distil(model, port, found, rows, seen, variables)
        for j, k in rows.items():
            doubt = np.sqrt(found.force(values, k)[1])
            variance += np.square(left.response[:, :, column + j].numpy() * doubt[:, None]).mean(0)
        column += width
    score = -float(found.blocks[1].sum()) / space.measurements
    chosen = [
        {"port": port.value, "row": j, "variables": list(g.variables), "kind": g.kind}
        for g in found.groups
        for port, j in [space.disturbances[g.port]]
    ]
    return Distilled(found, networks, np.sqrt(variance), score, steps, chosen)


def _distil(
    model: NeuralSDE, port: Port, found: Functions, rows: Mapping[int, int], seen: Array, own: Sequence[str]
) -> int:
    """Fit one network to the functions on the rows of its port, which only their variables reach; steps taken."""
    network, names = model.residuals[port.value], model.system.network_names
    assert isinstance(network, MLP)
    first, last = network.layers[0], network.layers[-1]
    unseen = [k for k, name in enumerate(names) if name not in own]
    with torch.no_grad():
        first.weight[:, unseen] = 0.0
        if not rows:
            silence(network)
            return 0
    points = _points(seen, names, own, found)
    within, _ = _inside(points, names, own, found, 1.0)
    near, far = _inside(points, names, own, found, _MARGIN)
    edge, values = ({name: at[:, k] for k, name in enumerate(names)} for at in (within, near))
    target = torch.zeros(len(points), last.out_features)
    for j, k in rows.items():
        force, spread = found.force(values, k, edge)
        # beyond the data as far as it is known there
        doubt = (spread - found.force(edge, k)[1]).clip(0.0)
        force = force * np.square(force) / (np.square(force) + doubt).clip(1e-300)
        target[:, j] = torch.from_numpy(force * far / model.residual_scale(port)).float()
    with torch.no_grad():
        y = model.residual_inputs(torch.from_numpy(points).float())
        y[:, unseen] = 0.0
        size = target.square().mean().sqrt().clamp_min(1e-12)
    weight = torch.ones(len(points))
    weight[-_BEYOND:] = torch.where(torch.from_numpy(far[-_BEYOND:]) == 1.0, _NEAR, _LESS).float()
    steps = _fit(network, y, target / size, weight, sorted(rows))
    silent = [j for j in range(last.out_features) if j not in rows]
    with torch.no_grad():
        for parameter in last.parameters():
            parameter.mul_(size)
            parameter[silent] = 0.0
    return steps


def _fit(network: MLP, y: Tensor, target: Tensor, weight: Tensor, rows: Sequence[int]) -> int:
    """Least squares from the best of some beginnings, of which many end where neurons say the same."""
    generator = torch.Generator().manual_seed(0)
    begun = [copy.deepcopy(network) for _ in range(_STARTS)]
    for other in begun:
        _redrawn(other, generator)
    few = slice(None, None, _THINNED)
    tried = [_least_squares(other, y[few], target[few], weight[few], rows, _TRIED) for other in begun]
    left, before = min(tried)
    best = begun[tried.index((left, before))]
    _, steps = _least_squares(best, y, target, weight, rows, _STEPS)
    network.load_state_dict(best.state_dict())
    return before + steps


@torch.no_grad()
def _redrawn(network: MLP, generator: torch.Generator) -> None:
    """Other first weights of the same size; inputs that a network does not see stay unseen."""
    for layer in network.layers:
        bound = layer.in_features**-0.5
        drawn = torch.empty_like(layer.weight).uniform_(-bound, bound, generator=generator)
        seen = layer.weight != 0 if layer is network.layers[0] else torch.tensor(True)
        layer.weight.copy_(torch.where(seen, drawn, 0.0))


def _least_squares(
    network: MLP, y: Tensor, target: Tensor, weight: Tensor, rows: Sequence[int], steps: int
) -> tuple[float, int]:
    """Least squares of some outputs by Levenberg and Marquardt, in double precision; what is left, and steps taken."""
    seen = (y != 0).any(0)
    y, target, root = y.double()[:, seen], target.double()[:, rows], weight.double().sqrt()[:, None]
    names, tables = zip(*((name, table.detach()) for name, table in network.named_parameters()), strict=True)
    # weights of inputs that are not seen and of outputs that are not fitted have no say
    live = [torch.ones_like(table, dtype=torch.bool) for table in tables]
    live[0] &= seen
    for table in live[-2:]:
        table[[j for j in range(len(table)) if j not in rows]] = False
    shapes = [[len(at.nonzero()[:, axis].unique()) for axis in range(at.ndim)] for at in live]
    counts = [int(at.sum()) for at in live]
    phi = torch.cat([table[at].double() for table, at in zip(tables, live, strict=True)])
    scale, pull_back = root / len(y) ** 0.5, torch.eye(len(phi), dtype=phi.dtype) * _DECAY

    def outputs(phi: Tensor, y: Tensor) -> Tensor:
        parts = (part.view(shape) for part, shape in zip(phi.split(counts), shapes, strict=True))
        out: Tensor = torch.func.functional_call(network, dict(zip(names, parts, strict=True)), (y,))
        return out

    def left(phi: Tensor) -> Tensor:
        return scale * (outputs(phi, y) - target)

    def size_of(phi: Tensor, value: Tensor) -> float:
        return float(value.square().sum() + _DECAY * phi.square().sum())

    slopes_of = torch.func.vmap(torch.func.jacrev(lambda phi, row: outputs(phi, row[None])[0]), (None, 0))
    value = left(phi)
    damping, least, slow, taken = 1e-2, size_of(phi, value), 0, 0
    while taken < steps and least > _EXACT:
        taken += 1
        slopes = (slopes_of(phi, y) * scale[..., None]).flatten(0, 1)
        gram = slopes.T @ slopes + pull_back
        pull = slopes.T @ value.flatten() + _DECAY * phi
        moved = False
        while damping < _MOST_DAMPING:
            step = torch.linalg.solve(gram + damping * torch.diag(gram.diagonal()), pull)
            there = left(phi - step)
            size = size_of(phi - step, there)
            if size < least:
                slow, moved = 0 if size < (1.0 - _SETTLED) * least else slow + 1, True
                phi, value, least, damping = phi - step, there, size, max(0.2 * damping, 1e-10)
                break
            damping *= 4.0
        if not moved or slow == _PATIENCE:
            break
    for table, at, part in zip(tables, live, phi.split(counts), strict=True):
        table[at] = part.to(table)
    return least, taken


def _points(seen: Array, names: Sequence[str], variables: Sequence[str], found: Functions) -> Array:
    """Points of the data, and such with the variables of the functions spread beyond their range."""
    rng = np.random.default_rng(0)
    data = seen[rng.choice(len(seen), min(_FIT_ROWS, len(seen)), replace=False)]
    beyond = seen[rng.choice(len(seen), _BEYOND)].copy()
    for name in variables:
        scale = found.scaled[name]
        beyond[:, names.index(name)] = scale.centre + scale.half * rng.uniform(-_REACH, _REACH, _BEYOND)
    return np.concatenate((data, beyond))


def _inside(
    points: Array, names: Sequence[str], variables: Sequence[str], found: Functions, margin: float
) -> tuple[Array, Array]:
    """The nearest points inside some half ranges of the data, and the share of the force left at the points (N,)."""
    inside, away = points.copy(), np.zeros(len(points))
    for name in variables:
        k, scale = names.index(name), found.scaled[name]
        s = (points[:, k] - scale.centre) / scale.half
        inside[:, k] = scale.centre + scale.half * np.clip(s, -margin, margin)
        away += np.square((np.abs(s) - margin).clip(0.0) / _FADE)
    return inside, np.exp(-0.5 * away)


@torch.no_grad()
def silence(network: nn.Module) -> None:
    """Let a network say nothing."""
    for parameter in network.layers[-1].parameters():  # type: ignore[union-attr, index]
        parameter.zero_()
