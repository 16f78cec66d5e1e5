"""Recording: from logged files to checked runs, and the faults of what recorded them.

Each fault is put into simulated runs, found in data, and undone in them; see `Fault`.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.recording.checks import assemble
    from nsde_torch.recording.faults.fault import Fault
    from nsde_torch.recording.faults.registry import FAULTS
    from nsde_torch.recording.log import Detected, LoggedRuns, Recorded, Suspect
    from nsde_torch.recording.options import RecordingOptions, RemedyOptions
    from nsde_torch.recording.reading import read
    from nsde_torch.recording.simulated import Recording

__all__ = [
    "FAULTS",
    "Detected",
    "Fault",
    "LoggedRuns",
    "Recorded",
    "Recording",
    "RecordingOptions",
    "RemedyOptions",
    "Suspect",
    "assemble",
    "read",
]

__getattr__ = resolver(
    __name__,
    {
        "FAULTS": "faults.registry",
        "Detected": "log",
        "Fault": "faults.fault",
        "LoggedRuns": "log",
        "Recorded": "log",
        "Recording": "simulated",
        "RecordingOptions": "options",
        "RemedyOptions": "options",
        "Suspect": "log",
        "assemble": "checks",
        "read": "reading",
    },
)
