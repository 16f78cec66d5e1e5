"""Residuals of single steps of runs that a model has not seen: figures that feedback does not bias.

    residual    root mean square of the residual rate, in means over a quarter of a second, beside the measured rate
    nats        Whittle log likelihood of the residuals under the model's own diffusion, disturbances and sensors, per
                second of data and channel: what a stationary filter of the model would score (see
                `evaluation.spectra`); only the difference of two models on the same runs means something

Errors of predictions over many steps under the log's own inputs reward a model for knowing the pilot; these do not: a
step's input and state come before what is new in it.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.evaluation.report import number, table
from nsde_torch.inference.steps import steps_of
from nsde_torch.models.model import Model, is_equation
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.recording.smoothing import as_applied
from nsde_torch.sysid.noise import Series
from nsde_torch.sysid.physics import Physics, bump, explained
from nsde_torch.systems.parameters import ParameterVector

# What declared physics leaves of every step of the log, and how a force on a port would move it.
#
#     r_k = (x_{k+1} - x_k) - int f(x(t), u_k; theta) dt,        r_k = h B_k g(y_k) + noise_k
#
# B_k is the slope of the rates in the forces of the ports, g what a network says of features y_k. Both are
# taken at the state that the model foresees from some steps earlier (`identify.physics`), so that neither
# sensor noise of the step nor a gust inside it is in them.

_MOVES = 1e-6  # of the largest slope: below that a port does not move a channel


@dataclass(frozen=True)
class Residuals:
    """Residuals of the steps of some runs."""

    states: Tensor  # foreseen states in the middle of each step (N, nx)
    # what physics leaves of the change over each step (N, nx); velocities of a machine with an attitude in body
    # axes
    change: Array
    response: Tensor
    """Change over a step by a unit of each force (N, channels, width), on the channels `rows`."""
    ports: tuple[tuple[Port, int], ...]  # ports in the order of the columns of `response`, with their widths
    rows: NDArray[np.int64]  # numbers of the channels that a force moves
    series: Series  # stretches of the steps
    dt: float  # length of a step [s], physical


def residuals(physics: Physics, theta: Array, ports: Sequence[Port]) -> Residuals:
    """Residuals of physics at theta, and the slopes in the forces on some ports."""
    middle, change = physics.middle(theta), physics.residual(theta)
    system, s = physics.vector.system, physics.steps
    nx = system.nx
    columns = []
    with torch.no_grad():
        rate = system.drift(s.t, middle, s.u)[:, :nx]
        for port in ports:
            for j in range(system.ports[port]):
                push = torch.zeros(len(s), system.ports[port], dtype=middle.dtype)
                push[:, j] = 1.0
                moved = system.drift(s.t, middle, s.u, {port: push})[:, :nx]
                columns.append(physics.in_channels(s.dt * (moved - rate), middle))
    response = torch.stack(columns, 2) if columns else torch.zeros(len(s), nx, 0, dtype=middle.dtype)
    largest = response.abs().amax((0, 2)).numpy() if columns else np.zeros(nx)
    rows = np.flatnonzero(largest > _MOVES * max(float(largest.max()), 1e-300))
    widths = tuple((port, system.ports[port]) for port in ports)
    return Residuals(middle[:, :nx], change, response[:, rows], widths, rows, Series(s.segments), s.dt)


def with_networks(physics: Physics, model: NeuralSDE) -> Physics:
    """Physics with the residual networks of a model beside it.

    What physics alone foresees is off where networks do much: of a cart with a quadratic damping of 4.5 m/s2 that they
    had learned to 0.01, 0.15 m/s2 seemed to be left.
    """
    return physics.beside(lambda x: {port: f.double() for port, f in model.residual(x.float()).items()})


def disturbed_channels(model: NeuralSDE, found: Residuals) -> list[int]:
    """Column of `Residuals.rows` that each disturbance of a model moves most."""
    out, at = [], 0
    size = found.response.abs().mean(0)  # (channels, width)
    for port, width in found.ports:
        if port in model.disturbed_ports:
            out += [int(size[:, at + j].argmax()) for j in range(width)]
        at += width
    return out


# What disturbs a machine, from the spectrum of the residuals of every step.
#
#     r_k = int d dt + sigma w_k + s (e_{k+1} - e_k),        d: Ornstein-Uhlenbeck, standard deviation std, time tau
#
#     S(f) = h^2 std^2 (1 - a^2) / |1 - a exp(-i f)|^2 + sigma^2 h + s^2 |1 - exp(-i f)|^2,     a = exp(-h / tau)
#
# sigma is a diffusion (per root second), s the white noise of the sensor. The law of r does not depend on how
# inputs were made: what a controller answers is in the inputs, and physics has taken their effect out. The
# parameters have the largest Whittle likelihood, sum_f log S + I / S over the periodogram I (Whittle, Arkiv
# foer Matematik 2 (1953)), which is tapered by a sine: cut off sharply, the differences of a sensor's errors
# leak a floor that looks like a diffusion. What physics lacks of slow forces is part of d: predictions err by
# it as by a gust.

_BINS = 240
_LEAST = 1e-5  # of the residual's standard deviation: what is smaller is nothing
_LONGEST_S = 10.0
_FEWEST = 16  # rows of a stretch whose periodogram counts


@dataclass(frozen=True)
class Disturbance:
    """Law of the residual of one channel."""

    diffusion: float  # sigma [unit of the state per root second]
    std: float
    """Standard deviation of the lasting force [unit of the state per second]; 0 where there is none."""
    tau: float  # its correlation time [s]
    sensor: float  # standard deviation of the sensor [unit of the state]

    def without_memory(self, seconds: float) -> "Disturbance":
        """The law whose diffusion moves the state as far over some seconds as diffusion and force do here."""
        if not self.std > 0:
            return self
        share = self.tau / seconds
        force = 2.0 * self.std**2 * self.tau * (1.0 + share * np.expm1(-1.0 / share))
        return Disturbance(float(np.sqrt(self.diffusion**2 + force)), 0.0, self.tau, self.sensor)


@dataclass(frozen=True)
class Spectrum:
    """Periodogram in bins of about equal width in log frequency."""

    power: Array  # mean periodogram of each bin (bins,) [unit of the residual squared]
    angle: Array  # its frequency [rad a step]
    count: Array  # number of frequencies in it
    dt: float  # step [s]


def spectrum(columns: Array, series: Series, dt: float) -> Spectrum:
    """Spectrum of residuals (N, n), the mean of their columns."""
    angles, powers = [], []
    for a, b in series.edges:
        if b - a < _FEWEST:
            continue
        n = b - a
        taper = np.sqrt(2.0 / (n + 1)) * np.sin(np.pi * np.arange(1, n + 1) / (n + 1))
        wave = np.fft.rfft(columns[a:b] * taper[:, None], axis=0)[1:]
        powers.append(np.square(np.abs(wave)).mean(1))
        angles.append(2.0 * np.pi * np.arange(1, len(wave) + 1) / n)
    if not angles:
        variance = np.array([np.square(columns).mean()])
        return Spectrum(variance, np.array([0.5 * np.pi]), np.ones(1), dt)
    angle, power = np.concatenate(angles), np.concatenate(powers)
    edges = np.geomspace(angle.min(), np.pi, _BINS + 1)
    label = np.clip(np.searchsorted(edges, angle, side="right") - 1, 0, _BINS - 1)
    count = np.bincount(label, minlength=_BINS).astype(np.float64)
    live = count > 0
    total, place = (np.bincount(label, weights=v, minlength=_BINS)[live] for v in (power, angle))
    return Spectrum(total / count[live], place / count[live], count[live], dt)


def density(law: Disturbance, angle: Array, dt: float) -> Array:
    """Spectral density of the residuals of a law at some frequencies [rad a step]."""
    s = law.diffusion**2 * dt + law.sensor**2 * (2.0 - 2.0 * np.cos(angle))
    if law.std > 0:
        keep = np.exp(-dt / law.tau)
        s = s + (dt * law.std) ** 2 * (1.0 - keep**2) / (1.0 + keep**2 - 2.0 * keep * np.cos(angle))
    return np.asarray(s)


def fit(seen: Spectrum, *, lasting: bool, shortest: float) -> Disturbance:
    """Law of largest Whittle likelihood, with or without a lasting force of at least the `shortest` time [s]."""
    power, angle, count, h = seen.power, seen.angle, seen.count, seen.dt
    size = float(np.sqrt((power * count).sum() / count.sum()))
    if not size > 0:
        return Disturbance(0.0, 0.0, shortest, 0.0)
    low, high = np.log(_LEAST * size), np.log(30.0 * size)
    root = np.sqrt(h)

    def law(p: Array) -> Disturbance:
        std, tau = (np.exp(p[2]) / h, np.exp(p[3])) if lasting else (0.0, shortest)
        return Disturbance(float(np.exp(p[0]) / root), float(std), float(tau), float(np.exp(p[1])))

    def cost(p: Array) -> float:
        s = density(law(p), angle, h)
        return float((count * (np.log(s) + power / s)).sum() / count.sum())

    bounds = [(low, high), (low, high)]
    middle = np.log(size)
    starts = [[middle, middle - 1.0], [middle - 2.0, middle], [middle - 4.0, middle]]
    if lasting:
        bounds += [(low, high), (np.log(shortest), np.log(_LONGEST_S))]
        starts = [
            [*start, lasts, time]
            for start in starts
            for lasts in (middle - 1.0, middle - 3.0)
            for time in (np.log(1.5 * shortest), np.log(1.0))
        ]
    best = min(
        (minimize(cost, np.array(s), method="L-BFGS-B", bounds=bounds) for s in starts),
        key=lambda r: float(r.fun),
    )
    return law(best.x)


@torch.no_grad()
def one_step(model: Model, runs: Sequence[Run]) -> dict[str, dict[str, Any]] | None:
    """Residuals of a model's steps; None for a model without physics, or runs that are too short.

    channel -> `unit` (of its rate), `measured`, `residual` (root mean squares), `explained` (share of the variance) and
    `nats_per_s` (None without a diffusion).
    """
    if not model.capabilities.has_physics:
        return None
    system = copy.deepcopy(model.system).cpu()
    applied = list(runs) if model.filter is None else as_applied(runs, system.nu)
    clock = float(model.clock_scale)
    try:
        vector = ParameterVector(system)
        steps = steps_of(vector.system, applied, clock=clock, smooth=False)
    except (ConfigError, DataError):
        return None
    physics = Physics(vector, steps)
    # networks are evaluated in single precision, whatever the model is in
    own = copy.deepcopy(model).cpu().float() if is_equation(model) else None
    if own is not None and own.residual_ports:
        physics = with_networks(physics, own)
    left = residuals(physics, vector.inside(vector.start), tuple(system.residual_ports))
    change = left.change
    window = bump(steps.dt, steps.pace)
    physics.estimate_sensors(change)
    laws = _laws(own, left) if own is not None and own.capabilities.is_stochastic else {}
    out = {}
    for channel in explained(physics, change[:, left.rows], left.rows, window):
        row, nats = physics.names.index(channel.name), None
        if row in laws:  # Whittle's log likelihood
            seen = spectrum(change[:, [row]], left.series, left.dt)
            s = np.maximum(density(laws[row], seen.angle, left.dt), 1e-300)
            nats = float(-(seen.count * (np.log(s) + seen.power / s)).sum() / (len(left.series) * left.dt))
        out[channel.name] = {
            **{"unit": channel.unit, "measured": channel.measured, "residual": channel.residual},
            **{"explained": channel.r2, "nats_per_s": nats},
        }
    return out


def _laws(model: NeuralSDE, left: Residuals) -> dict[int, Disturbance]:
    """Laws of the channels that forces move, as a model has them on these data."""
    clock, system = float(model.clock_scale), model.system
    sigma = model.h(model.eta(system.features(left.states.float()))).square().mean(0).sqrt()
    sensor = model.measurement_std
    forces = {}
    for k, column in enumerate(disturbed_channels(model, left)):
        tau = float(model.tau[k])
        std = float(sigma[system.nx + k]) * math.sqrt(0.5 * tau / clock)
        forces[int(left.rows[column])] = (std, tau)
    out = {}
    for row in map(int, left.rows):
        force = forces.get(row, (0.0, 1.0))
        out[row] = Disturbance(float(sigma[row]) / math.sqrt(clock), *force, float(sensor[row]))
    return out


def one_step_table(steps: Mapping[str, Mapping[str, Any]]) -> str:
    """What a person reads of it."""
    rows = []
    for name, c in steps.items():
        nats = "-" if c["nats_per_s"] is None else f"{c['nats_per_s']:.2f}"
        sizes = (number(c["measured"]), number(c["residual"]), f"{c['explained']:.1%}")
        rows.append([f"{name} [{c['unit']}]", *sizes, nats])
    head = ["held-out rate of, means over 0.25 s", "measured", "left", "explained", "one-step nat/s"]
    return table(head, rows)
