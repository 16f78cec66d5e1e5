"""The step as machine code, compiled ahead of time: the same stages, and the loops between them as loops of the graph.

The loops are those of `step.Step.run`; `while_loop` keeps them loops, so that a stage is compiled once however often it
runs: a rollout of 20 steps compiles as fast as one step.
"""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, fx
from torch._higher_order_ops.while_loop import while_loop_op as _while_loop_op
from torch.fx.experimental.proxy_tensor import make_fx

from nsde_torch.control.compiled import has_compiler
from nsde_torch.errors import ExportError
from nsde_torch.export.graph import graph_of
from nsde_torch.export.layout import KNOWN
from nsde_torch.export.step import Step

while_loop_op: Any = _while_loop_op  # its own types know no tuple of several tensors
MODELS = ("step", "predict")
"""Names of the models in a package."""


def compiled(step: Step, path: Path, *, say: Callable[[str], None]) -> None:
    """Write a package with the models `step` and `predict` (see `layout`).

    Args:
        step: The step.
        path: Package to write.
        say: Called with a line when something takes long.

    Raises:
        ExportError: there is no compiler, or it refuses.
    """
    from torch._inductor.package import package_aoti

    if not has_compiler():
        raise ExportError(
            "`format=aoti` needs a C++ compiler (g++ or clang++; CXX names it). Install one, or take "
            "format=torchscript."
        )
    examples = step.examples()
    given = {"step": step.first(), "predict": examples["predict"]}
    functions = {"step": looped(step, examples), "predict": step.stage("predict")}
    files: dict[str, Any] = {}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in MODELS:
            say(f"compiling {name}")
            try:
                graph = _graph(functions[name], given[name])
                program = torch.export.export(graph, tuple(given[name]), strict=False)
                files[name] = torch._inductor.aot_compile(
                    program.module(), tuple(given[name]), options={"aot_inductor.package": True}
                )
            except Exception as error:
                if os.environ.get("NSDE_TRACEBACK") == "1":
                    raise
                reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
                raise ExportError(
                    f"the compiler gave up on {name}: {reason}. Take format=torchscript."
                ) from error
        package_aoti(str(path), files)


def _graph(function: Callable[..., Sequence[Tensor]], example: Sequence[Tensor]) -> fx.GraphModule:
    return make_fx(lambda *arguments: tuple(function(*arguments)))(*example)


def looped(step: Step, examples: Mapping[str, Sequence[Tensor]]) -> Callable[..., tuple[Tensor, ...]]:
    """The step as a function whose loops are operations; see `step.Step.run`."""
    stages = {name: graph_of(step.stage(name), example) for name, example in examples.items()}
    s, dtype = step.sizes, step.dtype
    # a constant belongs to one loop: the first rollout has copies of its own
    own = {name: copy.deepcopy(stages[name]) for name in ("tries", "advance")}
    noises = [step.horizon.noise.clone() for _ in range(2)]
    counts = [torch.arange(s.steps + 1)[:, None] for _ in range(2)]

    def rollout(row: Tensor, by_step: Tensor, d: Tensor, *, first: bool) -> Tensor:
        advance = (own if first else stages)["advance"]
        noise, ends = noises[first], counts[first]

        def before_end(k: Tensor, *_: Tensor) -> Tensor:
            return k < s.steps

        def once(
            k: Tensor, z: Tensor, paths: Tensor, by_step: Tensor, d: Tensor, noise: Tensor, ends: Tensor
        ) -> tuple[Tensor, ...]:
            at = k.reshape(1)
            (z,) = advance(z, by_step.index_select(0, at)[0], d, noise.index_select(0, at)[0])
            return k + 1, z, torch.where(ends == k + 1, z[:, None], paths)

        start = torch.zeros((), dtype=torch.int64)
        paths = row[:, None].expand(-1, s.steps + 1, -1).contiguous()
        out = while_loop_op(before_end, once, (start, row.clone(), paths), (by_step, d, noise, ends))
        return out[2]

    def minimum(quadratic: Sequence[Tensor], best: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
        def left_over(k: Tensor, left: Tensor, *_: Tensor) -> Tensor:
            return (k < step.changes) & ~(left <= step.left)

        def change(k: Tensor, left: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
            state, fixed = rest[:4], rest[4:]
            step_, slope, best_, least_, left = stages["active_set"](*fixed, *state)
            return k + 1, left, step_, slope, best_, least_

        start = torch.zeros((), dtype=torch.int64)
        first = (start, torch.full((), torch.inf, dtype=dtype), torch.zeros_like(best), quadratic[1].clone())
        out = while_loop_op(left_over, change, (*first, best, least), tuple(quadratic))
        return out[4], out[5]

    def run(*given: Tensor) -> tuple[Tensor, ...]:
        z0, start_u, start_z, ref, last, d, head, trouble = stages["begin"](*given)
        sound = trouble < 0.5

        def cold(again: Tensor, *_: Tensor) -> Tensor:
            return again

        def roll(again: Tensor, z: Tensor, z0: Tensor, u: Tensor, d: Tensor) -> tuple[Tensor, ...]:
            still = torch.zeros_like(u).flatten(1)
            _, by_step, row = own["tries"](z0, u, still)
            of_one = rollout(row, by_step, d, first=True)[: s.particles]
            return ~again & again, of_one.reshape(-1).clone().view(z.shape)

        unknown = sound & (head[KNOWN] < 0.5)
        _, z = while_loop_op(cold, roll, (unknown, start_z.clone()), (z0, start_u, d))

        def going(count: Tensor, go: Tensor, *_: Tensor) -> Tensor:
            return go & (count < step.iterations)

        def iterate(count: Tensor, go: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
            (u, z, _, _), (z0, ref, last, d) = rest[:4], rest[4:]
            *quadratic, best, least = stages["prepare"](z0, u, z, ref, last, d)
            best, least = minimum(quadratic, best, least)
            tried, by_step, row = stages["tries"](z0, u, best)
            u, z, cost, gap = stages["choose"](rollout(row, by_step, d, first=False), tried, ref, last, least)
            return count + 1, ~(gap[0] <= step.tolerance), u, z, cost, gap

        infinite = torch.full((1,), torch.inf, dtype=dtype)
        first = (
            torch.zeros((), dtype=torch.int64),
            sound.clone(),
            start_u.clone(),
            z,
            infinite,
            infinite.clone(),
        )
        count, _, u, z, cost, gap = while_loop_op(going, iterate, first, (z0, ref, last, d))
        out = stages["end"](u, z, cost, gap, count.double(), z0, start_u, start_z, head, trouble)
        return tuple(out)

    return run


def loaded(path: Path) -> tuple[Callable[..., Sequence[Tensor]], Callable[..., Sequence[Tensor]]]:
    """`step` and `predict` of a package; it is machine code, and runs when called.

    Raises:
        ExportError: the package cannot be loaded here.
    """
    from torch._inductor.package import load_package

    try:
        loaders: list[Any] = [
            load_package(str(path), model_name=name, run_single_threaded=True).loader for name in MODELS
        ]
    except Exception as error:
        raise ExportError(
            f"its machine code cannot be loaded here ({str(error).splitlines()[0]}). Export it here with format=aoti."
        ) from error
    step, predict = loaders
    return (lambda *arguments: step.run(list(arguments))), (lambda *arguments: predict.run(list(arguments)))
