"""The process of one job: limits on itself first, then the command of `nsde` that its words say.

`python -m nsde_torch.cli.serving.worker MEMORY SECONDS PARENT WORD...`. It ends when its parent does.
"""

import ctypes
import os
import resource
import signal
import sys

_LARGEST_FILE = 2 << 30  # bytes that one file of a result may have
_SET_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG
_SPARE = 60.0  # seconds of computing beyond the time limit, which the parent holds


def limit(memory: int, seconds: float) -> None:
    """Bound memory, computing time and files of this process and its children."""
    wanted = {
        resource.RLIMIT_DATA: memory,
        resource.RLIMIT_CPU: int(seconds + _SPARE),
        resource.RLIMIT_FSIZE: _LARGEST_FILE,
        resource.RLIMIT_CORE: 0,
    }
    for kind, most in wanted.items():
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


def main() -> None:
    memory, seconds, parent, *words = sys.argv[1:]
    ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGKILL)  # when the parent ends, however it ends
    if os.getppid() != int(parent):
        sys.exit(1)
    limit(int(memory), float(seconds))
    from ..main import entry

    sys.argv = ["nsde", *words]
    entry()


if __name__ == "__main__":
    main()
