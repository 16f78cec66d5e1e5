"""Recording: from logged files to checked runs, and the faults of the recording chain.

Each fault is put into simulated runs, found in data, and undone in them; see `Fault`.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.recording.chain import Recorded, Recording
    from nsde_torch.recording.fault import Detected, Fault, LoggedRuns
    from nsde_torch.recording.faults import FAULTS, RecordingOptions, RemedyOptions
    from nsde_torch.recording.reading import assemble, read

__all__ = [
    "FAULTS",
    "Detected",
    "Fault",
    "LoggedRuns",
    "Recorded",
    "Recording",
    "RecordingOptions",
    "RemedyOptions",
    "assemble",
    "read",
]

__getattr__ = resolver(__name__)
