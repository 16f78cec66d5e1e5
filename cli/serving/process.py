"""A command of `nsde` as a process that can be stopped: what it says, how far it is, how it ended."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from nsde_torch.progress import PROGRESS

from ..exit_status import FAILED_JOBS, USER_ERROR
from .job import ServeLimits

Say = Callable[..., None]
"""Takes stage, number done, number in all, and what was found so far, in a few words."""
_LINE = 1 << 16  # bytes of a line that are read at a time
_LOG = 4 << 20  # bytes of a log that are kept
_TAIL = 200  # lines that the sentence of an error is looked for in
_NO_MEMORY = ("memoryerror", "can't allocate memory", "cannot allocate memory", "std::bad_alloc")


@dataclass(frozen=True)
class EndOfProcess:
    """How a command ended."""

    status: int  # exit status; negative: killed by that signal
    stopped: str  # why it was stopped: `cancelled`, `time`, or empty
    sentence: str  # what went wrong; empty where nothing did


@dataclass(eq=False)
class CommandProcess:
    """One command in a process of its own."""

    words: Sequence[str]  # the command, without `nsde`
    _: KW_ONLY
    folder: Path  # where it runs
    log: Path  # file for what it prints
    limits: ServeLimits  # of its time and memory
    say: Say  # takes stage, number done, number in all, and what was found so far

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = ""

    def run(self) -> EndOfProcess:
        """Run it to its end, which `stop` may bring earlier."""
        limits = self.limits
        worker = [sys.executable, "-m", "nsde_torch.cli.serving.worker"]
        bounds = [str(limits.memory), str(limits.seconds), str(os.getpid())]
        with self._lock:
            if self._stopped:
                return self._ended(-signal.SIGKILL, [])
            process = self._process = subprocess.Popen(
                [*worker, *bounds, *self.words],
                cwd=self.folder,
                env={**os.environ, PROGRESS: "json", "MPLBACKEND": "Agg", "PYTHONUNBUFFERED": "1"},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        timer = threading.Timer(limits.seconds, self.stop, ["time"])
        timer.daemon = True
        timer.start()
        try:
            tail = self._listen(process)
            status = process.wait()
        except BaseException:  # a full disk: what cannot be logged does not go on unseen
            self.stop()
            process.wait()
            raise
        finally:
            timer.cancel()
        return self._ended(status, tail)

    def stop(self, why: str = "cancelled") -> None:
        """Kill it, with all that it started."""
        with self._lock, contextlib.suppress(ProcessLookupError):
            if self._process is not None and self._process.poll() is not None:
                return
            self._stopped = self._stopped or why
            if self._process is not None:
                os.killpg(self._process.pid, signal.SIGKILL)

    def _listen(self, process: subprocess.Popen[bytes]) -> list[str]:
        """Read what it prints until it ends; progress is reported, the rest goes to the log."""
        assert process.stdout is not None
        tail: deque[str] = deque(maxlen=_TAIL)
        kept = 0
        with process.stdout, self.log.open("ab") as log:
            while raw := process.stdout.readline(_LINE):
                text = raw.decode("utf-8", errors="replace")
                if _told(text, self.say):
                    continue
                tail.append(text.rstrip())
                kept += len(raw)
                if kept <= _LOG:
                    log.write(raw)
                    log.flush()
        return list(tail)

    def _ended(self, status: int, tail: Sequence[str]) -> EndOfProcess:
        sentence = why_ended(self.words[0], status, tail, stopped=self._stopped, limits=self.limits)
        return EndOfProcess(status, self._stopped, sentence)


def why_ended(name: str, status: int, tail: Sequence[str], *, stopped: str, limits: ServeLimits) -> str:
    """What went wrong with a command, one sentence; empty where nothing did. A negative status is a signal."""
    if stopped == "time" or status == -signal.SIGXCPU:
        return (
            f"It took longer than {limits.seconds / 60:g} min and was stopped: drop less, or serve with a larger "
            "`time`."
        )
    if stopped:
        return "It was stopped."
    if status == 0:
        return ""
    if any(sign in line.lower() for line in tail for sign in _NO_MEMORY):
        return (
            f"It needs more memory than the {limits.memory / 2**30:g} GiB that it may have: drop less, or serve with "
            "a larger `memory`."
        )
    if status == FAILED_JOBS and not any(line.startswith("Traceback") for line in tail):
        return ""  # done, with a result that is none: a check failed
    said = _said(tail, name) if status == USER_ERROR else ""
    return said or f"It ended by a fault of the program (exit status {status}), not of the log: see log.txt."


def _told(line: str, say: Say) -> bool:
    """Whether a line is progress, which is reported."""
    if not line.startswith('{"stage"'):
        return False
    try:
        step = json.loads(line)
        say(str(step["stage"]), int(step["done"]), int(step["total"]), str(step.get("found", "")))
    except (ValueError, KeyError, TypeError):
        return False
    return True


def _said(tail: Sequence[str], name: str) -> str:
    """The message of a fault of the user's input: from `nsde NAME: ` to the end."""
    starts = [k for k, line in enumerate(tail) if line.startswith(f"nsde {name}: ")]
    text = " ".join(tail[starts[-1] :]).removeprefix(f"nsde {name}: ") if starts else ""
    return re.sub(r"\s+", " ", text).strip()
