"""Recording: from logged files to checked runs, and the faults of what recorded them.

Each fault is found in data, undone in them, and put into simulated ones.
"""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.recording.checks import assemble
    from nsde_torch.recording.options import RecordingOptions
    from nsde_torch.recording.readers import READERS, read
    from nsde_torch.recording.simulated import Recording
    from nsde_torch.recording.undo import Fault, Recorded

__all__ = [
    "READERS",
    "Fault",
    "Recorded",
    "Recording",
    "RecordingOptions",
    "assemble",
    "read",
]

__getattr__ = resolver(
    __name__,
    {
        "READERS": "readers",
        "Fault": "undo",
        "Recorded": "undo",
        "Recording": "simulated",
        "RecordingOptions": "options",
        "assemble": "checks",
        "read": "readers",
    },
)
