"""Slopes d g_i / d z_i of a diagonal diffusion, and the drift that turns one calculus into the other.

dz = f dt + g o dW (Stratonovich)  equals  dz = (f + c) dt + g dW (Ito)  with  c_i = g_i (d g_i / d z_i) / 2
(Kloeden and Platen 1992, section 4.9), for diagonal noise, coupled or not.
"""

import contextlib
import itertools
import types
import warnings
from collections.abc import Callable, Iterator
from typing import Literal, final
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from nsde_torch.errors import SolverError
from nsde_torch.sde.step import SDE, HasDiagonalDerivative, HoldsColumns, Step, Time, within


def diffusion_and_slope(sde: SDE, t: Time, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The diffusion, and the slope of each of its channels in its own state, exact and differentiable.

    An equation with `diffusion_diagonal_derivative` answers itself. Otherwise nz reverse-mode products run as
    one batch and each gives its diagonal entry: the work of about nz diffusions, memory O(N nz) a layer, and
    no Jacobian (N, nz, nz) is kept. (Forward mode would do too, but torch 2.13 cannot compile its gradient.)

    Returns:
        g and d g_i / d z_i, each (N, nz), in units of z and in 1 per square root of a second.
    """
    if isinstance(sde, HasDiagonalDerivative):
        return sde.diffusion(t, z, u), sde.diffusion_diagonal_derivative(t, z, u)

    result = torch.func.vjp(lambda state: sde.diffusion(t, state, u), z)
    g: Tensor = result[0]
    pull_back = result[1]

    def entry(channel: Tensor) -> Tensor:
        return torch.sum(pull_back(channel.expand_as(g))[0] * channel, -1)

    basis = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    return g, torch.vmap(entry, out_dims=-1)(basis)


@final
class _Converted:
    """The same process as `source`, written in the other calculus."""

    def __init__(self, source: SDE, calculus: Literal["ito", "stratonovich"]) -> None:
        self.source = source
        self.calculus: Literal["ito", "stratonovich", "either"] = calculus
        self._sign = 1.0 if calculus == "ito" else -1.0

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        g, slope = diffusion_and_slope(self.source, t, z, u)
        return self.source.drift(t, z, u) + self._sign * 0.5 * g * slope

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.source.diffusion(t, z, u)

    def project(self, z: Tensor) -> Tensor:
        return self.source.project(z)

    def set_step(self, dt: float) -> None:
        if isinstance(self.source, HoldsColumns):
            self.source.set_step(dt)

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        return within(self.source, z, y)


def with_calculus(sde: SDE, calculus: Literal["ito", "stratonovich"]) -> SDE:
    """The same process written in the other calculus, so that a step of that calculus may integrate it.

    `sde` itself if it is in that calculus already, else an equation with the drift correction added or taken.

    Raises:
        SolverError: `sde.calculus` is "either", so there is no process to preserve.
    """
    if sde.calculus == "either":
        raise SolverError('`sde.calculus` must be "ito" or "stratonovich" to be converted; got "either".')
    return sde if sde.calculus == calculus else _Converted(sde, calculus)


# The compiled path: one step of one equation as machine code, called T times by `rollout`.
#
# Measured on two busy cores (torch 2.13, float32, one thread; a multirotor with 13 states, two tanh 8-16
# residual networks and a swish 32-32 distance network; derivative-free Milstein; the ratios to eager steps
# and to torchsde come from benchmarks/bench_rollout.py):
#
# - Unrolling 4 or 5 steps into one graph takes 3 to 4 times as long to compile and gains nothing: one step.
# - Calls between the kernels in C++ (cpp_wrapper) gain 10 to 20 % at 512 rows and a third at 32.
# - `rollout` keeps states column by column in memory, and nsde_torch.columns keeps what is computed from them
#   so: the loops are then vectorised, forward and backward. Slices z[:, a:b] do the same forward; their
#   gradients are padded with zeros and added. Merging two small networks into one gains 5 %.
# - 2 sigmoid(2 x) - 1 for tanh(x) takes a third of the time.
# - One code for every batch size runs as fast and takes nearly twice as long to compile (loops get a tail). It
#   is worth it without gradients, where batches vary; training has one size, and a second compiles anew.
# - The more rows, the more the matrix products decide, which are the same compiled or not: a rollout gains a
#   factor of four at 32 rows, 2.5 at 512 and 1.5 at 4096.
# - What costs: a graph break (print, .item(), a data-dependent branch), Python containers that change between
#   calls, and toggling requires_grad or train()/eval(), each of which compiles anew.
#
# torch keeps the code on disk (TORCHINDUCTOR_CACHE_DIR, by default in the temporary folder), so that a second
# process only traces. The number of threads at the time of compilation is part of the code: set it before.

Advance = Callable[[SDE, Time, Tensor, Tensor, Time, Tensor | None], Tensor]

_COMPILED: WeakKeyDictionary[SDE, dict[type[Step], Advance]] = WeakKeyDictionary()
_OF_ARCHITECTURE: dict[str, dict[type[Step], Advance]] = {}
_COUNTER = itertools.count()


class CompilationWarning(UserWarning):
    """A step could not be compiled and runs eagerly: same numbers, several times slower."""


@contextlib.contextmanager
def quiet_compiler() -> Iterator[None]:
    """Keep back what torch's compiler says of itself: it uses TorchScript, and reads `.grad` as it traces."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"`torch\.jit\.", DeprecationWarning)
        warnings.filterwarnings("ignore", r"The \.grad attribute of a Tensor that is not a leaf", UserWarning)
        yield


def eager(step: Step) -> Advance:
    """One step and its projection, as the step defines them: (sde, t, z, u, dt, dw) -> next state (N, nz)."""

    def advance(sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        return sde.project(step.advance(sde, t, z, u, dt, dw))

    return advance


def compiled(step: Step, sde: SDE) -> Advance:
    """One step and its projection, compiled at the first call with gradients and the first without; see `eager`.

    Code without gradients serves every batch size above one; code with gradients serves the first, and from the second
    on every size. Modules of the same architecture share it; that of another equation is kept as long as the equation
    lives. Where no code can be made (there is no C++ compiler, say) one CompilationWarning says why, and the steps run
    eagerly.

    Raises:
        SolverError: `sde` cannot be held weakly or hashed by identity, as every torch.nn.Module is.
    """
    try:
        if sde not in _COMPILED:
            # Modules of one architecture share code: weights are its arguments, and torch guards all else.
            module = isinstance(sde, torch.nn.Module)
            _COMPILED[sde] = _OF_ARCHITECTURE.setdefault(str(sde), {}) if module else {}
        steps = _COMPILED[sde]
    except TypeError as error:
        raise SolverError(
            f"`sde` of type {type(sde).__name__} must be hashable by identity to be compiled ({error}). "
            "Make it a torch.nn.Module, or a class without __eq__ and __slots__."
        ) from None
    if type(step) not in steps:
        steps[type(step)] = _with_fallback(eager(step))
    return steps[type(step)]


def _with_fallback(plain: Advance) -> Advance:
    with quiet_compiler():
        # On the CPU the calls between kernels cost as much as a small batch's kernels: put them in C++ too.
        fast = {
            cpu: torch.compile(_own_code(plain), options={"cpp_wrapper": True} if cpu else None)
            for cpu in (True, False)
        }
    works = True

    def advance(sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        nonlocal works
        if works:
            try:
                if not torch.is_grad_enabled():
                    for table in (z, u) if dw is None else (z, u, dw):
                        torch._dynamo.maybe_mark_dynamic(table, 0)
                return fast[z.device.type == "cpu"](sde, t, z, u, dt, dw)
            except Exception as error:
                result = plain(sde, t, z, u, dt, dw)  # a fault of the equation itself is raised again here
                works = False
                reason = str(error).strip().splitlines() or [""]
                warnings.warn(
                    f"the step runs without compilation, several times slower: {type(error).__name__}: {reason[0]} "
                    "Install a C++ compiler (g++ or clang++; CXX names it), or turn compilation off.",
                    CompilationWarning,
                    stacklevel=3,
                )
                return result
        return plain(sde, t, z, u, dt, dw)

    return advance


def _own_code(function: Advance) -> Advance:
    # torch.compile keeps its results, and counts them against a limit, by code object: closures of one
    # function would share both, and the ninth model of a process would run eagerly.
    assert isinstance(function, types.FunctionType)
    code = function.__code__.replace(co_name=f"{function.__name__}_{next(_COUNTER)}")
    return types.FunctionType(code, function.__globals__, code.co_name, None, function.__closure__)
