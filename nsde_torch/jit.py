"""Loops over rows, compiled: called one by one from Python, they take ten to a hundred times as long.

Numba keeps the machine code beside the source, or in the user's cache where that cannot be written.
"""

from numba import njit

compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
"""Decorator of functions of NumPy arrays and numbers; a division by 0 gives what NumPy gives."""
