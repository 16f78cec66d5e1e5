"""What the studies share: those of `blind/study.py`, and trainings by the command line that end where one fails."""

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path[1:1] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent / "blind")]

from study import Array, Json, columns, head, line, markdown, options, read_json, save, write_json  # noqa: E402, F401

from nsde_benchmarks import training  # noqa: E402


def nsde(*words: str) -> list[str]:
    """`nsde` with the interpreter that runs this."""
    return [sys.executable, "-m", "nsde_torch.cli", *words]


def finished(command: str, result: str, run_dir: Path, overrides: Sequence[str]) -> Path:
    """Run `nsde` unless the run directory holds the result of it; its output goes to RUN_DIR.log."""
    if not (run_dir / result).is_file() and training.run(command, run_dir, overrides):
        raise SystemExit(f"nsde {command} failed; see {training.log_of(run_dir)}")
    return run_dir


def train_all(jobs: dict[Path, list[str]], *, at_once: int) -> None:
    """Train several models, `at_once` at a time."""
    lost = training.train_all(jobs, at_once=at_once)
    if lost:
        raise SystemExit("\n".join(lost.values()))
