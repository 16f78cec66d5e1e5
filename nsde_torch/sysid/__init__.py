"""Least-squares identification of declared physics in weak form (see `identify`)."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.sysid.in_loop import identify_in_loop
    from nsde_torch.sysid.loop_test import LoopTest, feedback_summary
    from nsde_torch.sysid.result import Identification

__all__ = [
    "Identification",
    "LoopTest",
    "feedback_summary",
    "identify_in_loop",
]

__getattr__ = resolver(
    __name__,
    {
        "Identification": "result",
        "LoopTest": "loop_test",
        "feedback_summary": "loop_test",
        "identify_in_loop": "in_loop",
    },
)
