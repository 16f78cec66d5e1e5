"""The jobs of the page: limits, files, state, the commands behind them, and a folder for each that is kept:

OUT_DIR/ID/job.json             what is known of it
OUT_DIR/ID/logs/                the logs as they were dropped, under names of our own
OUT_DIR/ID/mapping.yaml         what their columns mean
OUT_DIR/ID/inspection.json      what `nsde inspect` found
OUT_DIR/ID/result/              what `nsde diagnose` wrote
OUT_DIR/ID/log.txt              what the commands printed
"""

import json
import re
import secrets
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, final

from nsde_torch.data.readers import READERS
from nsde_torch.errors import ConfigError, NsdeError
from nsde_torch.whole_files import write_whole


@final
class RefusedError(NsdeError):
    """A request that is refused: one sentence with the remedy, and the status of HTTP."""

    def __init__(self, message: str, status: int = 400) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class ServeLimits:
    upload: int = 512 << 20  # largest upload of one job, all its logs together [bytes]
    max_minutes: float = 10.0  # time after which a diagnosis ends with what is known [min]
    seconds: float = 3600.0  # time after which a command is killed [s]
    memory: int = 8 << 30  # largest memory of one job [bytes]
    jobs: int = 1  # diagnoses at a time; further ones wait
    keep: int = 50  # most jobs that are kept
    files: int = 200  # most logs of one job


RECORD = "job.json"
STATES = {
    "uploading": "logs are being sent",
    "looking": "being looked into",
    "ready": "can be diagnosed",
    "refused": "cannot be diagnosed as it is",
    "waiting": "waits for its turn",
    "running": "being diagnosed",
    "done": "diagnosed",
    "failed": "not diagnosed",
    "cancelled": "stopped",
}
"""What a job can be, and what the page calls it."""
AT_WORK = ("looking", "waiting", "running")


@dataclass
class UploadedFile:
    """One log."""

    given: str  # its name as the browser said it
    name: str  # its name here
    size: int  # bytes that were announced
    there: bool = False  # whether it arrived


@dataclass
class ServedJob:
    """What is known of a job."""

    id: str  # its name and that of its folder; whoever knows it may see the results
    created: str  # when, ISO 8601
    system: str | None  # machine that was chosen; None: to be guessed
    files: list[UploadedFile]
    machine: str = ""  # what it is taken for
    state: str = "uploading"  # key of `STATES`
    sentence: str = ""  # why it is refused or failed; empty where it is not
    mapped: bool = False  # whether the user gave the mapping
    stages: list[dict[str, Any]] = field(default_factory=list)
    """What the diagnosis did: stage, number done and in all, second at which it began, and what was found so far."""
    seconds: float = 0.0  # how long the diagnosis took or has taken
    repeat: str = ""  # the command that repeats the diagnosis


def load(folder: Path) -> ServedJob | None:
    """The job of a folder; None where there is none that can be read."""
    try:
        content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        files = [UploadedFile(**one) for one in content.pop("files")]
        job = ServedJob(**content, files=files)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    return job if job.id == folder.name and job.state in STATES else None


@dataclass(frozen=True)
class Machines:
    """The machines that the page offers."""

    # choice of the group `system` -> name of the system, of the package or `module:Class`
    names: Mapping[str, str]
    folder: Path | None = None  # folder of the user's own choices (`--config-dir`), or None
    first: str | None = None  # the one that is chosen at first; None: chosen by what is logged
    typed: Sequence[str] = ()  # what was typed of it, `system.effects=[linear_drag]`

    def inspect_words(self, logs: Path, *, system: str | None, mapping: Path | None, out: Path) -> list[str]:
        """The words that look into logs of a system; None: guessed."""
        words = ["inspect", str(logs), "out=none", f"json={out}"]
        words += [f"system={self.names[system]}"] if system else []
        return [*words, f"mapping={mapping}"] if mapping else words

    def diagnose_words(
        self, logs: Path, *, system: str, mapping: Path | None, max_minutes: float
    ) -> list[str]:
        """The words that diagnose logs, wherever they are typed; without a mapping where the reader needs none."""
        folder = [] if self.folder is None else ["--config-dir", str(self.folder)]
        own = self.typed if system == self.first else ()
        words = ["diagnose", *folder, f"system={system}", *own, "data=log", f"data.path={logs}"]
        words += [f"data.mapping={mapping}"] if mapping else []
        return [*words, "retrain=false", f"max_minutes={max_minutes:g}"]


def machines(folder: Path | None, *, first: str | None = None, typed: Sequence[str] = ()) -> Machines:
    """Those of the package and of a folder of the user's own (`--config-dir`)."""
    from .. import groups

    values = {
        choice: groups.choice_values("system", choice, folder) for choice in groups.choices("system", folder)
    }
    named = {choice: str(v["name"]) for choice, v in values.items() if "name" in v}
    return Machines(named, None if folder is None else folder.resolve(), first, typed)


_PICKLES = READERS["published"].suffixes
_ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z", ".rar", ".xz", ".bz2", ".zst")
_LONGEST = 60  # letters of a name
_PIECE = 1 << 18  # bytes read at a time
FORMATS: dict[str, str] = {
    ".csv": "table",
    **{s: kind for kind, one in READERS.items() if kind != "published" for s in one.suffixes},
}
"""Suffix -> reader of the logs that are accepted; pickles are not among them."""


def file_names(given: Sequence[str]) -> list[str]:
    """Names for the files of an upload, made of letters, digits, `_` and `-`, and a known suffix.

    They are given as the browser says them; nothing of them is taken for a path. RefusedError: one is no log, or they
    are logs of several formats.
    """
    out: list[str] = []
    kinds: dict[str, str] = {}
    for name in given:
        last = re.split(r"[/\\]", name)[-1]
        stem, dot, suffix = last.rpartition(".")
        suffix = f".{suffix.lower()}" if dot else ""
        if suffix not in FORMATS:
            raise RefusedError(_no_log(shown(last), suffix), 415)
        kinds.setdefault(FORMATS[suffix], shown(last))
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_")[:_LONGEST] or "log"
        k, free = 1, plain
        while f"{free}{suffix}".lower() in (n.lower() for n in out):
            k += 1
            free = f"{plain}_{k}"
        out.append(f"{free}{suffix}")
    if len(kinds) > 1:
        raise RefusedError(
            f"These are logs of different formats ({', '.join(kinds.values())}): drop those of one format at a time.",
            415,
        )
    return out


def shown(name: str) -> str:
    """A name as a sentence may show it."""
    printable = "".join(c for c in name if c.isprintable())
    return printable if len(printable) <= _LONGEST else f"{printable[:_LONGEST]}..."


def _no_log(name: str, suffix: str) -> str:
    if suffix in _ARCHIVES:
        return f"{name} is an archive, which is not opened here: unpack it and drop the logs that are in it."
    if suffix in _PICKLES:
        return f"{name} is a pickle, which may hold a program and is not loaded: write its arrays as .npz or CSV."
    return f"{name} is no log that is known here: expected one of {', '.join(FORMATS)}."


def receive(read: Callable[[int], bytes], target: Path, size: int) -> None:
    """Write what is sent to a file, and stop where it is longer than was said: nothing is left of it if that fails.

    `read` reads at most so many bytes of the request; it is empty at the end. RefusedError: more or fewer bytes came.
    """
    part = target.with_name(f"{target.name}.part")
    count = 0
    try:
        with part.open("wb") as file:
            while piece := read(_PIECE):
                count += len(piece)
                if count > size:
                    raise RefusedError(
                        f"{target.name} is longer than the {size} bytes that were announced.", 413
                    )
                file.write(piece)
        if count < size:
            raise RefusedError(
                f"Of {target.name} {count} of {size} bytes arrived: the upload was cut off; drop it again."
            )
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


_ID = re.compile(r"\d{8}-\d{6}-[0-9a-f]{16}")


class Shelf:
    """Jobs by id, and their folders in a folder that is made if it is not there."""

    def __init__(self, folder: Path, limits: ServeLimits) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(
                f"`out_dir`: {folder} cannot be made ({error.strerror}); name another folder."
            ) from error
        self.folder, self.limits = folder.resolve(), limits
        self.lock = threading.RLock()
        self._jobs: dict[str, ServedJob] = {}
        for path in sorted(p for p in self.folder.iterdir() if _ID.fullmatch(p.name)):
            job = load(path)
            if job is not None:
                self._jobs[job.id] = job
                self._resume(job)

    def _resume(self, job: ServedJob) -> None:
        """A job that was at work when the page ended has its logs still."""
        left = {"uploading": "refused", "looking": "refused", "waiting": "cancelled", "running": "cancelled"}
        if job.state in left:
            when = "while it was at work; start it again."
            if job.state == "uploading":
                when = "before all logs had arrived; drop them again."
            self.note(job, state=left[job.state], sentence=f"The page was closed {when}")

    def all(self) -> list[ServedJob]:
        """The jobs, the newest first."""
        with self.lock:
            return sorted(self._jobs.values(), key=lambda job: job.created, reverse=True)

    def get(self, name: str) -> ServedJob:
        """A job by its id; RefusedError where there is none."""
        with self.lock:
            if name not in self._jobs:
                raise RefusedError("There is no such diagnosis; it may have been deleted.", 404)
            return self._jobs[name]

    def of(self, job: ServedJob) -> Path:
        return self.folder / job.id

    def create(self, given: Sequence[tuple[str, int]], system: str | None) -> ServedJob:
        """A job for logs of these names and sizes [bytes], to be sent next; no machine: it is to be guessed."""
        limits, total = self.limits, sum(size for _, size in given)
        if not given:
            raise RefusedError("Nothing was dropped: drop a log, or several of one format.")
        if len(given) > limits.files:
            raise RefusedError(
                f"{len(given)} files are too many: at most {limits.files} logs at a time.", 413
            )
        names = file_names([name for name, _ in given])
        for name, size in given:
            if size <= 0:
                raise RefusedError(f"{shown(name)} is empty.")
        if total > limits.upload:
            most = f"{limits.upload / 2**20:g} MiB"
            raise RefusedError(
                f"The logs are too large: {total / 2**20:.4g} MiB, and at most {most} are taken (`upload`).",
                413,
            )
        if shutil.disk_usage(self.folder).free < 2 * total + (1 << 26):
            raise RefusedError(f"The disk of {self.folder} is full: make room first.", 507)
        with self.lock:
            if len(self._jobs) >= limits.keep:
                raise RefusedError(f"{limits.keep} diagnoses are kept (`keep`): delete one first.", 409)
            now = datetime.now().astimezone()
            name = f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(8)}"
            files = [UploadedFile(shown(g), n, s) for (g, s), n in zip(given, names, strict=True)]
            job = ServedJob(name, now.isoformat(timespec="milliseconds"), system, files)
            (self.folder / name).mkdir(mode=0o700)
            (self.folder / name / "logs").mkdir()
            self._jobs[name] = job
            self.note(job)
        return job

    def note(self, job: ServedJob, **changed: Any) -> None:
        """Change what is known of a job, and write it down."""
        with self.lock:
            for key, value in changed.items():
                setattr(job, key, value)
            if job.id in self._jobs:
                write_whole(self.of(job) / RECORD, json.dumps(asdict(job), indent=1) + "\n")

    def delete(self, job: ServedJob) -> None:
        """Remove a job with its folder; RefusedError where it is at work."""
        with self.lock:
            if job.state in AT_WORK:
                raise RefusedError("It is at work: stop it first.", 409)
            self._jobs.pop(job.id, None)
            shutil.rmtree(self.of(job), ignore_errors=True)

    def read(self, job: ServedJob, name: str) -> Any:
        """A JSON file of a job; None where it is not there."""
        try:
            return json.loads((self.of(job) / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
