"""One thread for what consists of many small products.

Two BLAS threads wait for each other at every one of them: a diagnosis of four runs of a spring takes 10 s of processor
time with one and 56 s with two (two cores, one of them busy). The command line sets this before numpy is loaded; a
Python process has loaded it already, and has other things to do with its threads afterwards.

Loops that are compiled and long share the caller's threads all the same (`allowed_threads`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from threadpoolctl import threadpool_limits

_allowed: ContextVar[int | None] = ContextVar("allowed", default=None)


def allowed_threads() -> int:
    """How many threads the caller allows: those that torch had before `one_thread`, or has."""
    return _allowed.get() or torch.get_num_threads()


@contextmanager
def one_thread(*, of_torch: bool = True) -> Iterator[None]:
    """Give numpy's BLAS one thread inside the block (or the decorated function), and what it had after it.

    Args:
        of_torch: Whether torch gets one, too; False leaves it what the caller has set, where batches are large.
    """
    before = torch.get_num_threads()
    token = _allowed.set(allowed_threads())
    if of_torch:
        torch.set_num_threads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        _allowed.reset(token)
        torch.set_num_threads(before)
