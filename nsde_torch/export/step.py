"""The whole step of the controller as functions of plain tensors of fixed shapes, and the few branches between them.

    begin -> [finish] -> (prepare -> active_set ... -> finish) ... -> end
                                       finish = tries -> advance ... -> choose, as stages of their own or as one

Each stage is straight-line arithmetic, which can be written down as a graph; the loops between them compare one number
each. The same stages are run here in Python, put together by TorchScript, and compiled ahead of time, so that there
is one source of what the controller does. Checks of the state, the shift of the last plan, its fallback and the bounds
are those of `control.controller.Controller`, as arithmetic.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from nsde_torch.control import controller as c
from nsde_torch.control.controller import Controller, Plan
from nsde_torch.control.gauss_newton import CHANGES, LEFT, GaussNewton, saved
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import _repeat
from nsde_torch.errors import ConfigError
from nsde_torch.systems import Multirotor

# What goes into the exported step and what comes out: names, shapes, units, frames; and the words of its status.
#
#     step(state, valid, elapsed, reference, last, push, memory, before) -> inputs, rates, thrust, ..., status, after
#
# All tensors are of double precision, on the CPU, without a batch axis. World ENU, body FLU, quaternion w x y z from
# body to world. `after` is what the next step takes as `before`; the first step takes zeros. Rates, thrust and lift are
# outputs of multirotors alone.

TROUBLES = (c.BAD_STATE, c.BAD_REFERENCE, c.JUMP, c.DIVERGED)


def status_words(at_rest: str) -> tuple[str, ...]:
    """Words of the numbers that `status` takes, for a machine whose last thing to do is called so."""
    return c.CONVERGED, c.IMPROVED, *(f"{t}:{done}" for t in TROUBLES for done in (c.KEPT, at_rest))


STATUS = status_words(c.HOVER)  # those of a multirotor

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


def tensors(s: Sizes, units: str = "") -> dict[str, dict[str, list[dict[str, Any]]]]:
    """What goes into `step` and `predict` and what comes out, in order; `units` are those of the states."""
    pushed = "m/s2, rad/s2" if s.flies else "those of the rates that it is added to"
    push = ("push", (s.nd,), pushed, "disturbance on the force ports")
    flight = (
        ("rates", (3,), "rad/s", "desired body rates: those that the plan expects one step ahead"),
        ("thrust", (), "1", "mean of the first commands"),
        ("lift", (s.steps,), "m/s2", "collective thrust over mass along the body's z axis, by step"),
    )
    commands = "commands, finite and within bounds; row k holds for the k-th step"
    rows: dict[str, Sequence[tuple[str, tuple[int, ...], str, str]]] = {
        "step inputs": (
            ("state", (s.nx,), units, "measured state at the time from which the plan holds"),
            ("valid", (), "1", "0: the state is not reliable, whatever it says"),
            ("elapsed", (), "s", "time since the step that `before` comes from"),
            ("reference", (s.steps, s.nx), units, "states to track at the ends of the steps"),
            ("last", (s.nu,), "1", "inputs that act now; nan: those of the plan before"),
            (*push[:3], f"{push[3]}; 0: none"),
            (
                "memory",
                (s.nz - s.nx,),
                "1",
                "memory of the model's effects now; nan: stationary under `last`",
            ),
            ("before", (s.n_plan,), "1", "`after` of the step before; zeros: there was none"),
        ),
        "step outputs": (
            ("inputs", (s.steps, s.nu), "1", commands),
            *(flight if s.flies else ()),
            ("states", (s.steps + 1, s.nx), units, "states that the plan expects"),
            ("cost", (), "1", "what the plan costs; infinite for one that stays at rest"),
            ("gap", (), "1", "estimated share of the cost that a better plan would save"),
            ("status", (), "1", "number of the word in `status`"),
            ("iterations", (), "1", "iterations of the solver"),
            ("after", (s.n_plan,), "1", "the plan, for the next step"),
        ),
        "predict inputs": (
            ("z", (s.nz,), units, "state with the memory of the model's effects"),
            ("u", (s.nu,), "1", "inputs that act, held"),
            push,
        ),
        "predict outputs": (("z", (s.nz,), units, "the same one sample later"),),
    }
    out: dict[str, dict[str, list[dict[str, Any]]]] = {"step": {}, "predict": {}}
    for name, entries in rows.items():
        function, _, way = name.partition(" ")
        keys = ("name", "shape", "unit", "help")
        out[function][way] = [dict(zip(keys, entry, strict=True)) for entry in entries]
    return out


def first_inputs(s: Sizes, x: Tensor) -> dict[str, Tensor]:
    """Arguments of a first step by name, in order: at a state (nx,), where the machine is to stay."""
    made = {e["name"]: torch.zeros(e["shape"], dtype=torch.float64) for e in tensors(s)["step"]["inputs"]}
    unknown = {name: torch.full_like(made[name], torch.nan) for name in ("last", "memory")}
    valid = torch.ones((), dtype=torch.float64)
    return {**made, **unknown, "state": x.clone(), "reference": x.repeat(s.steps, 1), "valid": valid}


Stage = Callable[..., Sequence[Tensor]]
STAGES = ("begin", "prepare", "active_set", "tries", "advance", "choose", "end", "predict")
"""Stages whose graphs are small, and are interpreted."""
WHOLE = ("begin", "prepare", "active_set", "finish", "end", "predict")
"""The same, with the rollout written out as a part of one stage, to be compiled."""


class Loops(NamedTuple):
    """What the loops between the stages go by."""

    changes: int  # most changes of the active set in an iteration
    left: float  # share of the quadratic's saving that an iteration may leave
    iterations: int  # most iterations
    tolerance: float  # share of the cost that may be left
    anew: int  # solves between two that start at rest too; 0: none does
    rest: list[float]  # inputs at rest (nu,)


@final
class ExportedStep(nn.Module):
    """The step of a controller, with its numbers as they are now; `sample` predicts over a sample of the fine grid.

    A ConfigError refuses a controller of several machines, or with a solver that cannot be exported.
    """

    def __init__(self, controller: Controller, sample: Predictor) -> None:
        super().__init__()
        if controller.batch != 1:
            raise ConfigError(f"a flight computer flies one machine; got a batch of {controller.batch}.")
        method = controller.solver._method
        if not isinstance(method, GaussNewton):
            raise ConfigError("only the solver gauss_newton is exported; got apg. Take mpc=default.")
        self.method, self.horizon, self.sample = method, controller.horizon, sample
        self.prepare, self.active_set = method.prepare, method.active_set  # stages as they are
        self.predictor, self.safety = controller.predictor, controller.safety
        self.options = o = controller.options
        p, solver, system = self.predictor, controller.solver.options, self.predictor.system
        self.dtype, self.quaternion = p.dtype, system.quaternion
        self.multirotor = system if isinstance(system, Multirotor) else None
        self.sizes = Sizes(p.nx, p.nu, p.nz, p.nd, o.steps, o.particles, self.multirotor is not None)
        rest = controller.hover.double().tolist()
        self.loops = Loops(CHANGES, LEFT, solver.iterations, solver.tolerance, controller.anew, rest)
        self.hover_u: Tensor
        self.hover_z: Tensor
        still = controller.hovering()
        self.register_buffer("hover_u", still.u.clone())
        self.register_buffer("hover_z", still.z.clone())

    # ---- stages -----------------------------------------------------------------------------------------

    def begin(
        self,
        state: Tensor,
        valid: Tensor,
        elapsed: Tensor,
        reference: Tensor,
        last: Tensor,
        push: Tensor,
        memory: Tensor,
        before: Tensor,
    ) -> tuple[Tensor, ...]:
        """From what the step is given (`tensors`) to the problem.

        z0 (1, nz), start u (1, K, nu), start z (1, P, K + 1, nz), reference (1, K, nx), last (1, nu), push (1, nd),
        head (6,): see `KNOWN` and the places after it; and the trouble, 0-d.
        """
        s, safety, dtype, inf = self.sizes, self.safety, self.dtype, torch.inf
        n = s.steps * s.nu
        head, u, z = before.split((N_HEAD, n, before.numel() - N_HEAD - n))
        old_u = u.view(1, s.steps, s.nu).to(dtype)
        old_z = z.view(1, s.particles, s.steps + 1, s.nz).to(dtype)
        late = torch.where(torch.isfinite(elapsed), elapsed, torch.zeros_like(elapsed)).clamp_min(0.0)
        steps = late / self.options.dt
        u = _shift(old_u, steps).clamp(self.horizon.low, self.horizon.high)
        z = _shift(old_z, steps, axis=2)
        # a plan that the host has not kept as it was is none
        known = (head[KNOWN] > 0.5) & torch.isfinite(elapsed) & ~torch.isnan(head).any()
        known = known & torch.isfinite(old_u).all() & torch.isfinite(z).all()
        head = torch.where(known, head, torch.zeros_like(head))
        u, z = torch.where(known, u, self.hover_u), torch.where(known, z, self.hover_z)
        age = torch.where(known, head[AGE].to(dtype) + late.to(dtype), torch.full_like(z[0, 0, 0, 0], inf))
        x, ref, given = state.to(dtype)[None], reference.to(dtype)[None], last.to(dtype)[None]
        first = torch.where(torch.isfinite(given).all(), given, u[:, 0])
        d = push.to(dtype)[None]
        d = torch.where(torch.isfinite(d).all(), d, torch.zeros_like(d))

        expected = z[:, 0, 0, : s.nx]
        finite = torch.isfinite(x).all()
        sane = torch.isfinite(ref).all()
        unit, far = finite, ~finite
        if (at := self.quaternion) is not None:
            unit = ((x[:, at] * x[:, at]).sum().sqrt() - 1.0).abs() <= safety.quaternion
            turned = 2.0 * torch.arccos((x[:, at] * expected[:, at]).sum().abs().clamp_max(1.0))
            far = turned > safety.jump_attitude
        if self.multirotor is not None:
            gone = x[:, :3] - expected[:, :3]
            far = far | ((gone * gone).sum().sqrt() > safety.jump)
        jumped = finite & known & (age <= safety.keep) & far
        count = torch.where(jumped, head[JUMPED] + 1.0, torch.zeros_like(head[JUMPED]))
        believed = finite & unit & (valid > 0.5)
        unlikely = jumped & (count < safety.jump_samples)
        trouble = torch.where(unlikely, 3.0, torch.zeros_like(count))
        trouble = torch.where(believed, torch.where(sane, trouble, 2.0), 1.0)
        bad = trouble > 0.5

        x = torch.where(bad, expected, x)
        ref = torch.where(bad, z[:, 0, 1:, : s.nx], ref)
        if at is not None:
            q = x[:, at]
            q = q / q.norm(dim=1, keepdim=True).clamp_min(1e-12)
            x = torch.cat((x[:, : at.start], q, x[:, at.stop :]), 1)
        z0 = self.predictor.augment(x, first)
        if s.nz > s.nx:
            rest = memory.to(dtype)[None]
            rest = torch.where(torch.isfinite(rest).all(), rest, z0[:, s.nx :])
            z0 = torch.cat((x, rest), 1)
        solves = head[SOLVES] + 1.0 - bad.to(count)
        kept = torch.stack((known.to(count), age.to(count), count, head[COST], head[GAP], solves))
        return z0.clone(), u, z, ref.clone(), first.clone(), d, kept, trouble

    def tries(self, z0: Tensor, u: Tensor, step: Tensor) -> tuple[Tensor, ...]:
        """Inputs to roll out (S, K, nu), the same by step (K, S, nu), first states (S P, nz), and noise (K, P, nx)."""
        tried = self.method.tries(u, step)
        rows = len(tried) * self.sizes.particles
        return tried, tried.transpose(0, 1), z0.expand(rows, self.sizes.nz), self.horizon.noise.clone()

    def advance(self, z: Tensor, u: Tensor, d: Tensor, noise: Tensor) -> tuple[Tensor, ...]:
        """States (S P, nz) a step later, from inputs (S, nu), a push (1, nd) and the step's noise (P, nx)."""
        s, p = len(u), self.sizes.particles
        push = d.expand(s * p, self.sizes.nd)
        return (self.horizon.advance(z, _repeat(u, p), push, noise.repeat(s, 1) if p > 1 else None),)

    def choose(
        self, paths: Tensor, tried: Tensor, ref: Tensor, last: Tensor, least: Tensor
    ) -> tuple[Tensor, ...]:
        """u, z, cost, gap of the best candidate, from states (S P, K + 1, nz); see `GaussNewton.choose`."""
        by_plan = paths.view(len(tried), self.sizes.particles, *paths.shape[1:])
        best = self.method.choose(by_plan, tried, ref, last, least)
        return best.u, best.z, best.cost, best.gap

    def finish(
        self, z0: Tensor, u: Tensor, ref: Tensor, last: Tensor, d: Tensor, step: Tensor, least: Tensor
    ) -> tuple[Tensor, ...]:
        """u, z, cost, gap of the best share of a step; see `GaussNewton.finish`."""
        best = self.method.finish(z0, u, ref, last, d, step, least)
        return best.u, best.z, best.cost, best.gap

    def end(
        self,
        found_u: Tensor,
        found_z: Tensor,
        cost: Tensor,
        gap: Tensor,
        iterations: Tensor,
        z0: Tensor,
        start_u: Tensor,
        start_z: Tensor,
        head: Tensor,
        trouble: Tensor,
    ) -> tuple[Tensor, ...]:
        """From the best plan to what leaves, or what takes its place; see `tensors`."""
        s, dtype = self.sizes, torch.float64
        safe = (trouble < 0.5) & torch.isfinite(cost).all() & torch.isfinite(found_u).all()
        trouble = torch.where(trouble < 0.5, float(len(TROUBLES)), trouble)
        usable = (head[KNOWN] > 0.5) & (head[AGE].to(self.dtype) <= self.safety.keep)
        good = (gap[0] > self.loops.tolerance).to(dtype)  # 0: converged, 1: improved
        good = torch.where(torch.isnan(gap[0]), 1.0, good)
        status = torch.where(safe, good, 2.0 * trouble + 1.0 - usable.to(dtype))
        rest_z = torch.where(
            torch.isfinite(z0).all(), z0[:, None, None].expand_as(self.hover_z), self.hover_z
        )

        def chosen(new: Tensor, old: Tensor, rest: Tensor) -> Tensor:
            return torch.where(safe, new, torch.where(usable, old, rest))

        infinite = torch.full_like(head[AGE], torch.inf)
        u = chosen(found_u, start_u, self.hover_u).clamp(self.horizon.low, self.horizon.high)
        z = chosen(found_z, start_z, rest_z)
        own_cost = chosen(cost[0].to(dtype), head[COST], infinite)
        own_gap = chosen(gap[0].to(dtype), head[GAP], infinite)
        age = chosen(torch.zeros_like(infinite), head[AGE], infinite)
        kept = torch.stack((torch.ones_like(age), age, head[JUMPED], own_cost, own_gap, head[SOLVES]))
        x = z[0, 0, :, : s.nx]
        after = torch.cat((kept, u.flatten().to(dtype), z.flatten().to(dtype)))
        flight: tuple[Tensor, ...] = ()
        if self.multirotor is not None:
            lift = self.multirotor.quantity("thrust", x[:-1], u[0])[:, 0]
            flight = (x[1, 10:13].to(dtype), u[0, 0].mean().to(dtype), lift.to(dtype))
        plan = (u[0].to(dtype), *flight, x.to(dtype))
        return (*plan, own_cost, own_gap, status, iterations.to(dtype), after)

    def predict(self, z: Tensor, u: Tensor, push: Tensor) -> tuple[Tensor, ...]:
        """State with memory (nz,) a sample later; see `tensors`."""
        rows = (t.to(self.dtype)[None] for t in (z, u, push))
        return (self.sample(*rows)[0].to(torch.float64),)

    # ---- what is between them ---------------------------------------------------------------------------

    def examples(self, names: Sequence[str] = STAGES) -> dict[str, list[Tensor]]:
        """Arguments of stages (`STAGES` or `WHOLE`), of the shapes and types that they are run with."""
        seen: dict[str, list[Tensor]] = {}

        def watched(name: str) -> Stage:
            def run(*arguments: Tensor) -> Sequence[Tensor]:
                # one tensor in two places would become one argument
                seen.setdefault(name, [a.clone() for a in arguments])
                return self.stage(name)(*arguments)

            return run

        stages = {name: watched(name) for name in names}
        whole = WholeStep(stages, self.loops)
        with torch.no_grad():
            whole.step(*self.first())
        push = torch.zeros(self.sizes.nd, dtype=torch.float64)
        whole.predict(self.hover_z[0, 0, 0].double(), self.hover_u[0, 0].double(), push)
        return seen

    def first(self) -> list[Tensor]:
        """Arguments of a first step: hovering, where the machine is to hover."""
        return list(first_inputs(self.sizes, self.hover_z[0, 0, 0, : self.sizes.nx].double()).values())

    def stage(self, name: str) -> Stage:
        """A stage, whose results lie in memory row by row, as the next one expects them."""
        return lambda *arguments: [t.contiguous() for t in getattr(self, name)(*arguments)]


class Rollout(nn.Module):
    """`finish` of the stages that it consists of."""

    def __init__(self, stages: Mapping[str, Any]) -> None:
        super().__init__()
        self.tries, self.advance, self.choose = (stages[name] for name in ("tries", "advance", "choose"))

    def forward(
        self, z0: Tensor, u: Tensor, ref: Tensor, now: Tensor, d: Tensor, step: Tensor, least: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """u, z, cost, gap of the best share of a step; see `GaussNewton.finish`."""
        tried, by_step, z, noise = self.tries(z0, u, step)
        states = [z]
        for own_u, own_noise in zip(by_step.unbind(0), noise.unbind(0)):  # noqa: B905  (TorchScript has no strict)
            (z,) = self.advance(z, own_u, d, own_noise)
            states.append(z)
        u, z, cost, gap = self.choose(torch.stack(states, 1), tried, ref, now, least)
        return u, z, cost, gap


class WholeStep(nn.Module):
    """The step, stage after stage: what every form of it does, and TorchScript compiles.

    The stages are those of `STAGES` or of `WHOLE`, as they are, graphs or compiled.
    """

    def __init__(self, stages: Mapping[str, Any], loops: Loops) -> None:
        super().__init__()
        self.begin, self.prepare, self.active_set = (stages[k] for k in ("begin", "prepare", "active_set"))
        self.finish = stages["finish"] if "finish" in stages else Rollout(stages)
        self.end, self.foresee = stages["end"], stages["predict"]
        self.changes, self.left, self.iterations, self.tolerance, self.anew, self.rest = loops

    @torch.jit.export
    def step(
        self,
        state: Tensor,
        valid: Tensor,
        elapsed: Tensor,
        reference: Tensor,
        last: Tensor,
        push: Tensor,
        memory: Tensor,
        before: Tensor,
    ) -> Any:  # a tuple; how many tensors depends on the machine
        """See `tensors`."""
        z0, start_u, start_z, ref, now, d, head, trouble = self.begin(
            state, valid, elapsed, reference, last, push, memory, before
        )
        u, z = start_u, start_z
        cost = torch.full((1,), torch.inf, dtype=u.dtype)
        gap = cost
        iterations = 0
        if bool(trouble < 0.5):
            known = bool(head[0] > 0.5)
            if not known:  # no step at all is as good as its shares: what is left is the rollout
                z = self.finish(z0, u, ref, now, d, torch.zeros_like(u).flatten(1), torch.zeros_like(cost))[1]
            u, z, cost, gap, iterations = self.solved(z0, u, z, ref, now, d)
            if known and self.anew > 0 and int(head[5]) % max(self.anew, 1) == 0:
                rest = torch.tensor(self.rest, dtype=u.dtype).expand_as(u)
                here = z0[:, None, None].expand_as(z)
                other = self.solved(z0, rest.contiguous(), here.contiguous(), ref, now, d)
                if bool(other[2] < cost):
                    u, z, cost, gap = other[:4]
        count = torch.tensor(float(iterations), dtype=torch.float64)
        return self.end(u, z, cost, gap, count, z0, start_u, start_z, head, trouble)

    def solved(
        self, z0: Tensor, u: Tensor, z: Tensor, ref: Tensor, now: Tensor, d: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
        """u, z, cost, gap and the number of iterations of a solve from u and z; see `GaussNewton.iterate`."""
        cost = torch.full((1,), torch.inf, dtype=u.dtype)
        gap = cost
        iterations = 0
        while iterations < self.iterations and not bool(gap <= self.tolerance):
            hessian, gradient, low, high, value, best, least = self.prepare(z0, u, z, ref, now, d)
            step, slope, left = torch.zeros_like(gradient), gradient, torch.full_like(least[0], torch.inf)
            change = 0
            while change < self.changes and not bool(left <= self.left):
                step, slope, best, least, left = self.active_set(
                    hessian, gradient, low, high, value, step, slope, best, least
                )
                change += 1
            before = cost
            u, z, cost, gap = self.finish(z0, u, ref, now, d, best, least)
            if bool(left > self.left):
                gap = torch.maximum(gap, saved(before, cost))
            iterations += 1
        return u, z, cost, gap, iterations

    @torch.jit.export
    def predict(self, z: Tensor, u: Tensor, push: Tensor) -> tuple[Tensor]:
        """See `tensors`."""
        (after,) = self.foresee(z, u, push)
        return (after,)


def packed(plan: Plan, jumped: float, solves: float) -> Tensor:
    """A plan of one machine as the `before` of a step, with how many samples have jumped and plans were solved for."""
    counts = torch.tensor((jumped, solves))
    head = torch.stack((torch.ones(()), plan.age[0], counts[0], plan.cost[0], plan.gap[0], counts[1]))
    return torch.cat([part.double().flatten() for part in (head, plan.u, plan.z)])


def _shift(table: Tensor, steps: Tensor, *, axis: int = 1) -> Tensor:
    """As in `control.controller`, of a number of steps that is not known while the graph is made."""
    n = table.shape[axis]
    at = (torch.arange(n, dtype=torch.float64) + steps).clamp(0.0, n - 1.0)
    low = at.floor().long().clamp_max(max(n - 2, 0))
    shape = [1] * table.ndim
    shape[axis] = n
    share = (at - low).to(table).view(shape)
    high = (low + 1).clamp_max(n - 1)
    return (1.0 - share) * table.index_select(axis, low) + share * table.index_select(axis, high)
