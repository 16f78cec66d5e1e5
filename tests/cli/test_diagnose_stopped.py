"""`nsde diagnose` that is stopped: what is known is on disk and printed, and the exit status says so."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nsde_torch import progress, time_limit
from nsde_torch.cli.exit_status import INTERRUPTED, OK, USER_ERROR
from nsde_torch.cli.main import main
from nsde_torch.diagnosis.files import EFFECTS, REPORT, RESULT
from nsde_torch.diagnosis.stages import SELECTION
from nsde_torch.progress import Stages
from nsde_torch.simulation import simulate
from nsde_torch.simulation.generate import write

pytestmark = pytest.mark.usefixtures("elsewhere")

FRICTION = "coulomb_friction"


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("data") / "spring"
    made = simulate("mass_spring_damper", effects=[{FRICTION: {"size": 0.3}}], durations=(3.0,) * 3, seed=1)
    write(made, folder)
    return ["diagnose", "system=mass_spring_damper", "data=csv", f"data.path={folder}", "retrain=false"]


def test_ctrl_c_writes_and_prints_what_is_known(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted(Stages):
        def __call__(self, stage: str, done: int, total: int) -> None:
            if stage == "testing what is left":
                raise KeyboardInterrupt
            super().__call__(stage, done, total)

    monkeypatch.setattr(progress, "Stages", Interrupted)
    out = tmp_path / "out"
    assert main([*words, f"candidates=[{FRICTION}]", f"out_dir={out}"]) == INTERRUPTED
    said = capsys.readouterr()
    assert "\nso far: stopped during testing what is left; not done: tests of feedback" in said.out
    go_on = f"nsde diagnose resume={out}"
    assert said.err.splitlines()[-1] == f"nsde diagnose: interrupted. Continue with: {go_on}"
    content = json.loads((out / RESULT).read_text())
    assert content["added"] == [FRICTION]
    assert content["so_far"]["stopped_during"] == "testing what is left"
    assert FRICTION in (out / EFFECTS).read_text()
    assert "Not finished." in (out / REPORT).read_text()
    logged = (out / "diagnose.log").read_text().splitlines()
    assert any(f"; so far: {FRICTION} (+" in line for line in logged)
    assert not any(line.partition(" - ")[2] in said.out for line in logged)


def test_it_ends_in_time_with_what_is_known_and_is_no_failure(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(time_limit, "perf_counter", iter(range(10**6)).__next__)  # a second a look
    out = tmp_path / "out"
    given = [word for word in words if word != "retrain=false"]
    assert main([*given, f"candidates=[{FRICTION}]", "max_minutes=0.01", f"out_dir={out}"]) == OK
    said = capsys.readouterr()
    (line,) = [one for one in said.out.splitlines() if one.startswith("stopped after")]
    assert line.startswith(f"stopped after 0.01 min as asked: not done: {SELECTION}, ")
    assert line.endswith(f"; go on with resume={out}")
    assert json.loads((out / RESULT).read_text())["so_far"]["stopped_after_min"] == 0.01
    assert (out / EFFECTS).is_file()
    assert not (out / "model").exists()
    monkeypatch.undo()
    assert main(["diagnose", f"resume={out}", "retrain=false", "max_minutes=null"]) == OK
    assert json.loads((out / RESULT).read_text())["added"] == [FRICTION]
    assert main(["diagnose", f"resume={out}"]) == USER_ERROR
    assert "came to its end" in capsys.readouterr().err
    assert main(["diagnose", f"resume={tmp_path}"]) == USER_ERROR
    assert "there is no run to continue" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_what_is_known(words: list[str], tmp_path: Path, sent: signal.Signals) -> None:
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "nsde_torch.cli", *words, f"out_dir={out}"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, "MPLBACKEND": "Agg"},
    )  # fmt: skip
    end = time.monotonic() + 120
    while not ((out / RESULT).is_file() and json.loads((out / RESULT).read_text())["added"]):
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)
    assert "so_far" in json.loads((out / RESULT).read_text())
    process.send_signal(sent)
    said, err = process.communicate(timeout=120)
    assert process.returncode == INTERRUPTED, err
    assert "so far: stopped during " in said
    content = json.loads((out / RESULT).read_text())
    assert content["so_far"]["stopped_during"]
    assert content["not_done"]
    assert (out / REPORT).is_file()
