"""What jobs of one sweep have in common, worked out once: the data, and what a fit finds before any seed matters.

Nothing is kept unless a launcher asks for it (`remembering`). What is recalled is a copy: who changes it changes no
other job.
"""

import copy
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

_KNOWN: dict[Hashable, object] | None = None


@contextmanager
def remembering() -> Iterator[None]:
    """Keep in memory what `recall` makes, for the time of a `with` block."""
    global _KNOWN
    _KNOWN = {}
    try:
        yield
    finally:
        _KNOWN = None


def recall(key: Hashable, make: Callable[[], T]) -> T:
    """What `make` returns, or a copy of what it returned under the same key.

    Args:
        key: All that the result depends on.
        make: Works it out; its errors are not kept.
    """
    if _KNOWN is None:
        return make()
    if key not in _KNOWN:
        _KNOWN[key] = make()
    return copy.deepcopy(_KNOWN[key])  # type: ignore[return-value]
