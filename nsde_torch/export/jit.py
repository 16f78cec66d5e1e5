"""TorchScript, in one place: graphs of the stages of the step, and the loops between them in its own language.

The loops are those of `step.run`. Interpreting a graph costs 1 to 2 us an operation, whatever its size. torch
deprecates TorchScript and says so at every call, and files of it are what libtorch loads.
"""

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict

import torch
from torch import Tensor

from nsde_torch.export.step import ExportedStep, step_outputs

Function = Callable[..., Sequence[Tensor]]
_STEP = """
def step(self, state: Tensor, valid: Tensor, elapsed: Tensor, reference: Tensor, last: Tensor, push: Tensor,
         memory: Tensor, before: Tensor) -> {results}:
    z0, start_u, start_z, ref, now, d, head, trouble = self.begin(
        state, valid, elapsed, reference, last, push, memory, before)
    u = start_u
    z = start_z
    cost = self.infinite
    gap = self.infinite
    iterations = 0
    if bool(trouble < 0.5):
        if bool(head[0] < 0.5):
            _, z, _, _ = self.finish(z0, u, ref, now, d, self.no_step, self.nothing)
        u, z, cost, gap, iterations = self.solved(z0, u, z, ref, now, d)
        if self.anew > 0 and bool(head[0] > 0.5) and int(head[5]) % max(self.anew, 1) == 0:
            here = z0[:, None, None].expand_as(z).contiguous()
            other_u, other_z, other_cost, other_gap, _ = self.solved(z0, self.rest, here, ref, now, d)
            if bool(other_cost < cost):
                u, z, cost, gap = other_u, other_z, other_cost, other_gap
    return self.end(u, z, cost, gap, self.counts[iterations], z0, start_u, start_z, head, trouble)
"""
_SOLVED = """
def solved(self, z0: Tensor, u: Tensor, z: Tensor, ref: Tensor, now: Tensor,
           d: Tensor) -> Tuple[Tensor, Tensor, Tensor, Tensor, int]:
    cost = self.infinite
    gap = self.infinite
    iterations = 0
    going = True
    while going:
        hessian, gradient, low, high, value, best, least = self.prepare(z0, u, z, ref, now, d)
        step = self.no_step
        slope = gradient
        left = least
        change = 0
        changing = True
        while changing:
            step, slope, best, least, left = self.active_set(
                hessian, gradient, low, high, value, step, slope, best, least)
            change += 1
            changing = change < {changes} and not bool(left <= {left!r})
        before = cost
        u, z, cost, gap = self.finish(z0, u, ref, now, d, best, least)
        if bool(left > {left!r}):
            gap = torch.maximum(gap, (before - cost) / torch.clamp(torch.abs(cost), min=1e-9))
        iterations += 1
        going = iterations < {iterations} and not bool(gap <= {tolerance!r})
    return u, z, cost, gap, iterations
"""
_FINISH = """
def finish(self, z0: Tensor, u: Tensor, ref: Tensor, now: Tensor, d: Tensor, step: Tensor,
           least: Tensor) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    tried, by_step, row, noise = self.tries(z0, u, step)
    states = [row]
    for own, increment in zip(by_step.unbind(0), noise.unbind(0)):
        row = self.advance(row, own, d, increment)
        states.append(row)
    return self.choose(torch.stack(states, 1), tried, ref, now, least)
"""
_PREDICT = """
def predict(self, z: Tensor, u: Tensor, push: Tensor) -> Tuple[Tensor]:
    return self.foresee(z, u, push)
"""


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the notices of deprecation, and without those that a graph of constants is traced as such."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*TorchScript.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)
        yield


def scripted(step: ExportedStep) -> bytes:
    """The bytes of a file with the step as a frozen module of the methods `step` and `predict` (see `step_inputs`)."""
    from nsde_torch.export.graph import graph_of  # with torch's tracer, which those who load do without

    buffer, examples, s = io.BytesIO(), step.examples(), step.sizes
    results = f"Tuple[{', '.join(['Tensor'] * len(step_outputs(s)))}]"
    tensors = {
        "infinite": torch.full((1,), torch.inf, dtype=step.dtype),
        "no_step": torch.zeros(1, s.steps * s.nu, dtype=step.dtype),
        "nothing": torch.zeros(1, dtype=step.dtype),
        "counts": torch.arange(step.loops.iterations + 1, dtype=torch.float64),
        "rest": torch.tensor(step.loops.rest, dtype=step.dtype).expand(1, s.steps, s.nu).contiguous(),
    }
    with _quiet(), torch.no_grad():

        class Assembly(torch.jit.ScriptModule):
            def __init__(self) -> None:
                super().__init__()
                for name, example in examples.items():
                    graph = graph_of(step.stage(name), example)
                    if name == "advance":  # its one result is returned as it is and not as a tuple
                        (output,) = (n for n in graph.graph.nodes if n.op == "output")
                        output.args = (output.args[0][0],)
                        graph.recompile()
                    part = torch.jit.trace(graph.eval(), tuple(example), check_trace=False)
                    setattr(self, "foresee" if name == "predict" else name, part)
                for name, tensor in tensors.items():
                    self.register_buffer(name, tensor)
                self.anew = step.loops.anew
                solved = _SOLVED.format(**asdict(step.loops))
                for text in (_FINISH, solved, _STEP.format(results=results), _PREDICT):
                    self.define(text)

        made = torch.jit.freeze(Assembly().eval(), preserved_attrs=["step", "predict"])
        torch.jit.save(made, buffer)
    return buffer.getvalue()


def loaded(content: bytes, names: Sequence[str]) -> list[Function]:
    """Methods of the module in a file; it is code, and runs when called.

    They run as they are: to specialise them at their first calls takes a second, and makes them no faster (measured).
    """
    with _quiet():
        module = torch.jit.load(io.BytesIO(content), map_location="cpu")

    def method(name: str) -> Function:
        return torch.jit.optimized_execution(False)(getattr(module, name))

    return [method(name) for name in names]
