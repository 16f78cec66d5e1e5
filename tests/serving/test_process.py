"""A command in a process of its own: its end, its limits, and that nothing of it is left."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from nsde_torch.cli.serving.job import ServeLimits
from nsde_torch.cli.serving.process import CommandProcess
from nsde_torch.progress import PROGRESS, Stages

ENDLESS = ["serve", "port=0"]


def _process(tmp_path: Path, words: list[str], **limits: float) -> CommandProcess:
    return CommandProcess(
        words,
        folder=tmp_path,
        log=tmp_path / "log.txt",
        limits=ServeLimits(**limits),  # type: ignore[arg-type]
        say=lambda *step: None,
    )


def _wait_for(path: Path, text: str) -> None:
    end = time.monotonic() + 30
    while not (path.is_file() and text in path.read_text()):
        assert time.monotonic() < end
        time.sleep(0.02)


def test_progress_for_a_program_is_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PROGRESS, "json")
    stream = io.StringIO()
    stages = Stages(stream)
    stages("screening effects", 0, 3)
    stages.known("motor_lag (+812 nats)", 60.0)
    stages("screening effects", 1, 3)
    stages.close()
    told = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [(step["stage"], step["done"], step["total"]) for step in told] == [
        ("screening effects", 0, 3),
        ("screening effects", 1, 3),
    ]
    assert [step.get("found") for step in told] == [None, "motor_lag (+812 nats)"]
    assert told[1]["seconds"] >= told[0]["seconds"] >= 0.0


def test_a_fault_of_the_user_is_the_sentence_that_the_command_said(tmp_path: Path) -> None:
    end = _process(tmp_path, ["inspect", "log.csv", "sytem=x"]).run()
    assert end.status == 2
    assert end.sentence.startswith("`sytem` is not a key of `nsde inspect`. Did you mean `system`?")


def test_a_stopped_command_leaves_no_process(tmp_path: Path) -> None:
    work = _process(tmp_path, ENDLESS)
    ends = []
    thread = threading.Thread(target=lambda: ends.append(work.run()))
    thread.start()
    _wait_for(tmp_path / "log.txt", "Ctrl-C")
    work.stop()
    thread.join(10)
    assert ends[0].stopped == "cancelled"
    assert ends[0].status == -signal.SIGKILL
    work.stop()  # once more does nothing


def test_a_command_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    end = _process(tmp_path, ENDLESS, seconds=1.5).run()
    assert end.stopped == "time"
    assert "took longer than 0.025 min" in end.sentence


@pytest.mark.slow
def test_a_command_has_no_more_memory_than_it_may(tmp_path: Path) -> None:
    end = _process(tmp_path, ["inspect", str(tmp_path)], memory=1 << 28).run()
    assert end.status != 0
    assert "needs more memory than the 0.25 GiB" in end.sentence


@pytest.mark.skipif(sys.platform != "linux", reason="the signal at a parent's end is Linux's")
@pytest.mark.slow
def test_a_command_ends_with_the_page_however_that_ends(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from nsde_torch.cli.serving.job import ServeLimits\n"
        "from nsde_torch.cli.serving.process import CommandProcess\n"
        f"folder = Path({str(tmp_path)!r})\n"
        f"CommandProcess({ENDLESS!r}, folder=folder, log=folder / 'log.txt', limits=ServeLimits(), say=print).run()\n"
    )
    page = subprocess.Popen([sys.executable, "-c", code])
    _wait_for(tmp_path / "log.txt", "http://")
    child = int(Path(f"/proc/{page.pid}/task/{page.pid}/children").read_text().split()[0])
    page.kill()
    page.wait()
    end = time.monotonic() + 10
    while Path(f"/proc/{child}").is_dir() and "(zombie)" not in Path(f"/proc/{child}/status").read_text():
        assert time.monotonic() < end
        time.sleep(0.02)
    assert os.getpid() != child
