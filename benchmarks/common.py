"""What the studies share: those of `blind/study.py`, and trainings by the command line that end where one fails."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path[1:1] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent / "blind")]

from study import STATES, Array, Json, line, markdown, options, read_json, save, write_json  # noqa: E402

from nsde_benchmarks import training  # noqa: E402

__all__ = ["STATES", "Array", "Json", "line", "markdown", "options", "read_json", "save", "write_json"]


def nsde(*words: str) -> list[str]:
    """`nsde` with the interpreter that runs this."""
    return [sys.executable, "-m", "nsde_torch.cli", *words]


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


def held_out(folder: Path) -> tuple[Any, Any]:
    """Training and test runs of a run directory, as its configuration says."""
    from nsde_benchmarks.paper.figure_table import held_out

    parts = held_out(folder)
    return parts.train, parts.test
