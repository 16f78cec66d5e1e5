"""The one error of the page: what was asked for is not done, in one sentence."""

from __future__ import annotations

from typing import final

from nsde_torch.errors import NsdeError


@final
class RefusedError(NsdeError):
    """A request that is refused.

    Args:
        message: One sentence with the remedy.
        status: Status of HTTP.
    """

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status
