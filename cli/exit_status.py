"""Exit statuses of every command."""

from typing import final

from nsde_torch.errors import NsdeError

OK = 0
FAILED_JOBS = 1  # a sweep ran to its end, but some of its jobs did not
USER_ERROR = 2  # a fault of the user's input; one message, no traceback
FLIGHT_ENDED = 3  # a flight began, went wrong, and ended on the ground
NOT_LANDED = 4  # a flight was not seen to land: go and look
CRASHED = 70  # a fault of ours (EX_SOFTWARE); the traceback is shown
INTERRUPTED = 130  # Ctrl-C (128 + SIGINT)


@final
class EndedError(NsdeError):
    """A command did its work, and what it did ended otherwise than it was asked for, as `status` says."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status
