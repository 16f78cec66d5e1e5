"""What a solver asks of an equation: dz = f(t, z, u) dt + g(t, z, u) * dW with diagonal noise.

`z` is the state with whatever memory the effects carry, `u` is held over a step, `W` has one independent
Wiener process per channel of `z`, and `*` is the product of Ito or of Stratonovich (Kloeden and Platen,
Numerical Solution of Stochastic Differential Equations, 1992, sections 3.3 and 4.9). The paper writes a star
and leaves the choice open: such an equation declares `calculus = "either"`, and the step that integrates it
gives the product its meaning.

A one-step method makes z(t + dt) from z(t), the held input and one Brownian increment. It has strong order p if
E|z_K - z(t_K)| <= C dt^p on one Brownian path (Kloeden and Platen 1992, section 9.6).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal, Protocol, cast, final, runtime_checkable

import torch
from torch import Tensor

from nsde_torch.errors import SolverError
from nsde_torch.systems import System

Calculus = Literal["ito", "stratonovich", "either"]
CALCULI: tuple[Calculus, ...] = ("ito", "stratonovich", "either")
Time = float | Tensor
"""Time [s]: one number or a 0-d tensor for all rows, or a tensor (N,) with one time for each row."""


class SDE(Protocol):
    """A controlled equation with diagonal noise, evaluated on rows: N is particles times batch.

    Each method must treat its rows independently and must not change its inputs; neither is checked.
    """

    @property
    def calculus(self) -> Calculus:
        """The product of g and dW: "ito", "stratonovich", or "either" (the step decides)."""

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        """Rate f of the state, (N, nz), in units of z per second."""

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        """Standard deviation density g of each channel, (N, nz), in units of z per root second."""

    def project(self, z: Tensor) -> Tensor:
        """The nearest valid state (N, nz), for example with a unit quaternion."""


@runtime_checkable
class HoldsColumns(Protocol):
    """An equation whose drift, in some columns, is known as the mean over a whole step and not at an instant.

    Lags of inputs that are held over a step are such: they have a closed form. Before a rollout the equation is given
    the step; a step that evaluates the drift more than once then asks at which state (see `within`).
    """

    def set_step(self, dt: float) -> None:
        """Take the length of the steps that follow [s]."""

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        """The state `y` within a step from `z`, both (N, nz), with those columns as they are in `z`."""


def within(sde: SDE, z: Tensor, y: Tensor) -> Tensor:
    """Where to evaluate the drift for a stage at `y` of a step that began at `z`, both (N, nz)."""
    # first of the class, whose answer Python keeps: of an object, a protocol looks at every member each time
    holds = issubclass(type(sde), HoldsColumns) or isinstance(sde, HoldsColumns)
    return cast(HoldsColumns, sde).inner(z, y) if holds else y


@runtime_checkable
class HasDiagonalDerivative(Protocol):
    """An equation that knows the slopes of its own diffusion."""

    def diffusion_diagonal_derivative(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        """The slopes d g_i / d z_i, (N, nz), in 1 per square root of a second."""


@final
class WithoutNoise:
    """Rates of a system's states under whatever else acts on it, as a step wants them."""

    calculus: Calculus = "either"

    def __init__(self, system: System, drift: Callable[[Time, Tensor, Tensor], Tensor]) -> None:
        self.system, self.drift = system, drift
        self.project, self.set_step, self.inner = system.project, system.set_step, system.inner

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(z)


class Step(ABC):
    """A one-step method. Subclasses are final, hold nothing but settings, and state calculus and order.

    The calculus is the limit as dt goes to 0, "none" for a method of ordinary equations.
    """

    name: ClassVar[str]  # key in `STEPS`, or what messages call the user's own
    calculus: ClassVar[Literal["ito", "stratonovich", "none"]]
    strong_order: ClassVar[float]  # on one Brownian path, classical if deterministic; not checked
    deterministic: ClassVar[bool] = False  # whether it reads no noise, that is, solves for g = 0
    compilable: ClassVar[bool] = True  # False if it must run eagerly

    @abstractmethod
    def advance(self, sde: SDE, t: Time, z: Tensor, u: Tensor, dt: Time, dw: Tensor | None) -> Tensor:
        """Advance the rows by one step. Nothing is checked or projected here; `rollout` does both.

        Args:
            sde: The equation.
            t: Time at the start of the step [s], a number, 0-d, or (N,).
            z: State (N, nz).
            u: Input held over the step (N, nu).
            dt: Length of the step [s], > 0, a number or 0-d.
            dw: Brownian increment (N, nz) with variance dt [s]; None for a deterministic step.

        Returns:
            State at t + dt, (N, nz).
        """

    def check(self, sde: SDE) -> None:
        """Refuse an equation whose calculus is not the one that this step converges to.

        Raises:
            SolverError: `sde.calculus` is unknown, or contradicts `self.calculus`.
        """
        calculus = sde.calculus
        if calculus not in CALCULI:
            raise SolverError(f"`sde.calculus` must be one of {', '.join(CALCULI)}; got {calculus!r}.")
        if self.deterministic or calculus in ("either", self.calculus):
            return
        raise SolverError(
            f"`step` {self.name!r} solves in the {self.calculus} sense, but `sde.calculus` is {calculus!r}. "
            "Take a step of that calculus, or rewrite the equation with with_calculus()."
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"
