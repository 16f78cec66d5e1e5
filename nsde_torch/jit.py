"""Loops over rows, compiled: called one by one from Python, they take ten to a hundred times as long.

Numba keeps the machine code beside the source, or in the user's cache where that cannot be written.
"""

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit
from numba.core import event

from nsde_torch.progress import WHEN_COMPILING

Function = TypeVar("Function", bound=Callable[..., object])


class _Compiling(event.Listener):
    """Tells those who wait (`WHEN_COMPILING`): a first diagnosis said nothing for 40 s while it read its log."""

    def on_start(self, event: object) -> None:
        while WHEN_COMPILING:
            WHEN_COMPILING.pop()()

    def on_end(self, event: object) -> None:
        """Nothing more is to be told."""


event.register("numba:compile", _Compiling())


def compiled(function: Function) -> Function:
    """A function of NumPy arrays and numbers, compiled when it is first called.

    A division by 0 gives what NumPy gives.

    Args:
        function: The function; what it calls is compiled too.
    """

    def made(cache: bool) -> Function:
        return cast(
            Function,
            njit(cache=cache, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})(function),
        )

    try:
        return made(cache=True)
    except RuntimeError:  # neither the folder of the source nor the user's cache can be written
        return made(cache=False)
