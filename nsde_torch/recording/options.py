"""Options of the recording chain, made of what each fault says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import make_dataclass
from typing import Any

from nsde_torch.options import documented
from nsde_torch.recording.faults.registry import FAULTS, remedies


def _options(name: str, doc: str, fields: Mapping[str, tuple[Any, Any]]) -> type[Any]:
    made = make_dataclass(name, [(key, hint, value) for key, (hint, value) in fields.items()], frozen=True)
    made.__doc__, made.__module__ = doc, __name__
    return documented(made)


def recording_options() -> type[Any]:
    """A dataclass with an option for each fault that there is now."""
    return _options(
        "RecordingOptions",
        "Faults of a recording chain; the default has none.",
        {name: (fault.annotation, fault.option) for name, fault in FAULTS.items()},
    )


RecordingOptions = recording_options()
"""Sizes of the faults of a simulated recording, by name; the keys `recording.NAME` of `nsde simulate`."""
RemedyOptions = _options(
    "RemedyOptions",
    "What a reader takes out of a log.",
    {name: (dict[str, float], fault.remedy) for name, fault in remedies().items()},
)
"""What a reader takes out, by name of the fault and of the states; the keys `data.NAME` of the commands."""
