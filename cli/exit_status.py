"""Exit statuses of every command."""

OK = 0
FAILED_JOBS = 1  # a sweep ran to its end, but some of its jobs did not
USER_ERROR = 2  # a fault of the user's input; one message, no traceback
CRASHED = 70  # a fault of ours (EX_SOFTWARE); the traceback is shown
INTERRUPTED = 130  # Ctrl-C (128 + SIGINT)
