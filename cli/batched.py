"""`hydra/launcher=batched`: jobs of a sweep that share what they have in common, on all cores of one machine.

The first job runs in this process, and what does not depend on its seed or its trainer is kept (`nsde_torch.recall`).
The others are forked from it, so that they find that in memory, as many at a time as there are cores.
"""

import logging
import multiprocessing
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import ModuleType
from typing import Any

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, configure_log, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from nsde_torch.recall import remembering

log = logging.getLogger(__name__)


class Batched(Launcher):
    """See above; `n_jobs` at a time (0: one for each core)."""

    __module__ = "hydra_plugins.nsde_torch"  # see `register`

    def __init__(self, n_jobs: int = 0) -> None:
        self.n_jobs = n_jobs or os.cpu_count() or 1

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Keep what jobs are made of."""
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run jobs; returns what each returned, in their order."""
        setup_globals()
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        Path(str(self.config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        jobs = [(initial_job_idx + k, list(words)) for k, words in enumerate(job_overrides)]
        with remembering():
            done = [*(self._run(*job) for job in jobs[:1]), *self._forked(jobs[1:])]
        configure_log(self.config.hydra.hydra_logging, self.config.hydra.verbose)
        return done

    def _forked(self, jobs: Sequence[tuple[int, list[str]]]) -> list[JobReturn]:
        """The same in processes forked from this one. A pool forks from a thread of its own, and may stop for ever."""
        context, waiting = multiprocessing.get_context("fork"), list(jobs)
        running: dict[Any, tuple[int, BaseProcess]] = {}  # by the connection that the result comes from
        done: dict[int, JobReturn] = {}
        while waiting or running:
            while waiting and len(running) < self.n_jobs:
                number, words = waiting.pop(0)
                ours, theirs = context.Pipe(duplex=False)
                process: BaseProcess = context.Process(target=self._sent, args=(theirs, number, words))
                process.start()
                theirs.close()
                running[ours] = number, process
            ready: Any
            for ready in wait(list(running)):
                number, process = running.pop(ready)
                with suppress(EOFError):
                    done[number] = ready.recv()
                process.join()
                if number not in done:
                    raise RuntimeError(f"job {number} ended with exit status {process.exitcode}.")
        return [done[number] for number, _ in jobs]

    def _sent(self, to: Connection, number: int, words: list[str]) -> None:
        to.send(self._run(number, words))

    def _run(self, number: int, words: list[str]) -> JobReturn:
        log.info(f"\t#{number} : {' '.join(filter_overrides(words))}")
        config = self.context.config_loader.load_sweep_config(self.config, words)
        with open_dict(config):
            config.hydra.job.id = number
            config.hydra.job.num = number
        return run_job(
            hydra_context=self.context,
            task_function=self.task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )


def register() -> None:
    """Let Hydra know of the launcher, which it takes from the package `hydra_plugins` alone."""
    Plugins.instance().register(Batched)
    parent = sys.modules.setdefault("hydra_plugins", ModuleType("hydra_plugins"))
    sys.modules[Batched.__module__] = parent.nsde_torch = sys.modules[__name__]  # type: ignore[attr-defined]
