"""Is an exported controller the one that it was made of, does it stand whatever it is given, and how fast is it?

Parity: both are given the same states, references and plans before, and must answer with the same inputs and status.
Adversarial: numbers that no sensor should send; every answer must be finite and within bounds.
"""

import resource
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.control.autopilots import PredictivePilot
from nsde_torch.control.controller import Controller, Plan
from nsde_torch.control.loop import percentiles
from nsde_torch.control.reference import StateReference, at_rest
from nsde_torch.errors import DataError
from nsde_torch.export.exported import ExportedController
from nsde_torch.export.step import STATUS, first_inputs
from nsde_torch.rotation import turned

TOLERANCE = 1e-4  # largest difference of inputs that is put down to rounding
SINGLE_TOLERANCE = 5e-3
"""The same for a controller in C of single precision, which solves its equations in another order than Python."""
_START = 2.0  # time of the first state along a reference [s]
_OFF = 0.3  # errors of states that are drawn along a reference of a machine that does not fly, in their units
_EVERY = 50
"""Samples between cold starts, and between samples that are in trouble, of the states that both are given."""


@dataclass
class Verification:
    """What was found."""

    states: int = 0  # states that both were given
    worst: float = 0.0  # largest difference of inputs
    differing: list[str] = field(default_factory=list)  # samples whose status differs, with both words
    words: dict[str, int] = field(default_factory=dict)  # status words of the file and how often they came
    cost_ratio: float = 0.0  # largest ratio of the costs of both, minus one, in size
    adversarial: int = 0  # adversarial states
    unsafe: list[str] = field(default_factory=list)  # of their answers, those not finite or not within bounds
    wall_ms: list[float] = field(default_factory=list)  # times of steps over the states, of the clock
    cpu_ms: list[float] = field(default_factory=list)  # the same of the processor for this thread
    memory_mb: tuple[float, float] = (0.0, 0.0)
    """Largest resident size of the process before and after loading the file and stepping."""
    allowed: float = TOLERANCE  # largest difference of inputs that passes
    estimated: int = 0  # states that both were given with their estimators, each with its own plans before
    estimated_worst: float = 0.0  # largest difference of inputs there

    @property
    def passed(self) -> bool:
        """Whether the file may be flown in the place of the controller in Python."""
        worst = max(self.worst, self.estimated_worst)
        return worst <= self.allowed and not self.differing and not self.unsafe

    def as_dict(self) -> dict[str, Any]:
        """Plain containers."""
        return {
            "passed": self.passed,
            "states": self.states,
            "input_difference_max": self.worst,
            "input_difference_allowed": self.allowed,
            "estimator_states": self.estimated,
            "estimator_input_difference_max": self.estimated_worst,
            "status_differs": self.differing,
            "status": self.words,
            "cost_difference_max": self.cost_ratio,
            "adversarial_states": self.adversarial,
            "adversarial_unsafe": self.unsafe,
            "step_ms": percentiles(self.wall_ms),
            "step_cpu_ms": percentiles(self.cpu_ms),
            "memory_mb": {"before": self.memory_mb[0], "after": self.memory_mb[1]},
        }


def histogram(times: Sequence[float]) -> str:
    """Times [ms] in twelve lines of text, in equal ratios."""
    if not times:
        return ""
    low, high = min(times), max(max(times), 1.01 * min(times))
    edges = np.geomspace(low, high, 13)
    counts, _ = np.histogram(np.clip(times, low, high), edges)
    most = max(int(counts.max()), 1)
    rows = zip(edges[:-1], edges[1:], counts, strict=True)
    return "\n".join(f"  {a:8.3f} to {b:8.3f} ms {n:6d} {'#' * round(40 * n / most)}" for a, b, n in rows)


def compare(
    exported: ExportedController,
    controller: Controller,
    samples: Sequence[tuple[Tensor, Tensor]],
    out: Verification,
    *,
    elapsed: float,
) -> None:
    """Give a file and what it was made of the same states (nx,), references (K, nx) and plans before.

    What is found is added to `out`; `elapsed` is the time between samples [s].
    """
    before: Plan | None = None
    for k, (state, reference) in enumerate(samples):
        x, ref = state[None].double(), reference[None].double()
        if k % _EVERY == 0:
            before = None
        if k % _EVERY == _EVERY - 1:  # troubles in turn, each in the middle of a flight
            x, ref = _troubled(k // _EVERY, x, ref, exported)
        exported._jumped, exported._solves = float(controller._jumped[0]), float(controller._solves)
        started, cpu = time.perf_counter(), time.thread_time()
        ours = exported.plan(x, ref, before, elapsed=elapsed)
        out.cpu_ms.append(1e3 * (time.thread_time() - cpu))
        out.wall_ms.append(1e3 * (time.perf_counter() - started))
        theirs = controller.plan(x, ref, before, elapsed=elapsed)
        out.states += 1
        out.worst = max(out.worst, float((ours.u - theirs.u).abs().max()))
        if ours.status != theirs.status:
            out.differing.append(f"sample {k}: {ours.status[0]} in the file, {theirs.status[0]} in Python")
        out.words[ours.status[0]] = out.words.get(ours.status[0], 0) + 1
        if bool(torch.isfinite(theirs.cost)):
            out.cost_ratio = max(out.cost_ratio, abs(float(ours.cost / theirs.cost) - 1.0))
        before = theirs


def compare_estimators(
    exported: ExportedController, pilot: PredictivePilot, states: Sequence[Tensor], out: Verification
) -> None:
    """Give both the same measured states, each with the disturbances that it estimates and with its own plans before.

    The states (nx,) lie along the reference of the pilot, which has the estimator and the latency of the file's record,
    a period apart and from `_START` on.
    """
    inside, o = exported.pilot, exported.options
    assert inside is not None
    pilot.reset(states[0][None])
    inside.reset(states[0])
    ahead = exported.record["estimator"]["latency"]
    for k, state in enumerate(states):
        t = _START + k * pilot.period
        theirs = pilot.command(t, state[None])
        u, *_, status, _ = inside.command(state, pilot.reference.window(t + ahead, dt=o.dt, steps=o.steps))
        out.estimated += 1
        out.estimated_worst = max(out.estimated_worst, float((u[0] - theirs.u[0]).abs().max()))
        word = exported.record["status"][int(status)]
        if word != theirs.status[0]:
            out.differing.append(f"estimator, sample {k}: {word} in the file, {theirs.status[0]} in Python")


def _troubled(kind: int, x: Tensor, ref: Tensor, exported: ExportedController) -> tuple[Tensor, Tensor]:
    x, ref, attitude = x.clone(), ref.clone(), exported.known.quaternion
    if kind % 4 == 1 and attitude is not None:
        x[0, attitude] *= 1.4
    elif kind % 4 == 3 and exported.sizes.flies:
        x[0, :3] += 5.0
    elif kind % 4 == 2:
        ref[0, -1, 0] = torch.inf
    else:
        x[0, kind % x.shape[1]] = torch.nan
    return x, ref


def along(
    exported: ExportedController, reference: StateReference, count: int, *, period: float, seed: int = 0
) -> list[tuple[Tensor, Tensor]]:
    """States (nx,) along a reference, off it by errors that last for a while, and the references (K, nx) ahead of them.

    The errors are those of a flight; of other machines `_OFF` in the units of each state. `period` is the time between
    states [s].
    """
    g, o, system = torch.Generator().manual_seed(seed), exported.options, exported.known
    size = torch.full((len(system.error_names),), _OFF, dtype=torch.float64)
    if exported.sizes.flies:
        size = torch.tensor([*(0.06,) * 3, *(0.15,) * 3, *(0.05,) * 3, *(0.3,) * 3], dtype=torch.float64)
    stay = float(np.exp(-period / 0.3))
    off = torch.randn(len(size), generator=g, dtype=torch.float64)
    out = []
    for k in range(count):
        t = (_START + k * period) % max(reference.duration - o.horizon, period)
        new = torch.randn(len(size), generator=g, dtype=torch.float64)
        off = stay * off + (1.0 - stay**2) ** 0.5 * new
        x, e = reference.at(torch.tensor(t, dtype=torch.float64)), off * size
        if (at := system.quaternion) is None:
            x = x + e
        else:
            a, b = at.start, at.start + 3
            x = torch.cat((x[:a] + e[:a], turned(x[at], e[a:b]), x[at.stop :] + e[b:]))
        out.append((x, reference.window(t, dt=o.dt, steps=o.steps)))
    return out


def logged(
    file: Path, exported: ExportedController, reference: StateReference, count: int, *, period: float
) -> list[tuple[Tensor, Tensor]]:
    """States of a flight that `nsde track` logged, `count` at most, and the references ahead; see `along`.

    The CSV file has the time `t` in the reference, and the states in columns of their names; a DataError where it has
    not, or there is none.
    """
    names, o = exported.record["state_names"], exported.options
    if not file.is_file():
        raise DataError(f"no log {file}; `nsde track` writes log/flight_0.csv into its folder.")
    with file.open(encoding="utf-8") as opened:
        header = opened.readline().strip().split(",")
        missing = [name for name in ("t", *names) if name not in header]
        if missing:
            raise DataError(f"{file} has no column {', '.join(missing)}; give a log of `nsde track`.")
        rows = np.loadtxt(opened, delimiter=",", ndmin=2)
    t = rows[:, header.index("t")]
    x = torch.from_numpy(rows[:, [header.index(name) for name in names]].copy())
    out: list[tuple[Tensor, Tensor]] = []
    due = t[0]
    for row, time_ in enumerate(t):
        if time_ >= due - 1e-9 and len(out) < count:
            out.append((x[row], reference.window(float(time_), dt=o.dt, steps=o.steps)))
            due += period
    return out


def warm(exported: ExportedController) -> None:
    """Some steps from rest, so that what is timed later is none of a cold start."""
    s, before = exported.sizes, None
    x = at_rest(exported.known, torch.float64)[None]
    for _ in range(5):
        before = exported.plan(x, x[:, None].repeat(1, s.steps, 1), before, elapsed=exported.options.dt)
        exported.predictor(before.z[0, 0, :1], before.u[0, :1], torch.zeros(1, s.nd))


@torch.no_grad()
def attack(
    exported: ExportedController, reference: StateReference, count: int, out: Verification, *, seed: int = 1
) -> None:
    """Give a file numbers that no sensor should send, near sound ones along a reference, and look at every answer."""
    g, s, o = torch.Generator().manual_seed(seed), exported.sizes, exported.options
    at, names = exported.known.quaternion, [e["name"] for e in exported.record["step"]["outputs"]]
    inputs = exported.known.input_names
    # in the precision of the file, whose bounds these are
    ends = [torch.tensor(o.of_inputs(k, inputs), dtype=exported.dtype) for k in ("low", "high")]

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def pick(n: int) -> int:
        return int(torch.randint(n, (), generator=g))

    odd = torch.tensor(
        [torch.nan, torch.inf, -torch.inf, 1e300, -1e300, 1e38, 1e6, -1e3, 0.0], dtype=torch.float64
    )
    before = torch.zeros(s.n_plan, dtype=torch.float64)
    for k in range(count):
        t = reference.duration * float(torch.rand((), generator=g))
        x = reference.at(torch.tensor(t, dtype=torch.float64)) + 0.05 * draw(s.nx)
        if at is not None:
            x[at] = torch.nn.functional.normalize(x[at], dim=0)
        ref = reference.window(t, dt=o.dt, steps=o.steps).clone()
        elapsed = torch.tensor(0.02, dtype=torch.float64)
        now = {"state": x, "elapsed": elapsed, "reference": ref, "before": before.clone()}
        given = {**first_inputs(s, x), **now}
        for _ in range(1 + pick(3)):
            kind = pick(10)
            if kind == 0:
                x[pick(s.nx)] = odd[pick(len(odd))]
            elif kind == 1 and at is not None:
                x[at] = odd[pick(len(odd))] * torch.ones(4) if pick(2) else draw(4) * 10.0 ** pick(4)
            elif kind in (1, 2):
                x[:] = draw(s.nx) * 10.0 ** (pick(60) - 10)
            elif kind == 3:
                ref[:] = ref[0].clone()
                if s.flies:
                    ref[:, 3:6] = 0.0
            elif kind == 4:
                ref[pick(o.steps), pick(s.nx)] = odd[pick(len(odd))]
            elif kind == 5:
                ref += draw(1, s.nx) * 10.0 ** pick(30)
            elif kind == 6:
                name = ("last", "push", "memory")[pick(3)]
                given[name] = draw(len(given[name])) * odd[pick(len(odd))]
            elif kind == 7:
                given["elapsed"] = odd[pick(len(odd))] * (1.0 if pick(2) else 1e-3)
            elif kind == 8:
                table = given["before"]
                table[pick(len(table))] = odd[pick(len(odd))]
            else:
                given["valid"] = odd[pick(len(odd))].clone()
        answer = exported.step(*given.values())
        before = answer[-1]
        wrong = unsafe(dict(zip(names, answer, strict=True)), *ends)
        if wrong is not None:
            out.unsafe.append(f"sample {k}: {wrong}")
            before = torch.zeros_like(before)
        out.adversarial += 1


def unsafe(answer: Mapping[str, Tensor], low: Tensor, high: Tensor) -> str | None:
    """What is wrong with an answer by name (`step.tensors`), if anything, by the bounds of its inputs (nu,)."""
    u, status = answer["inputs"], float(answer["status"])
    for name, value in answer.items():
        if name not in ("cost", "gap", "after") and not bool(torch.isfinite(value).all()):
            return f"{name} are not finite"
    if bool((u < low).any()) or bool((u > high).any()):
        return f"inputs of {float(u.min()):.3g} to {float(u.max()):.3g} are out of bounds"
    if bool(torch.isnan(answer["cost"])) or bool(torch.isnan(answer["gap"])):
        return "the cost is no number"
    if not 0 <= status < len(STATUS):
        return f"a status of {status}"
    return None


def resident_mb() -> float:
    """Largest resident size of the process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
