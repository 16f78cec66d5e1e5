"""The face of every one-step method: z(t + dt) from z(t), the held input and one Brownian increment.

A method has strong order p if E|z_K - z(t_K)| <= C dt^p on one Brownian path (Kloeden and Platen 1992,
section 9.6).
"""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal

from torch import Tensor

from nsde_torch.errors import SolverError
from nsde_torch.sde.protocol import CALCULI, SDE, Time


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
