"""Trainings by the command line, some at a time, one thread each; what is finished is used again."""

import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

log = logging.getLogger(__name__)

Processes = list[subprocess.Popen[bytes]]


def run(command: str, run_dir: Path, words: Sequence[str], processes: Processes | None = None) -> int:
    """Run a command of `nsde` that has a run directory, or continue it; its output goes to `RUN_DIR.log`."""
    begun = (run_dir / ".hydra").is_dir()
    where = [f"resume={run_dir}"] if begun else [*words, f"run_dir={run_dir}", "threads=1"]
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    with log_of(run_dir).open("ab") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "nsde_torch.cli", command, *where],
            stdout=out,
            stderr=out,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        if processes is not None:
            processes.append(process)
        return process.wait()


def log_of(run_dir: Path) -> Path:
    """File of the output of a run."""
    return run_dir.with_name(f"{run_dir.name}.log")


def train_all(jobs: Mapping[Path, Sequence[str]], *, at_once: int) -> dict[str, str]:
    """Train what has no finished run directory yet; interrupted trainings are continued."""
    missing = {folder: words for folder, words in jobs.items() if not (folder / "metrics.json").is_file()}
    if len(jobs) > len(missing):
        where = ", ".join(sorted({str(folder.parent) for folder in jobs}))
        print(f"{len(jobs) - len(missing)} of {len(jobs)} models are there already, in {where}")
    started = time.perf_counter()
    processes: Processes = []
    lost: dict[str, str] = {}
    with ThreadPoolExecutor(at_once) as pool:
        waiting = {pool.submit(run, "train", *job, processes): job[0] for job in missing.items()}
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                name, output = waiting[future].name, log_of(waiting[future])
                if future.result():
                    text = output.read_text(encoding="utf-8", errors="replace") if output.is_file() else ""
                    last = (text.strip().splitlines() or ["it left no output."])[-1]
                    lost[name] = f"training of {name} failed: {last} See {output}."
                    log.error("%s", lost[name])
                    continue
                spent = time.perf_counter() - started
                left = spent / done * (len(missing) - done)
                told = f"({done} of {len(missing)}, {spent:.0f} s, about {left:.0f} s left)"
                print(f"trained {name} {told}", flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                if process.poll() is None:
                    process.terminate()  # a training that is asked to stop keeps its checkpoint
            raise
    return lost
