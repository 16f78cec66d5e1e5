"""Loops over rows, compiled: called one by one from Python, they take ten to a hundred times as long.

Numba keeps the machine code beside the source, or in the user's cache where that cannot be written.
"""

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., object])


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
