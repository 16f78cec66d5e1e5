"""The page without a network: its application, a client, and commands that run in this process or are played."""

import contextlib
import io
import json
import shutil
import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

import pytest

pytest.importorskip("waitress", reason="needs the extra nsde_torch[serve]")
from werkzeug.test import Client

from nsde_torch.cli.main import main
from nsde_torch.cli.serving.app import ServedPage
from nsde_torch.cli.serving.job import ServeLimits, Shelf, machines
from nsde_torch.cli.serving.process import EndOfProcess, why_ended
from nsde_torch.cli.serving.runner import JobRunner
from nsde_torch.diagnosis.time_series import script

HOST = "127.0.0.1:8765"
TOKEN = "a-token"
FOUND = Path(__file__).parents[1] / "golden" / "diagnosis.json"
REPORT = """<!doctype html><title>report</title><p>as found</p><select id="run"></select><div id="charts"></div>
<script type="application/json" id="series">{"runs": [{"name": "run",
"log": {"t": [0, 1], "y": {"q": [0, 1, "AAABAA=="]}}}],
"charts": [{"of": "log", "names": ["q"], "unit": "m"}], "path": ["q", "q", "q"]}</script>"""
INSPECTION = {
    "kind": "csv", "runs": ["run"], "system": "mass_spring_damper", "usable": True, "native": True, "mapping": "",
    "mapped": [], "columns": [], "missing": [], "open": [], "notes": [], "checks": [], "path": "",
}  # fmt: skip


@dataclass
class Played:
    """Commands that write what real ones would; a diagnosis waits until it is let go."""

    inspection: dict[str, Any] = field(default_factory=lambda: dict(INSPECTION))
    go: Event = field(default_factory=Event)
    words: list[list[str]] = field(default_factory=list)

    def __call__(
        self, words: list[str], *, folder: Path, log: Path, limits: ServeLimits, say: Any
    ) -> "PlayedWork":
        self.words.append(words)
        log.write_text("played\n")
        return PlayedWork(self, words, limits, say)


@dataclass
class PlayedWork:
    """One of them."""

    played: Played
    words: list[str]
    limits: ServeLimits
    say: Any
    stopped: str = ""

    def run(self) -> EndOfProcess:
        given = dict(word.split("=", 1) for word in self.words if "=" in word)
        if self.words[0] == "inspect":
            Path(given["json"]).write_text(json.dumps(self.played.inspection))
            return EndOfProcess(0, "", "")
        self.say("screening effects", 1, 4, "motor_lag (+812 nats)")
        self.played.go.wait(20)
        if self.stopped:
            return EndOfProcess(-9, self.stopped, "It was stopped.")
        result = Path(given["out_dir"])
        (result / "plots").mkdir(parents=True)
        shutil.copy(FOUND, result / "diagnosis.json")
        (result / "report.html").write_text(REPORT + f"<script>{script()}</script>")
        (result / "effects.yaml").write_text("effects: []\n")
        (result / "plots" / "residual.png").write_bytes(b"\x89PNG")
        return EndOfProcess(0, "", "")

    def stop(self, why: str = "cancelled") -> None:
        self.stopped = why
        self.played.go.set()


class InProcess:
    """A real command, in this process: as quick as it can be."""

    def __init__(self, words: list[str], *, folder: Path, log: Path, limits: ServeLimits, say: Any) -> None:
        self.words, self.log, self.limits = words, log, limits

    def run(self) -> EndOfProcess:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            status = main(self.words)
        self.log.write_text(printed.getvalue())
        tail = printed.getvalue().splitlines()
        return EndOfProcess(
            status, "", why_ended(self.words[0], status, tail, stopped="", limits=self.limits)
        )

    def stop(self, why: str = "cancelled") -> None:
        raise NotImplementedError


@dataclass
class Page:
    """A client of the page that holds its token."""

    app: ServedPage
    runner: JobRunner
    folder: Path

    def ask(self, method: str, path: str, content: Any = None, **given: Any) -> Any:
        """The answer to one request; `given` goes to the client of werkzeug."""
        headers = {"Host": HOST, "X-Nsde-Token": TOKEN, **given.pop("headers", {})}
        headers = {name: value for name, value in headers.items() if value is not None}
        body = {} if content is None else {"json": content}
        return Client(self.app).open(path, method=method, headers=headers, **body, **given)

    def drop(self, files: dict[str, bytes], system: str | None = "mass_spring_damper") -> Any:
        """Send logs as the page does; the job, or the answer that refused it."""
        listed = [{"name": name, "size": len(content)} for name, content in files.items()]
        made = self.ask("POST", "/api/jobs", {"system": system, "files": listed})
        if made.status_code != 201:
            return made
        name = made.json["id"]
        for k, content in enumerate(files.values()):
            sent = self.ask("PUT", f"/api/jobs/{name}/logs/{k}", data=content)
            assert sent.status_code == 200, sent.text
        self.ask("POST", f"/api/jobs/{name}/inspect", {"system": system})
        return self.until(name, lambda job: job["state"] != "looking")

    def until(self, name: str, reached: Callable[[Any], bool]) -> Any:
        """The job once it is so."""
        end = time.monotonic() + 240
        while time.monotonic() < end:
            job = self.ask("GET", f"/api/jobs/{name}").json
            if reached(job):
                return job
            time.sleep(0.01)
        raise AssertionError(job)

    def jobs(self) -> list[Any]:
        return self.ask("GET", "/api/jobs").json["jobs"]


def make_page(
    folder: Path, make: Any, *, hosts: Collection[str] = (HOST, "localhost:8765"), **limits: Any
) -> Page:
    """A page that keeps its jobs in a folder."""
    bounds, known = ServeLimits(**limits), machines(None)
    runner = JobRunner(Shelf(folder, bounds), known, make=make)
    return Page(ServedPage(runner, token=TOKEN, hosts=hosts), runner, folder)


@pytest.fixture
def played() -> Played:
    return Played()


@pytest.fixture
def page(tmp_path: Path, played: Played) -> Iterator[Page]:
    """A page whose commands are played."""
    made = make_page(tmp_path / "served", played, upload=1 << 16, keep=4)
    yield made
    played.go.set()
    made.runner.close()
