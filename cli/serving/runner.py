"""What is done with the logs of a job: looked into, then diagnosed, each by a command in a process of its own."""

import shlex
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

from .job import Machines, RefusedError, ServedJob, ServeLimits, Shelf
from .process import CommandProcess, EndOfProcess, Say
from .summary import RESULT, save_summary

INSPECTION, LOG, MAPPING = "inspection.json", "log.txt", "mapping.yaml"
_LONGEST_MAPPING = 1 << 16  # letters
_LOOK = 300.0  # seconds that looking into logs may take at most


@dataclass(eq=False)
class JobRunner:
    """Takes jobs one after another: one is looked into at a time, `limits.jobs` are diagnosed at a time."""

    shelf: Shelf  # the jobs
    machines: Machines  # that are offered
    make: Callable[..., CommandProcess] = CommandProcess  # makes the process of a command

    def __post_init__(self) -> None:
        self._work: dict[str, CommandProcess] = {}
        self._began: dict[str, float] = {}
        self._closed, self.limits = False, self.shelf.limits
        self._looks, self._diagnoses = ThreadPoolExecutor(1), ThreadPoolExecutor(self.limits.jobs)

    def inspect(self, job: ServedJob, *, system: str | None, mapping: str | None) -> None:
        """Look into the logs of a job, for a machine and with a mapping or without (None: guessed, and proposed)."""
        if system is not None and system not in self.machines.names:
            raise RefusedError(
                f"There is no system {system!r}: choose one of {', '.join(self.machines.names)}."
            )
        if mapping is not None and len(mapping) > _LONGEST_MAPPING:
            raise RefusedError(f"The mapping is longer than {_LONGEST_MAPPING} letters.", 413)
        with self.shelf.lock:
            if not all(file.there for file in job.files):
                raise RefusedError("Not all logs have arrived: drop them again.", 409)
            if job.state not in ("uploading", "ready", "refused", "failed", "cancelled"):
                raise RefusedError("It is at work, or done: drop the logs again for another look.", 409)
            folder = self.shelf.of(job)
            for name in (INSPECTION, MAPPING):
                (folder / name).unlink(missing_ok=True)
            if mapping is not None:
                (folder / MAPPING).write_text(mapping, encoding="utf-8")
            self.shelf.note(
                job, state="looking", sentence="", system=system, mapped=mapping is not None, stages=[]
            )
        self._looks.submit(self._serve, job, self._look)

    def diagnose(self, job: ServedJob) -> None:
        """Diagnose a job that was looked into, when its turn comes; RefusedError where that is not possible."""
        with self.shelf.lock:
            found = self.shelf.read(job, INSPECTION)
            if job.state not in ("ready", "failed", "cancelled") or found is None or not found["usable"]:
                raise RefusedError("These logs cannot be diagnosed as they are.", 409)
            shutil.rmtree(self.shelf.of(job) / RESULT, ignore_errors=True)
            self.shelf.note(job, state="waiting", sentence="", stages=[], seconds=0.0)
        self._diagnoses.submit(self._serve, job, self._diagnose)

    def cancel(self, job: ServedJob) -> None:
        """Stop a job that is at work or waits; its logs stay."""
        with self.shelf.lock:
            work, left = self._work.get(job.id), {"waiting": "cancelled", "looking": "refused"}
            if work is None and job.state in left:
                self.shelf.note(job, state=left[job.state], sentence="It was stopped before it began.")
        if work is not None:
            work.stop()

    def elapsed(self, job: ServedJob) -> float:
        """Seconds since the work on a job began, or how long it took."""
        began = self._began.get(job.id)
        return job.seconds if began is None else time.monotonic() - began

    def close(self) -> None:
        with self.shelf.lock:
            self._closed = True
            work = list(self._work.values())
        for one in work:
            one.stop("closed")
        for pool in (self._looks, self._diagnoses):
            pool.shutdown(cancel_futures=True)

    def _serve(self, job: ServedJob, work: Callable[[ServedJob], dict[str, Any]]) -> None:
        if self._closed or job.state not in ("looking", "waiting"):  # stopped while it waited
            return
        self._began[job.id] = time.monotonic()
        try:
            changed = work(job)
        except Exception as error:  # the page goes on
            sentence = f"A fault of the page: {type(error).__name__}: {error}."
            changed = {"state": "failed", "sentence": sentence}
        began = self._began.pop(job.id)
        if not self._closed:  # else it is taken up by the next start
            self.shelf.note(job, seconds=round(time.monotonic() - began, 1), **changed)

    def _run(self, job: ServedJob, words: list[str], limits: ServeLimits, say: Say) -> EndOfProcess:
        folder = self.shelf.of(job)
        work = self.make(
            words, folder=self.machines.folder or folder, log=folder / LOG, limits=limits, say=say
        )
        with self.shelf.lock:
            self._work[job.id] = work
            if self._closed:
                work.stop("closed")
        try:
            return work.run()
        finally:
            with self.shelf.lock:
                del self._work[job.id]

    def _look(self, job: ServedJob) -> dict[str, Any]:
        folder = self.shelf.of(job)
        given = folder / MAPPING if job.mapped else None
        out = folder / INSPECTION
        words = self.machines.inspect_words(folder / "logs", system=job.system, mapping=given, out=out)
        limits = replace(self.limits, seconds=min(_LOOK, self.limits.seconds))
        end = self._run(job, words, limits, lambda *step: None)
        found = self.shelf.read(job, INSPECTION)
        if end.sentence or found is None:
            why = end.sentence or "The logs could not be looked into by a fault of the program: see log.txt."
            return {"state": "refused", "sentence": self._plain(why, job)}
        system = job.system or found["system"]
        self.shelf.note(job, machine=system)
        if found["mapping"] and not job.mapped:
            (folder / MAPPING).write_text(found["mapping"], encoding="utf-8")
        if not found["usable"] or system not in self.machines.names:
            return {"state": "refused", "sentence": self._plain(_why_not(found), job)}
        return {"state": "ready", "repeat": shlex.join(["nsde", *self._words(job)])}

    def _words(self, job: ServedJob) -> list[str]:
        folder, most = self.shelf.of(job), self.limits.max_minutes
        mapping = folder / MAPPING if (folder / MAPPING).is_file() else None
        how: dict[str, Any] = {"system": job.machine, "mapping": mapping, "max_minutes": most}
        return self.machines.diagnose_words(folder / "logs", **how)

    def _diagnose(self, job: ServedJob) -> dict[str, Any]:
        folder = self.shelf.of(job)
        began = time.monotonic()
        stages: list[dict[str, Any]] = [
            {"stage": "reading the logs", "done": 0, "total": 1, "began": 0.0, "found": ""}
        ]

        def say(stage: str, done: int, total: int, found: str = "") -> None:
            now = round(time.monotonic() - began, 1)
            with self.shelf.lock:
                if stages[-1]["stage"] != stage:
                    stages.append({"stage": stage, "began": now})
                stages[-1].update(done=done, total=total, found=found)

        words = self._words(job)
        self.shelf.note(job, state="running", stages=stages, repeat=shlex.join(["nsde", *words]))
        end = self._run(job, [*words, f"out_dir={folder / RESULT}"], self.limits, say)
        if end.stopped == "cancelled":
            return {"state": "cancelled", "sentence": end.sentence}
        content = self.shelf.read(job, f"{RESULT}/diagnosis.json")
        if end.status != 0 or content is None:
            return {"state": "failed", "sentence": self._plain(end.sentence, job)}
        save_summary(folder, content)
        return {"state": "done"}

    def _plain(self, sentence: str, job: ServedJob) -> str:
        """A sentence of a command without the folders of the page."""
        logs = self.shelf.of(job) / "logs"
        for folder in (f"{logs}/", f"{self.shelf.of(job)}/"):
            sentence = sentence.replace(folder, "")
        return sentence.replace(str(logs), "the logs")


def _why_not(found: dict[str, Any]) -> str:
    """The first reason why logs cannot be read as they are, one sentence."""
    failed = [check for check in found["checks"] if check["passed"] is False]
    if failed:
        return f"The mapping contradicts the data: {failed[0]['text']}"
    if found["missing"]:
        return f"Something is missing: {found['missing'][0]}"
    return "Too little was recognised in these logs to make a mapping of it."
