"""What the studies share: train through the command line, and end where a training fails."""

from collections.abc import Sequence
from pathlib import Path

from nsde_benchmarks import training


def train(run_dir: Path, overrides: Sequence[str]) -> Path:
    """Train one model with `nsde train` unless `run_dir` holds a finished one; its output goes to RUN_DIR.log."""
    return _finish("train", "metrics.json", run_dir, overrides)


def learn_policy(run_dir: Path, overrides: Sequence[str]) -> Path:
    """Learn one policy with `nsde policy` unless `run_dir` holds a finished one; its output goes to RUN_DIR.log."""
    return _finish("policy", "policy.json", run_dir, overrides)


def _finish(command: str, result: str, run_dir: Path, overrides: Sequence[str]) -> Path:
    if not (run_dir / result).is_file() and training.run(command, run_dir, overrides):
        raise SystemExit(f"nsde {command} failed; see {training.log_of(run_dir)}")
    return run_dir


def train_all(jobs: dict[Path, list[str]], *, at_once: int) -> None:
    """Train several models, `at_once` at a time."""
    lost = training.train_all(jobs, at_once=at_once)
    if lost:
        raise SystemExit("\n".join(lost.values()))
