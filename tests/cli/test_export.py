"""`nsde export`, `nsde verify` and `nsde track` from the command line."""

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nsde_torch.cli.main import main
from nsde_torch.control.compiled import compiler
from tests.helpers.commands import Said

pytestmark = pytest.mark.usefixtures("elsewhere")


needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
MPC = ("mpc.steps=6", "mpc.horizon=0.3", "mpc.iterations=2")


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "controller.ts"
    assert main(["export", "run=declared", f"out={out}", *MPC]) == 0
    return out


@pytest.fixture(scope="module")
def c_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("c") / "controller.c"
    assert main(["export", "run=declared", f"out={out}", "format=c", "mpc.moment_time=0.4", *MPC]) == 0
    return out


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("torchscript", marks=pytest.mark.slow),
        pytest.param("c", marks=[pytest.mark.slow, needs_compiler]),
    ],
)
def test_a_file_flies_as_the_controller_that_it_was_made_of(kind: str, file: Path, refused: Said) -> None:
    words = ["duration=0.8", "mpc.compile=off", "mpc.period=0.04", *MPC]
    if kind == "c":
        file = Path("controller.c").resolve()
        assert main(["export", "run=declared", f"out={file}", "format=c", *MPC]) == 0
    assert main(["track", f"controller={file}", "beside=[declared]", "out_dir=out", *words]) == 0
    found = json.loads(Path("out/tracking.json").read_text())["controllers"]
    ours, theirs = found[f"MPC, {file.name}"], found["MPC, declared physics"]
    assert ours["lost"] == 0
    assert ours["rmse_m"] == pytest.approx(theirs["rmse_m"], rel=0.02)
    many = ["machines=2", "at_once=2", "out_dir=two"]
    assert "one machine at a time" in refused("track", f"controller={file}", *many, *words)
    logged = ["run=declared", "log=out/log/flight_0.csv", "states=10", "adversarial=0"]
    assert main(["verify", str(file), *logged]) == 0


@needs_compiler
def test_a_controller_in_c_is_written_and_verified(
    c_file: Path, refused: Said, shown: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "ends in .c" in refused("export", "run=declared", "out=other.ts", "format=c", *MPC)
    assert "is there already" in refused("export", "run=declared", f"out={c_file}", "format=c", *MPC)
    assert "6 states with estimators and plans of their own" in shown(
        "verify", str(c_file), "run=declared", "states=6", "adversarial=20", "out=found.json"
    )
    found = json.loads(Path("found.json").read_text())
    assert found["passed"]
    assert max(found["input_difference_max"], found["estimator_input_difference_max"]) < 1e-8
    monkeypatch.setenv("CC", "no_such_compiler")
    assert "needs a C compiler" in refused("verify", str(c_file), "run=declared")


@needs_compiler
def test_settings_that_a_file_does_not_have_are_refused(c_file: Path, refused: Said) -> None:
    said = refused("track", f"controller={c_file}", "mpc.speed_limit=3", "out_dir=out")
    assert "`mpc.speed_limit` is 3.0 here" in said
    assert "exported with inf" in said
    said = refused("fly", f"controller={c_file}", "mpc.deadline=0.01", "out_dir=out")
    assert "exported with None" in said


@pytest.mark.slow
def test_the_flight_computer_is_built_and_flies_a_recorded_log(
    file: Path, root: Path, tmp_path: Path
) -> None:
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None or shutil.which("cmake") is None:
        pytest.skip("needs a C++ compiler and cmake")
    source, built = root / "examples" / "flight_computer", tmp_path / "build"
    prefix = torch.utils.cmake_prefix_path
    steps = (
        ["cmake", "-S", str(source), "-B", str(built), f"-DCMAKE_PREFIX_PATH={prefix}"],
        ["cmake", "--build", str(built)],
        [sys.executable, str(source / "reference.py"), "lemniscate", "reference.csv"],
    )
    for step in steps:
        done = subprocess.run(step, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    program = [str(built / "flight_computer"), "--reference", "reference.csv"]

    def fly(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*program, *words], capture_output=True, text=True, check=False)

    log = Path("log.csv")
    rows = Path("reference.csv").read_text().splitlines()[:201]
    rows[121] = ",".join(["1.2", *("nan",) * 13])
    log.write_text("\n".join(rows) + "\n")
    done = fly("--controller", str(file), "--log", str(log), "--out", "inputs.csv", "--make-late", "20")
    assert done.returncode == 0, done.stderr
    assert "p99" in done.stdout
    lines = [line.split(",") for line in Path("inputs.csv").read_text().splitlines()]
    table = [dict(zip(lines[0], line, strict=True)) for line in lines[1:]]
    inputs = torch.tensor([[float(row[f"u_{i}"]) for i in range(1, 7)] for row in table])
    assert bool(((inputs >= 0.0) & (inputs <= 1.0)).all())
    assert table[20]["source"] == "late"
    assert table[60]["status"] == "bad_state:kept"
    assert table[-1]["source"] == "plan"
    assert {row["status"] for row in table} & {"converged", "improved"}
    broken = Path("broken.ts")
    content = bytearray(file.read_bytes())
    content[content.index(b"def step") + 4] ^= 1
    broken.write_bytes(content)
    refused = fly("--controller", str(broken), "--log", str(log))
    assert refused.returncode == 2
    assert "changed" in refused.stderr or "damaged" in refused.stderr
    assert file.read_bytes().count(b'"keep": 0.5') == 1  # also what only the record says
    broken.write_bytes(file.read_bytes().replace(b'"keep": 0.5', b'"keep": 9.5'))
    refused = fly("--controller", str(broken), "--log", str(log))
    assert refused.returncode == 2
    assert "changed" in refused.stderr


FAST = ("mpc.compile=off", "mpc.period=0.04", *MPC)


def test_a_flight_leaves_numbers_a_log_that_other_commands_read_and_figures(shown: Said) -> None:
    words = ["run=declared", "duration=0.4", "beside=[pid]", "animation=gif", "out_dir=out", *FAST]
    printed = shown("track", *words)
    assert "RMSE" in printed
    assert "solves: p50" in printed
    content = json.loads(Path("out/tracking.json").read_text())
    assert set(content["controllers"]) == {"MPC, declared physics", "PID cascade"}
    own = content["controllers"]["MPC, declared physics"]
    assert own["lost"] == 0
    assert 0.0 < own["rmse_m"] < 0.1
    assert own["solve_ms"]["p50"] > 0.0
    assert content["reference"]["speed"] == 3.4
    for name in ("tracking.png", "solve_times.png", "flight.gif"):
        assert Path(f"out/plots/{name}").is_file()
    with Path("out/log/flight_0.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0][:4] == ["t", "p_x", "p_y", "p_z"]
    assert rows[0][-1] == "u_6"
    assert len(rows) == 42


def test_a_folder_with_a_flight_is_not_written_over(refused: Said) -> None:
    Path("out").mkdir()
    Path("out/tracking.json").write_text("{}")
    assert "holds a flight already" in refused("track", "run=declared", "out_dir=out")
