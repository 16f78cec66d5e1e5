"""What a check found, and what was done about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Finding:
    """One kind of fault in one run (or in the whole data set).

    Args:
        kind: Short name of the fault, such as `time_gap` or `sign_flip`.
        run: Name of the run; empty for the whole data set.
        count: How often it occurs.
        message: What was found, with numbers and units.
        action: What was done: `split`, `resampled`, `interpolated`, `dropped`, `sorted`, `normalised`,
            `unwrapped`, `rescaled`, `reported`.
        values: The numbers by name (units in the names).
    """

    kind: str
    run: str
    count: int
    message: str
    action: str
    values: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain containers, for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        place = f"{self.run}: " if self.run else ""
        return f"{place}{self.message} -> {self.action}"


Report = Callable[[Finding], None]
"""Takes what a check found."""
