"""What may be true: physics fitted to the runs there are, with what these leave open.

All members are fitted at the noise levels of the likeliest, so that they are compared by their physics alone.

Runs that mostly move fast say nothing of the width of speed within which a friction develops, below some bound, and no
quadratic about one optimum says so. So a member is followed at a few widths, each with the other parameters fitted
again and weighed by how well it explains the runs (`branches`): what is drawn comes from all of them, and an experiment
is fitted from each. The bound that a search keeps widths above (`ParameterVector.limit`) is moved down for the slower
experiment (docs/content/theory/experiments.md).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product
from math import ceil
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.design.questions import Question
from nsde_torch.diagnosis.candidates import alone, starts
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.effects import Effect, Port
from nsde_torch.effects.law import Law
from nsde_torch.errors import ConfigError, NsdeError
from nsde_torch.inference import LogLikelihood, maximised
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.posterior import LogWithPrior, Posteriors
from nsde_torch.inference.state_space import StateSpace, forces_on, moved
from nsde_torch.inference.steps import data_sizes
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector, own_name

# Experiments of a member, many at once, each with parameters of its own.
#
#     dx = (f(x, u; theta) + B d) dt,  Runge and Kutta's fourth order;     measured_k = x_k + s_k
#
# with d and s drawn from the noise levels of the likelihood (`ModelNoise`).

Drive = Callable[[int, Tensor], Tensor]
"""Inputs (B, nu) from the number of the step and the measured states (B, nx)."""
_SUBSTEPS = 8


Disturbances = tuple[Array, tuple[tuple[Port, int], ...], Array]
"""What acts on experiments beside the inputs: forces held over each step (B, N, nd), the columns of the ports that they
act on, and errors of the sensors (B, N + 1, ne)."""


@dataclass(frozen=True)
class ModelNoise:
    """Noise of largest likelihood."""

    space: StateSpace  # of the machine as the filter sees it
    levels: Levels

    def drawn(self, count: int, steps: int, rng: np.random.Generator) -> Disturbances:
        """What acts on `count` experiments."""
        space, levels, nd = self.space, self.levels, len(self.space.disturbances)
        white, gust, keep = (v.numpy() for v in (levels.white.exp(), levels.gust.exp(), levels.keep(space.h)))
        gusts = gust * rng.standard_normal((count, steps, nd))
        for k in range(1, steps):
            gusts[:, k] = keep * gusts[:, k - 1] + np.sqrt(1.0 - keep**2) * gusts[:, k]
        forces = gusts + white / space.h**0.5 * rng.standard_normal(gusts.shape)
        errors = np.zeros((count, steps + 1, len(space.vector.system.error_names)))
        noise = rng.standard_normal((count, steps + 1, len(space.observed)))
        errors[..., tuple(space.observed)] = levels.sensor.exp().numpy() * noise
        return forces, space.disturbances, errors


@final
class Rollouts:
    """Experiments of one system in steps of `dt` [s]."""

    def __init__(self, system: System, *, dt: float) -> None:
        self.vector, self.dt = ParameterVector(system), dt
        self.system = self.vector.system
        self._fine = self._substeps()
        self.fine_dt = dt / self._fine  # step of the integration [s]
        self._ports: tuple[tuple[Port, int], ...] = ()
        self._rk4 = torch.func.vmap(self._one)
        self._augmented = torch.func.vmap(self._first)

    @torch.no_grad()
    def run(
        self,
        thetas: Array,
        start: Array,
        drive: Drive,
        steps: int,
        noise: Disturbances | None = None,
        times: Array | None = None,
    ) -> tuple[Array, Array, Array]:
        """True and measured states (B, N + 1, nx) and inputs (B, N, nu) of experiments with parameters (B, k).

        They begin in states (B, nx) at `times` (B,) [s] or 0.
        """
        theta, x, system = torch.as_tensor(thetas), torch.as_tensor(start), self.system
        nx, errors, self._ports = system.nx, None, ()
        forces = torch.zeros(len(x), steps, 0, dtype=torch.float64)
        if noise is not None:
            forces, self._ports, errors = torch.as_tensor(noise[0]), noise[1], torch.as_tensor(noise[2])
        begun = torch.zeros(len(x), dtype=torch.float64) if times is None else torch.as_tensor(times)

        def measured_at(k: int, x: Tensor) -> Tensor:
            return x if errors is None else system.project(moved(system, x, errors[:, k]))

        true, measured = [x], [measured_at(0, x)]
        inputs = [drive(0, measured[0])]
        z = self._augmented(theta, x, inputs[0])
        for k in range(steps):
            if k:
                inputs.append(drive(k, measured[k]))
            for i in range(self._fine):
                t = begun + (k * self.dt + i * self.fine_dt)
                z = system.project(z + self._rk4(theta, t, z, inputs[k], forces[:, k]))
            true.append(z[:, :nx])
            measured.append(measured_at(k + 1, true[-1]))
        return torch.stack(true, 1).numpy(), torch.stack(measured, 1).numpy(), torch.stack(inputs, 1).numpy()

    def _first(self, theta: Tensor, x: Tensor, u: Tensor) -> Tensor:
        """One state of them; what lags behind another effect of the inputs begins where its parameters say."""
        self.vector.use(theta)
        return self.system.augment(x[None], u[None])[0]

    def _one(self, theta: Tensor, t: Tensor, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        self.vector.use(theta)
        h, forces = self.fine_dt, forces_on(self.system, self._ports[: len(d)], d[None])

        def f(share: float, at: Tensor) -> Tensor:
            return self.system.drift((t + share * h)[None], at[None], u[None], forces)[0]

        k1 = f(0.0, z)
        k2 = f(0.5, z + 0.5 * h * k1)
        k3 = f(0.5, z + 0.5 * h * k2)
        k4 = f(1.0, z + h * k3)
        return (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)

    @torch.no_grad()
    def _substeps(self) -> int:
        """Fine steps in a step: as many as follow the fastest mode at rest."""
        x = torch.zeros(1, self.system.nx, dtype=torch.float64)
        if self.system.quaternion is not None:
            x[:, self.system.quaternion.start] = 1.0
        u = torch.zeros(1, self.system.nu + len(self.system.exogenous), dtype=torch.float64)
        slopes = torch.func.jacfwd(lambda z: self.system.drift(0.0, z, u)[0])(self.system.augment(x, u))[:, 0]
        if not bool(torch.isfinite(slopes).all()):
            return _SUBSTEPS
        fastest = float(torch.linalg.eigvals(slopes).abs().max())
        return min(max(1, ceil(0.7 * fastest * self.dt)), _SUBSTEPS)


def open_loop(tables: Array) -> Drive:
    """Inputs of plans (B, N, nu), whatever the machine does."""
    u = torch.as_tensor(tables)
    return lambda k, measured: u[:, k]


def as_run(states: Array, inputs: Array, dt: float) -> Run:
    """An experiment as a run: the last input is held."""
    u = np.concatenate((inputs, inputs[-1:]))
    return Run("experiment", dt * np.arange(len(u), dtype=np.float64), states, u)


_ROUNDS = 12
_STARTS = 8  # first values that the fit of a member is tried from
_BETTER = 0.02  # nats by which another optimum is one
_SURE_OF_HELD = 1e-3  # of its typical size
DEEPER = 16.0  # times that widths may be narrower than the least that a search looks for in the runs
_RATIO = 3.0  # from one width to the next
_WORST = 4.0  # nats: widths that explain the runs worse by more are left out
_KNOWN = 0.25  # standard error over width below which it is known
_HELD = 0.05  # of a width, while the other parameters are fitted
_BRANCH_ROUNDS = 6
_STABLE = 0.9  # delay over step: Runge and Kutta's rule follows the poles of the approximation, 2.45 / delay
_FOLLOWED = 0.7  # width over what a friction changes of a speed in a step: narrower ones turn round within it


@dataclass(frozen=True)
class Branch:
    """A member near one width."""

    theta: Array  # parameters (k,)
    known: Array  # information about them there, that without data included (k, k)
    nats: float  # log-likelihood of the runs [nats]


@dataclass(frozen=True)
class LogOfRuns:
    """The runs there are."""

    runs: tuple[Run, ...]
    clock: float  # physical seconds per logged second
    run_in: bool  # whether any member remembers, so that the first rows of all only bring up memory

    @property
    def logged_dt(self) -> float:
        """Step on the clock of the log [s]."""
        return self.runs[0].dt

    @property
    def dt(self) -> float:
        """Step in physical seconds [s]."""
        return self.runs[0].dt * self.clock


@dataclass(frozen=True)
class Member:
    """Physics that may be true."""

    system: System  # physics with the fitted values
    theta: Array  # fitted parameters (k,)
    information: Array  # of the runs about them (k, k)
    nats: float  # log-likelihood of the runs [nats]
    posteriors: Posteriors  # by the likelihood of further runs
    noise: ModelNoise  # noise of largest likelihood
    log: LogOfRuns
    branches: tuple[Branch, ...]
    """The member at the widths that the runs leave open, the likeliest first; itself where they leave none."""

    @property
    def vector(self) -> ParameterVector:
        """Its parameters, within the bounds that hold for experiments."""
        return self.posteriors.vector

    @property
    def known(self) -> Array:
        """Information about the parameters with what is known of them without data (k, k)."""
        return self.information + prior_information(self.vector)

    @property
    def covariance(self) -> Array:
        """Of the fitted parameters (k, k)."""
        return np.asarray(np.linalg.inv(self.known), dtype=np.float64)

    def draws(self, count: int, rng: np.random.Generator) -> Array:
        """Parameters as the runs leave them open (count, k), the fitted ones first.

        What is no less than nothing stays within a factor of three of a branch.
        """
        v = self.vector
        weights = np.cumsum(np.exp([b.nats - self.nats for b in self.branches]))
        out = [self.theta]
        # every width has its share of the draws, whatever their number
        shares = (np.arange(count - 1) + rng.uniform(size=count - 1)) / max(count - 1, 1)
        for share in rng.permutation(shares):
            branch = self.branches[int(np.searchsorted(weights, share * weights[-1]))]
            out.append(self._drawn(branch, rng))
        return np.stack([v.inside(row) for row in out])

    def _drawn(self, branch: Branch, rng: np.random.Generator) -> Array:
        """Parameters (k,) near a branch."""
        v, theta, covariance = self.vector, branch.theta, np.linalg.inv(branch.known)
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(values.clip(0.0))
        out = theta + root @ np.clip(rng.standard_normal(len(v)), -2.0, 2.0)
        error = np.sqrt(np.diag(covariance))
        positive = (v.low >= 0) & (theta > error)
        if len(self.branches) > 1:
            positive[width_columns(v)] = True
        # what may be nothing, as far as the runs show, may also be more: draws beyond the bound are turned back
        low = np.where(np.isfinite(v.low), v.low, 0.0)
        out = np.where((v.low >= 0) & ~positive, low + np.abs(out - low), out)
        return np.where(positive, np.clip(out, theta / 3.0, 3.0 * theta), out)


def members_of(
    declared: System,
    runs: Sequence[Run],
    question: Question,
    values: Mapping[str, Any],
    *,
    clock: float,
    noise: ModelNoise | None = None,
) -> list[Member]:
    """The members of a question, fitted to the runs there are, with first `values` of effects.

    `noise` is that of them all; None: that of the likeliest. A ConfigError names an effect that the system cannot have,
    or a member that cannot be fitted to the runs.
    """
    named = [_physics_with(declared, effects, values) for effects in question.members]
    search = Search(declared, runs, clock, Options(), channels=True)
    fits: list[Regression] = []
    for system, name in zip(named, question.names, strict=True):
        first = fits[0] if fits else None
        known = declared if first is None else first.vector.system
        own = [n for n in system.effect_names if n not in known.effect_names]
        fits.append(_nearest(search, system, first, name, own))
    systems = [fitted_system(fit) for fit in fits]
    log = LogOfRuns(tuple(runs), clock, any(s.nz > s.nx for s in systems))
    noise = noise or _noise(systems, log)
    return [_member(fit, log, noise) for fit in fits]


def _physics_with(declared: System, effects: Sequence[str], values: Mapping[str, Any]) -> System:
    """Declared physics with effects, at values where there are any."""
    out = declared
    for name in effects:
        key = declared.effect_key(name)
        if key in out.effect_names:
            continue
        out = out.with_effects(out.make_effect(key, values.get(name, values.get(key, {}))))
    return out


def _with_starts(search: Search, system: System, effects: Sequence[str]) -> list[System]:
    """A system with the effects named at each of the first values that their fits are started from."""
    scales = data_sizes(system, search.steps)
    out = [system]
    for name in effects:
        begun = starts(system.without_effects(name), name, scales, [])
        out = [
            base.without_effects(name).with_effects(base.make_effect(name, start))
            for base, start in product(out, begun or [{}])
        ]
    step = max(1, -(-len(out) // _STARTS))
    return out[::step]


def _nearest(
    search: Search, system: System, like: Regression | None, name: str, own: Sequence[str]
) -> Regression:
    """The best fit of a system from several first values of some effects.

    Of a parameter that every input has one of, one alone is tried too, as a diagnosis does: all of them together and a
    gain may be one number, which no data show and which bounds keep from where the others want it.
    """
    best: Regression | None = None
    why = ""
    for begun in [system, *_with_starts(search, system, own)]:
        vector = ParameterVector(begun)
        each = [alone(name, [vector.labels[j] for j in vector.of(name)]) for name in own]
        for held in dict.fromkeys([(), *(tuple(chain(*some)) for some in product(*each))]):
            try:
                fit = _fit(search, begun, like, held)
            except (NsdeError, np.linalg.LinAlgError) as error:
                why = str(error)
                continue
            if best is None or _score(fit) > _score(best) + _BETTER:
                best = fit
    if best is None:
        raise ConfigError(f"{name} cannot be fitted to the runs: {why}")
    return best


def _fit(search: Search, system: System, like: Regression | None, held: Sequence[str]) -> Regression:
    """A fit with parameters held at nothing."""
    system = system.with_effects()
    vector = ParameterVector(system)
    vector.write(system, np.where(np.isin(vector.labels, held), 0.0, vector.start))
    out = search.regression(system, search.quick(system) if like is None else like, held=held)
    out.run(search.budgets.iterations)
    return out


def _score(fit: Regression) -> float:
    """Log-likelihood of residuals of steps, less one for each parameter that was free (Akaike)."""
    laws = sum(law.likelihood(fit.white.shape[1]) for law in fit.noises)
    return float(laws - 0.5 * np.square(fit.white).sum() + fit.held.sum())


def _noise(systems: Sequence[System], log: LogOfRuns) -> ModelNoise:
    """Noise of the likeliest of several systems: levels beside a worse one would take for noise what it lacks."""
    of = LogLikelihood(systems[0], log.runs, log.clock, run_in=log.run_in, states=True)
    best = maximised(of, nuisances=False)[1]
    for system in systems[1:]:
        best = max(best, maximised(of.of(system), best, nuisances=False)[1], key=lambda f: f.at.total)
    return ModelNoise(best.of.space, best.levels)


def _member(fit: Regression, log: LogOfRuns, noise: ModelNoise) -> Member:
    system, dt = fitted_system(fit), fit.physics.steps.dt
    own = Posteriors(system, noise.levels, clock=log.clock, disturbances=noise.space.disturbances)
    prior = prior_information(own.vector)
    given = prior + np.diag(fit.held / np.square(_SURE_OF_HELD * fit.vector.scale))
    own.vector.low = _lower_bounds(fit.vector, fit.theta, dt=dt, fine_dt=Rollouts(system, dt=dt).fine_dt)
    own.vector.high = fit.vector.high
    begun = [fit.theta, np.where(fit.held, fit.theta, fit.vector.start)]
    tried = [LogWithPrior(log.runs, fit.theta, given)] * len(begun)
    found = max(own.modes(tried, starts=begun, rounds=_ROUNDS, run_in=log.run_in), key=lambda f: f.nats)
    each = _branches(own, log, Branch(found.theta, found.information, found.nats), given)
    theta = each[0].theta
    own.vector.write(system, theta)
    return Member(system, theta, each[0].known - prior, each[0].nats, own, noise, log, each)


def prior_information(vector: ParameterVector) -> Array:
    """What is known of every parameter without data (k, k): it is of the size that such a parameter has, within ten."""
    return np.diag(1.0 / np.square(10.0 * vector.scale))


def width_columns(vector: ParameterVector) -> list[int]:
    """Numbers of the parameters that are widths of dry friction."""
    dry = {str(e.name): e.relative for e in vector.system.effects if isinstance(e, Law) and e.dry}
    return [i for i, k in enumerate(vector.labels) if own_name(k) in dry.get(k.partition(".")[0], {})]


def _lower_bounds(fit: ParameterVector, theta: Array, *, dt: float, fine_dt: float) -> Array:
    """Lower bounds (k,) of a filter: widths below what the search looked for, and delays that its steps follow.

    `dt` is the step of the log, `fine_dt` that of the filter's integration [s].
    """
    sizes = {str(e.name): e.amplitudes for e in fit.system.effects if isinstance(e, Law)}
    low = fit.low.copy()
    for i in width_columns(fit):
        if fit.raised[i]:
            effect = fit.labels[i].partition(".")[0]
            dry = [j for j in fit.of(effect) if own_name(fit.labels[j]) in sizes[effect]]
            least = _FOLLOWED * dt * float(np.max(theta[dry], initial=0.0))
            low[i] = min(low[i], max(low[i] / DEEPER, least))
    late = {str(e.name): e.relative for e in fit.system.effects if isinstance(e, Effect) and e.n_memory}
    for i, label in enumerate(fit.labels):
        if late.get(label.partition(".")[0], {}).get(own_name(label)) == "step":
            low[i] = max(low[i], _STABLE * fine_dt)
    return low


def _branches(own: Posteriors, log: LogOfRuns, best: Branch, prior: Array) -> tuple[Branch, ...]:
    """A member at the widths that its runs leave open, the likeliest first; `prior` is known without data (k, k)."""
    v, theta = own.vector, best.theta
    error = np.sqrt(np.diag(np.linalg.inv(best.known)))
    columns = [i for i in width_columns(v) if error[i] > _KNOWN * theta[i]]
    if not columns:
        return (best,)
    factors = [_RATIO**p for p in (-3, -2, -1, 1)]
    rows = np.tile(theta, (len(factors), 1))
    rows[:, columns] *= np.array(factors)[:, None]
    rows = np.unique(np.stack([v.inside(row) for row in rows]), axis=0)
    rows = rows[np.abs(np.log(rows[:, columns] / theta[columns])).max(1) > 0.5 * np.log(_RATIO)]

    def about(row: Array, share: float) -> Array:
        """Information (k, k) that holds widths to a share of their values in a row (k,)."""
        out = np.zeros(len(theta))
        out[columns] = 1.0 / np.square(share * row[columns])
        return np.diag(out)

    problems = [LogWithPrior(log.runs, row, prior + about(row, _HELD)) for row in rows]
    out = [best]
    for row, fit in zip(rows, own.modes(problems, rounds=_BRANCH_ROUNDS, run_in=log.run_in), strict=True):
        freed = about(row, 1.0) - about(row, _HELD)
        out.append(Branch(fit.theta, fit.information + freed, fit.nats))
    top = max(b.nats for b in out)
    return tuple(sorted((b for b in out if b.nats > top - _WORST), key=lambda b: -b.nats))
