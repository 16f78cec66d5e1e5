"""Least-squares identification of declared physics in weak form (see `identify`)."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.sysid.feedback_test import FeedbackTest, feedback_summary
    from nsde_torch.sysid.identify import identify_in_loop
    from nsde_torch.sysid.result import Identification

__all__ = ["FeedbackTest", "Identification", "feedback_summary", "identify_in_loop"]

__getattr__ = resolver(__name__)
