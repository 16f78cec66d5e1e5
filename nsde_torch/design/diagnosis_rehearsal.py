"""A diagnosis rehearsed: the machine that was found is simulated, and its logs are diagnosed as the measured ones were.

It shows of these very data whether what was found would be found again, how far values scatter and whether their
intervals hold them; and, of the declared physics alone, whether anything is named of nothing. It shows nothing of a law
that neither holds. Inputs are those of the log, or keep the machine near it by feedback, optimal for small deviations,

    u_k = u_k(log) + K_k (x_k(log) - x_k(measured)),      K by Riccati's recursion backwards along the path

with deviations of states and of inputs weighed by how much they vary in the log (linear quadratic regulation: Anderson
and Moore, Optimal Control, 1990, chapter 2), where a machine does not stay by itself.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.data.raw import RawRun
from nsde_torch.design.members import Drive, ModelNoise, Rollouts, open_loop
from nsde_torch.diagnosis.candidates import effect_of, values_of
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.result import Content, Diagnosis
from nsde_torch.effects.law import AND
from nsde_torch.errors import ConfigError, NsdeError
from nsde_torch.inference.estimate import LogLikelihood, filtered_at
from nsde_torch.inference.maximum import likeliest
from nsde_torch.progress import Say, reported
from nsde_torch.recording import assemble
from nsde_torch.systems import System

_LEAST = 1e-6  # spread of a column that does not vary


def following(
    system: System, states: Sequence[Array], inputs: Sequence[Array], *, dt: float, copies: int
) -> Drive:
    """Inputs that follow recorded stretches, between the smallest and largest that were logged.

    States (n, nx) and inputs (n, nu and what is logged beside) are of each stretch, which `copies` machines follow.
    """
    system, every, nu = copy.deepcopy(system).double(), np.concatenate(inputs), system.nu
    x_scale = np.concatenate(states).std(0).clip(_LEAST)
    u_scale = every[:, :nu].std(0).clip(_LEAST)
    gains = [
        _gains(system, x, u, np.diag(x_scale**-2), np.diag(u_scale**-2), dt)
        for x, u in zip(states, inputs, strict=True)
    ]
    low, high = (torch.from_numpy(end) for end in (every.min(0), every.max(0)))
    x, u = (torch.from_numpy(_stacked(parts, copies)) for parts in (states, inputs))
    gain = torch.from_numpy(_stacked([k.reshape(len(k), -1) for k in gains], copies))

    def drive(k: int, measured: Tensor) -> Tensor:
        away = (x[:, k] - measured)[:, :, None]
        change = (gain[:, k].view(-1, nu, x.shape[2]) @ away)[:, :, 0]
        whole = torch.cat((u[:, k, :nu] + change, u[:, k, nu:]), 1)
        return torch.minimum(torch.maximum(whole, low), high)

    return drive


def _gains(system: System, x: Array, u: Array, q: Array, r: Array, dt: float) -> Array:
    """Gains of each row (n, nu, nx)."""
    nx, nu = system.nx, system.nu

    def step(now: Tensor, push: Tensor) -> Tensor:
        z = system.augment(now[None], push[None])
        middle = z + 0.5 * dt * system.drift(0.0, z, push[None])
        return now + dt * system.drift(0.0, middle, push[None])[0, :nx]

    slopes = torch.func.vmap(torch.func.jacfwd(step, (0, 1)))
    a, b = (part.detach().numpy() for part in slopes(torch.tensor(x), torch.tensor(u)))
    b, out, p = b[:, :, :nu], np.zeros((len(x), nu, nx)), q
    for k in range(len(x) - 1, -1, -1):
        pb = p @ b[k]
        out[k] = np.linalg.solve(r + b[k].T @ pb, pb.T @ a[k])
        p = q + a[k].T @ p @ (a[k] - b[k] @ out[k])
        p = 0.5 * (p + p.T)
    return out


def _stacked(parts: Sequence[Array], copies: int) -> Array:
    """Stretches side by side, the last row of shorter ones again, each so many times (B, N, columns)."""
    rows = max(len(p) for p in parts)
    whole = [np.concatenate((p, np.repeat(p[-1:], rows - len(p), 0))) for p in parts]
    return np.repeat(np.stack(whole), copies, 0)


_BEYOND = 2.0  # ranges of the log beyond which a simulated machine has left it
_NEAR = 1e-9


@dataclass(frozen=True)
class Rehearsal:
    """A diagnosis that was made again of simulated logs."""

    truth: dict[str, float]  # parameters that were simulated, those with an interval: `effect.name` -> value
    names: tuple[str, ...]  # effects that were simulated
    followed: bool  # whether inputs followed the log (feedback); else they were replayed
    again: tuple[Content, ...]  # `diagnosis.json` of each log of the machine that was found
    nothing: Content | None
    """The same of a log of the declared physics alone; None where that is what `again` is, or cannot be made."""
    left_out: tuple[str, ...] = ()  # what was found and is not simulated, in words
    why_not: str = ""  # why nothing was simulated; empty where it was

    def content(self) -> dict[str, Any]:
        """The key `rehearsal` of `diagnosis.json`."""
        # of the declared physics alone; None where that was not simulated
        alone = [self.nothing] if self.nothing is not None else [] if self.names else self.again
        return {
            "why_not": self.why_not or None,
            "logs": len(self.again),
            "inputs": "follow the log" if self.followed else "as logged",
            "left_out": list(self.left_out),
            "effects": {name: self._effect(name) for name in self.names},
            "others": sorted(_sure(*self.again) - set(self.names)) if self.names else [],
            "parameters": {label: self._parameter(label, value) for label, value in self.truth.items()},
            "of_nothing": sorted(_sure(*alone)) if alone else None,
            "unexplained": sum(c["verdict"] == "unexplained" for c in self.again),
            "not_shown": (self.nothing or self.again[0])["not_shown"] if self.again else [],
        }

    def _effect(self, name: str) -> dict[str, int]:
        """In how many logs an effect is named, surely or as a lead, and in how many something tied with it is."""
        sure = sum(name in _sure(c) for c in self.again)
        named = sum(name in c["added"] for c in self.again)
        without = [c for c in self.again if name not in c["added"]]
        others = [[o for tie in c["ties"] for o in tie["effects"]] for c in without]
        tied = sum(any(name in one.split(AND) for one in some) for some in others)
        return {"sure": sure, "lead": named - sure, "tied": tied}

    def _parameter(self, label: str, value: float) -> dict[str, Any]:
        """A parameter's estimates and how many of their intervals hold it."""
        found = [c["parameters"][label] for c in self.again if label in c["parameters"]]
        intervals = [p["interval_90"] for p in found if p["interval_90"] is not None]
        return {
            "value": value,
            "again": [p["value"] for p in found],
            "intervals": len(intervals),
            "hold": sum(low <= value <= high for low, high in intervals),
            "unit": found[0]["unit"] if found else None,
        }


def rehearse(
    found: Diagnosis, *, logs: int = 3, seed: int = 0, say: Say | Literal[False] | None = None
) -> Rehearsal:
    """Rehearse a diagnosis, which takes as long as `logs` + 1 diagnoses.

    Args:
        logs: Logs of the machine that was found.
        seed: Seed of their noise.
        say: None: progress is printed on standard error; False: nothing is printed; or a function that takes stage,
            number done and number in all.

    Raises:
        ConfigError: less than one log.
    """
    if logs < 1:
        raise ConfigError(f"`logs` must be at least 1; got {logs}.")
    with reported(say) as report:
        return _rehearsed(found, logs, seed, report)


def _rehearsed(found: Diagnosis, logs: int, seed: int, say: Say) -> Rehearsal:
    outcome, rng = found.outcome, np.random.default_rng([seed, 2026])
    names = tuple(f.name for f in outcome.found)
    left_out = tuple(f"{f.name} of the recording" for f in found.faults)
    smoothed = sorted({name for run in found.recorded.runs for name in run.band})
    if smoothed:
        left_out += (f"the smoother of {', '.join(smoothed)}: simulated states are raw",)
    say("simulating what was found", 0, 1)
    try:
        made, followed = _simulated(found, outcome.system, logs, rng)
    except NsdeError as error:
        return Rehearsal({}, names, False, (), None, left_out, str(error))
    alone: list[list[RawRun]] = []
    if names:
        try:
            alone = _simulated(found, outcome.declared_system, 1, rng)[0]
        except NsdeError:  # without a damping a machine may go anywhere
            left_out = (*left_out, "the declared physics alone, which leaves the range of the log")
    again: list[Content] = []
    options = replace(found.options, max_minutes=None)
    for log in [*made, *alone]:
        say("diagnosing a simulated log", len(again), logs + len(alone))
        try:
            data = assemble(log, found.system, kind="rehearsed", clock="trust")
            again.append(diagnose(found.system, found.spec, data, data.runs, options).content())
        except NsdeError as error:
            return Rehearsal({}, names, followed, (), None, left_out, f"a simulated log is refused: {error}")
    values = {
        f"{name}.{key}" if isinstance(value, float) else f"{name}.{key}[{i}]": one
        for name in names
        for key, value in values_of(effect_of(outcome.system, name)).items()
        for i, one in enumerate([value] if isinstance(value, float) else value)
    }
    shown = {label for label, p in found.parameters.items() if p["interval_90"] and p["bound"] is None}
    values = {label: value for label, value in values.items() if label in shown}
    nothing = again[-1] if alone else None
    return Rehearsal(values, names, followed, tuple(again[:logs]), nothing, left_out)


def _simulated(
    found: Diagnosis, system: System, logs: int, rng: np.random.Generator
) -> tuple[list[list[RawRun]], bool]:
    """Logs of a machine in the place of the measured one, and whether inputs followed the log.

    They follow where the data were recorded in a loop, or where the machine leaves the range of the log else.
    """
    runs, steps = found.recorded.runs, found.outcome.final.physics.steps
    places = [(n, a, b) for n, run in enumerate(runs) for a, b in run.segments]
    states, inputs = ([getattr(runs[n], key)[a:b] for n, a, b in places] for key in ("x", "u"))
    times = np.repeat([steps.dt / steps.logged_dt * runs[n].t[a] for n, a, _ in places], logs)
    rollouts, most = Rollouts(system, dt=steps.dt), max(b - a for _, a, b in places)
    count = logs * len(places)
    theta = np.tile(rollouts.vector.start, (count, 1))
    start = np.repeat(np.stack([x[0] for x in states]), logs, 0)
    of = LogLikelihood(found.outcome.system, found.recorded.runs, found.recorded.clock, states=True)
    at, space = filtered_at(of), of.space
    levels, _, _ = likeliest(space, at.levels, at.levels, at.about)
    noise = ModelNoise(space, levels).drawn(count, most - 1, rng)
    drive = open_loop(_stacked(inputs, logs))
    for way in (found.feedback.closed, True):
        if way:
            drive = following(system, states, inputs, dt=steps.dt, copies=logs)
        _, seen, pushed = rollouts.run(theta, start, drive, most - 1, noise, times)
        if _stays(seen, states, logs):
            break
    else:
        raise NsdeError("the simulated machine leaves the range of the log, also with inputs that follow it")
    made: list[list[RawRun]] = []
    for k in range(logs):
        parts = [(seen[i * logs + k], pushed[i * logs + k]) for i in range(len(places))]
        made.append([_raw(system, run, n, places, parts) for n, run in enumerate(runs)])
    return made, way


def _stays(seen: Array, states: Sequence[Array], logs: int) -> bool:
    """Whether simulated machines stay near the range of the log."""
    every = np.concatenate(list(states))
    low, high = every.min(0), every.max(0)
    room = _BEYOND * (high - low) + _NEAR
    for i, x in enumerate(states):
        own = seen[i * logs : (i + 1) * logs, : len(x)]
        if not np.isfinite(own).all() or (own < low - room).any() or (own > high + room).any():
            return False
    return True


def _raw(
    system: System,
    run: Run,
    number: int,
    places: Sequence[tuple[int, int, int]],
    parts: Sequence[tuple[Array, Array]],
) -> RawRun:
    """A run with simulated states and inputs in the rows of its segments, without what no sensor measured."""
    at, x, u = [], [], []
    for (n, a, b), (states, inputs) in zip(places, parts, strict=True):
        if n == number:
            at.append(np.arange(a, b))
            x.append(states[: b - a])
            u.append(np.concatenate((inputs, inputs[-1:]))[: b - a])
    rows, states, inputs = np.concatenate(at), np.concatenate(x), np.concatenate(u)
    states[:, [system.state_names.index(name) for name in run.inferred]] = np.nan
    extra = {name: column[rows] for name, column in run.extra.items()}
    extra |= {name: inputs[:, system.nu + k] for k, name in enumerate(system.exogenous)}
    return RawRun(run.name, run.t[rows], states, inputs[:, : system.nu], extra)


def _sure(*contents: Content) -> set[str]:
    """Effects that any of some diagnoses names without a doubt."""
    return {f["name"] for c in contents for f in c["findings"] if f["kind"] == "effect" and not f["lead"]}
