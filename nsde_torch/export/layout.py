"""What goes into the exported step and what comes out: names, shapes, units, frames; and the words of its status.

    step(state, valid, elapsed, reference, last, push, memory, before) -> inputs, rates, thrust, ..., status, after

All tensors are of double precision, on the CPU, without a batch axis. World ENU, body FLU, quaternion w x y z from body
to world. `after` is what the next step takes as `before`; the first step takes zeros. Rates, thrust and lift are
outputs of multirotors alone.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from nsde_torch.control import controller as c

TROUBLES = (c.BAD_STATE, c.BAD_REFERENCE, c.JUMP, c.DIVERGED)


def status_words(at_rest: str) -> tuple[str, ...]:
    """Words of the numbers that `status` takes, for a machine whose last thing to do is called so."""
    return c.CONVERGED, c.IMPROVED, *(f"{t}:{done}" for t in TROUBLES for done in (c.KEPT, at_rest))


STATUS = status_words(c.HOVER)
"""Those of a multirotor."""

KNOWN, AGE, JUMPED, COST, GAP, SOLVES = range(6)
N_HEAD = 6
"""Places at the head of `before` and `after`; inputs (steps, nu) and states (particles, steps + 1, nz) follow."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of a controller."""

    nx: int  # states
    nu: int  # inputs
    nz: int  # states with memory
    nd: int  # pushes
    steps: int  # of a plan
    particles: int  # paths of a plan
    flies: bool  # whether it is a multirotor's

    @property
    def n_plan(self) -> int:
        """Length of `before` and `after`."""
        return N_HEAD + self.steps * self.nu + self.particles * (self.steps + 1) * self.nz


@dataclass(frozen=True)
class Entry:
    """One tensor."""

    name: str  # what it is called
    shape: tuple[int, ...]  # its axes
    unit: str  # its unit, or one per column
    help: str  # what it is


_STATE, _PUSH = "m, m/s, 1, rad/s", "m/s2, rad/s2"


def step_inputs(s: Sizes, units: str = _STATE) -> tuple[Entry, ...]:
    """Arguments of `step`, in order; `units` are those of the states."""
    return (
        Entry("state", (s.nx,), units, "measured state at the time from which the plan holds"),
        Entry("valid", (), "1", "0: the state is not reliable, whatever it says"),
        Entry("elapsed", (), "s", "time since the step that `before` comes from"),
        Entry("reference", (s.steps, s.nx), units, "states to track at the ends of the steps"),
        Entry("last", (s.nu,), "1", "inputs that act now; nan: those of the plan before"),
        Entry("push", (s.nd,), _push(s), "disturbance on the force ports; 0: none"),
        Entry(
            "memory", (s.nz - s.nx,), "1", "memory of the model's effects now; nan: stationary under `last`"
        ),
        Entry("before", (s.n_plan,), "1", "`after` of the step before; zeros: there was none"),
    )


def first_inputs(s: Sizes, x: Tensor) -> dict[str, Tensor]:
    """Arguments of a first step by name, in order: at a state (nx,), where the machine is to stay."""
    made = {e.name: torch.zeros(e.shape, dtype=torch.float64) for e in step_inputs(s)}
    unknown = {name: torch.full_like(made[name], torch.nan) for name in ("last", "memory")}
    valid = torch.ones((), dtype=torch.float64)
    return {**made, **unknown, "state": x.clone(), "reference": x.repeat(s.steps, 1), "valid": valid}


def step_outputs(s: Sizes, units: str = _STATE) -> tuple[Entry, ...]:
    """What `step` returns, in order; `units` are those of the states."""
    flight = (
        Entry("rates", (3,), "rad/s", "desired body rates: those that the plan expects one step ahead"),
        Entry("thrust", (), "1", "mean of the first commands"),
        Entry("lift", (s.steps,), "m/s2", "collective thrust over mass along the body's z axis, by step"),
    )
    return (
        Entry(
            "inputs",
            (s.steps, s.nu),
            "1",
            "commands, finite and within bounds; row k holds for the k-th step",
        ),
        *(flight if s.flies else ()),
        Entry("states", (s.steps + 1, s.nx), units, "states that the plan expects"),
        Entry("cost", (), "1", "what the plan costs; infinite for one that stays at rest"),
        Entry("gap", (), "1", "estimated share of the cost that a better plan would save"),
        Entry("status", (), "1", "number of the word in `status`"),
        Entry("iterations", (), "1", "iterations of the solver"),
        Entry("after", (s.n_plan,), "1", "the plan, for the next step"),
    )


def predict_inputs(s: Sizes, units: str = _STATE) -> tuple[Entry, ...]:
    """Arguments of `predict`, in order."""
    return (
        Entry("z", (s.nz,), units, "state with the memory of the model's effects"),
        Entry("u", (s.nu,), "1", "inputs that act, held"),
        Entry("push", (s.nd,), _push(s), "disturbance on the force ports"),
    )


def predict_outputs(s: Sizes, units: str = _STATE) -> tuple[Entry, ...]:
    """What `predict` returns."""
    return (Entry("z", (s.nz,), units, "the same one sample later"),)


def _push(s: Sizes) -> str:
    return _PUSH if s.flies else "those of the rates that it is added to"
