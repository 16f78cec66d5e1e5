"""Runs and sweeps: what a job leaves behind, how a failure is told, with every launcher; and the report."""

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.cli.commands.sweep_report import SCORES
from nsde_torch.cli.commands.train import COMMAND
from nsde_torch.cli.main import main
from tests.helpers.commands import Said

PROBE = """
import json, os, time
from dataclasses import dataclass
from nsde_torch.cli.commands.train import TrainConfig
from nsde_torch.errors import DataError

@dataclass
class ProbeConfig(TrainConfig):
    pass

def run(config, job):
    if config.seed == 13:
        raise DataError("`seed` 13 has no data.")
    if config.seed == 14:
        raise RuntimeError("bug")
    if config.seed == 15:
        raise DataError("`path` and `seed`")
    if config.seed == 16:
        raise OSError(28, "No space left on device")
    if config.seed in (98, 99):
        if config.seed == 99:
            (job.run_dir / "checkpoint.safetensors").touch()
        open("started", "w").close()
        time.sleep(60)
    if config.system.name == "module_of_mine:Machine":
        import module_of_mine
    if config.resume:
        assert (job.run_dir / "metrics.json").is_file()
    score = config.trainer.lr + config.seed
    metrics = {"validation": {"score": score}, "pid": os.getpid(), "run_dir": 1.0}
    (job.run_dir / "metrics.json").write_text(json.dumps(metrics))
    return score
"""
START = """
import sys
from dataclasses import replace
import nsde_probe
from nsde_torch.cli.commands.train import COMMAND
sys.exit(replace(COMMAND, schema=nsde_probe.ProbeConfig).main(sys.argv[1:]))
"""

Probe = Callable[..., subprocess.CompletedProcess[str]]
"""Runs `nsde train WORDS` with the probe for its work."""


def _environment(folder: Path) -> dict[str, str]:
    (folder / "nsde_probe.py").write_text(PROBE)
    return {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}


@pytest.fixture
def probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Probe:
    """In this process, which has imported torch already."""
    (tmp_path / "nsde_probe.py").write_text(PROBE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delenv("NSDE_TRACEBACK", raising=False)
    monkeypatch.delitem(sys.modules, "nsde_probe", raising=False)
    command = replace(COMMAND, schema=importlib.import_module("nsde_probe").ProbeConfig)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        capfd.readouterr()
        status = command.main(words)
        said = capfd.readouterr()
        return subprocess.CompletedProcess(words, status, said.out, said.err)

    return run


@pytest.fixture
def own_process(tmp_path: Path) -> Probe:
    """In a process of its own, which has imported nothing of the user's."""
    given: dict[str, Any] = {"cwd": tmp_path, "env": _environment(tmp_path), "timeout": 120, "check": False}

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", START, *words], capture_output=True, text=True, **given)

    return run


def _needs(module: str) -> None:
    if importlib.util.find_spec(f"hydra_plugins.{module}") is None:
        pytest.skip(f"needs {module}, from the extra nsde_torch[sweeps]")


def _jobs(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir())


def test_a_folder_that_holds_a_run_or_a_sweep_is_not_written_over(probe: Probe) -> None:
    assert probe("run_dir=r").returncode == 0
    done = probe("run_dir=r", "seed=1")
    assert done.returncode == 2
    assert "`run_dir=r` holds a run already. Continue it with resume=r" in done.stderr
    assert probe("-m", "sweep_dir=s", "seed=0,1").returncode == 0
    done = probe("-m", "sweep_dir=s", "seed=2,3")
    assert done.returncode == 2
    assert "`sweep_dir=s` holds a sweep already" in done.stderr


def test_a_run_without_a_name_goes_to_a_dated_folder(probe: Probe, tmp_path: Path) -> None:
    assert probe("system=cartpole").returncode == 0
    (metrics,) = tmp_path.glob("runs/*/*/metrics.json")
    assert metrics.parent.name.endswith("_cartpole")


@pytest.mark.parametrize(
    ("seed", "kind", "status", "said"),
    [
        (13, "DataError", 2, "nsde train: `seed` 13 has no data."),
        (16, "OSError", 2, "nsde train: The disk is full"),
        (14, "RuntimeError", 70, "RuntimeError: bug"),  # a fault of ours, which shows its traceback
    ],
)
def test_an_error_is_said_by_whose_fault_it_is_and_recorded(
    seed: int, kind: str, status: int, said: str, probe: Probe, tmp_path: Path
) -> None:
    done = probe(f"seed={seed}", "run_dir=r")
    assert done.returncode == status
    assert any(line.startswith(said) for line in done.stderr.splitlines())
    assert ("Traceback" in done.stderr) == (status == 70)
    failed = json.loads((tmp_path / "r" / "failed.json").read_text())
    assert failed["error"] == kind
    assert "Traceback" in failed["traceback"]


def test_a_resumed_run_keeps_its_choices_and_its_folder(probe: Probe, tmp_path: Path) -> None:
    assert probe("run_dir=r", "trainer.lr=0.5", "seed=2").returncode == 0
    done = probe("resume=r", "trainer.steps=77")
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "r" / "metrics.json").read_text())["validation"]["score"] == 2.5
    assert not (tmp_path / "runs").exists()
    assert probe("resume=r").returncode == 0


def test_a_module_in_the_users_folder_is_found_also_when_resuming(
    probe: Probe, own_process: Probe, tmp_path: Path
) -> None:
    folder = tmp_path / "own"
    (folder / "system").mkdir(parents=True)
    (folder / "system" / "mine.yaml").write_text("name: module_of_mine:Machine\n")
    (folder / "module_of_mine.py").write_text("class Machine: pass\n")
    done = probe("--config-dir", "own", "system=mine", "run_dir=r")
    assert done.returncode == 0, done.stderr
    done = own_process("resume=r")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("seed", "advice"),
    [
        (99, "Continue with: nsde train resume={}"),
        pytest.param(98, "nothing to continue yet: start the same command again.", marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_says_how_to_go_on(seed: int, advice: str, tmp_path: Path) -> None:
    words, piped = [sys.executable, "-c", START, f"seed={seed}", "run_dir=r"], subprocess.PIPE
    env = _environment(tmp_path)
    process = subprocess.Popen(words, stdout=piped, stderr=piped, text=True, cwd=tmp_path, env=env)
    for _ in range(300):
        if (tmp_path / "started").exists():
            break
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.splitlines()[-1].endswith(advice.format(tmp_path / "r"))
    assert (tmp_path / "r" / "failed.json").exists() == (seed == 98)  # then the folder is free again


_SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("basic", "joblib", "submitit_local")]


@pytest.mark.parametrize("launcher", ["batched", *_SLOW])
def test_a_failed_job_does_not_take_the_others_along(launcher: str, probe: Probe, tmp_path: Path) -> None:
    if launcher not in ("basic", "batched"):
        _needs(f"hydra_{launcher.split('_')[0]}_launcher")
    words = [] if launcher == "basic" else [f"hydra/launcher={launcher}"]
    if launcher == "joblib":
        words.append("hydra.launcher.n_jobs=2")
    done = probe("-m", "sweep_dir=sweep", "loss=paper,replay", "seed=0,13,14", *words)
    assert done.returncode == 1, done.stderr
    jobs = [job for job in _jobs(tmp_path / "sweep") if job.name[0].isdigit()]
    assert [job.name for job in jobs] == [
        f"{number}_loss={loss},seed={seed}"
        for number, (loss, seed) in enumerate([(a, b) for a in ("paper", "replay") for b in (0, 13, 14)])
    ]
    assert sum((job / "metrics.json").is_file() for job in jobs) == 2
    assert sum((job / "failed.json").is_file() for job in jobs) == 4
    assert "4 job(s) failed" in done.stderr
    assert "nsde sweep-report sweep" in done.stdout


@pytest.mark.slow
def test_optuna_minimises_the_score_and_outlives_failed_trials(own_process: Probe, tmp_path: Path) -> None:
    _needs("hydra_optuna_sweeper")
    sampled = [f"hydra.sweeper.{word}" for word in ("n_trials=6", "n_jobs=1", "sampler.seed=1")]
    space = ["trainer.lr=interval(0.001,0.1)", "seed=choice(0,13)"]
    done = own_process("-m", "hydra/sweeper=optuna", "sweep_dir=sweep", *sampled, *space)
    results = (tmp_path / "sweep" / "optimization_results.yaml").read_text()
    assert "seed: 0" in results, done.stderr
    jobs = _jobs(tmp_path / "sweep")
    assert len(jobs) == 6
    assert done.returncode == (1 if any((job / "failed.json").is_file() for job in jobs) else 0)


def _job(folder: Path, number: int, overrides: list[str], metrics: Any = None, failed: Any = None) -> None:
    job = folder / f"{number}_job"
    (job / ".hydra").mkdir(parents=True)
    (job / ".hydra" / "overrides.yaml").write_text("".join(f"- {word}\n" for word in overrides) or "[]\n")
    if metrics is not None:
        (job / "metrics.json").write_text(metrics if isinstance(metrics, str) else json.dumps(metrics))
    if failed is not None:
        (job / "failed.json").write_text(json.dumps(failed))


def _metrics(score: float) -> dict[str, Any]:
    outer, _, inner = SCORES[0].partition(".")
    return {outer: {inner: score}} if inner else {outer: score}


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Two settings with two finished seeds each, one failed job, two unfinished."""
    common = ["system=hexacopter"]
    for number, (loss, seed, score) in enumerate(
        [("paper", 0, 3.0), ("paper", 1, 5.0), ("default", 0, 1.0), ("default", 1, 2.0)]
    ):
        _job(tmp_path, number, [*common, f"loss={loss}", f"seed={seed}"], _metrics(score))
    reason = {"error": "NonFiniteError", "message": "left the finite\nnumbers at step 7", "traceback": ""}
    _job(tmp_path, 4, [*common, "loss=paper", "seed=2"], failed=reason)
    _job(tmp_path, 5, [*common, "loss=default", "seed=2"])
    _job(tmp_path, 10, [*common, "loss=default", "seed=3"], metrics='{"validation": {"sco')
    return tmp_path


def test_settings_are_ranked_by_the_mean_over_seeds_and_what_failed_is_named(
    sweep: Path, shown: Said
) -> None:
    text = shown("sweep-report", str(sweep))
    rows = [line.split() for line in text.splitlines()]
    assert ["1", "2", "1.5", "+-", "0.71", "loss=default"] in rows
    assert ["2", "2", "4", "+-", "1.4", "loss=paper"] in rows
    assert f"best job: {sweep / '2_job'}" in text
    assert "7 jobs: 4 done, 1 failed, 2 unfinished" in text
    assert "  4_job: NonFiniteError: left the finite numbers at step 7" in text
    assert "  5_job\n  10_job" in text


def test_report_is_written_as_json_and_csv(sweep: Path) -> None:
    assert main(["sweep-report", str(sweep)]) == 0
    content = json.loads((sweep / "sweep_report.json").read_text())
    assert [row["label"] for row in content["ranking"]] == ["loss=default", "loss=paper"]
    assert content["ranking"][0]["mean"][SCORES[0]] == 1.5
    assert content["failed"] == [
        {"job": "4_job", "reason": "NonFiniteError: left the finite numbers at step 7"}
    ]
    rows = list(csv.DictReader((sweep / "sweep_report.csv").open()))
    assert len(rows) == 7
    assert rows[0]["loss"] == "paper"
    assert float(rows[0][SCORES[0]]) == 3.0


def test_a_folder_without_jobs_is_refused(tmp_path: Path, refused: Said) -> None:
    assert "no jobs in" in refused("sweep-report", str(tmp_path))
    assert "is not a folder" in refused("sweep-report", str(tmp_path / "missing"))


def test_scores_that_do_not_compare_are_ranked_apart_unless_a_number_is_named(
    tmp_path: Path, shown: Said
) -> None:
    for number, (loss, score, error) in enumerate([("paper", 9.0, 0.1), ("default", 1.0, 0.2)]):
        metrics = {
            **_metrics(score),
            "system": "cartpole",
            "loss": loss,
            "test": {"errors": {"model": {"rate": {"1": error}}}},
        }
        _job(tmp_path, number, [f"loss={loss}"], metrics)
    text = shown("sweep-report", str(tmp_path))
    assert "among system=cartpole loss=paper" in text
    assert "do not compare" in text
    assert "rate 1 s" in text
    text = shown("sweep-report", str(tmp_path), "--by", "test.errors.model.rate.1")
    assert "among" not in text
    assert [line.split()[0] for line in text.splitlines() if "loss=" in line] == ["1", "2"]
