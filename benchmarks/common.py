"""What the studies share: train through the command line, several jobs at a time, one thread each."""

import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path


def train(run_dir: Path, overrides: Sequence[str]) -> Path:
    """Train one model with `nsde train` unless `run_dir` holds a finished one; its output goes to RUN_DIR.log."""
    return _finish("train", "metrics.json", run_dir, overrides)


def learn_policy(run_dir: Path, overrides: Sequence[str]) -> Path:
    """Learn one policy with `nsde policy` unless `run_dir` holds a finished one; its output goes to RUN_DIR.log."""
    return _finish("policy", "policy.json", run_dir, overrides)


def _finish(command: str, result: str, run_dir: Path, overrides: Sequence[str]) -> Path:
    if (run_dir / result).is_file():
        return run_dir
    words = [sys.executable, "-m", "nsde_torch.cli", command, *overrides, "threads=1"]
    words.append(f"resume={run_dir}" if (run_dir / ".hydra").is_dir() else f"run_dir={run_dir}")
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    log = run_dir.parent / f"{run_dir.name}.log"
    with log.open("w") as out:
        code = subprocess.run(
            words, stdout=out, stderr=out, env={**os.environ, "OMP_NUM_THREADS": "1"}
        ).returncode
    if code:
        raise SystemExit(f"nsde {command} failed ({' '.join(words)}); see {log}")
    return run_dir


def train_all(jobs: dict[Path, list[str]], *, at_once: int) -> None:
    """Train several models, `at_once` at a time."""
    with ThreadPoolExecutor(at_once) as pool:
        for folder in pool.map(lambda item: train(*item), jobs.items()):
            print(f"trained {folder}", flush=True)
