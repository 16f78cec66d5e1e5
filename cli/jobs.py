"""One job of a command: a single run, or one of a sweep, whose failure must not take the others along.

Hydra stops a sweep at a job that raises, and a launcher in other processes loses the reason. So a job's
failure is written to `failed.json` in its own folder, and the command counts these files at the end.
"""

import importlib
import json
import logging
import re
import traceback
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from nsde_torch.errors import ConfigError, NsdeError
from nsde_torch.progress import LOG as PROGRESS_LOG

from . import messages
from .hydra_command import Job
from .keys import check
from .own_modules import config_folders, see_folders

FAILED = "failed.json"
_LONGEST_NAME = 120

log = logging.getLogger(__name__)


def folder_name(overrides: str) -> str:
    """The overrides of a job as part of a folder's name: no slashes, quotes or brackets, and not too long."""
    return re.sub(r"[^\w.=,+-]+", "_", overrides).strip("_")[:_LONGEST_NAME]


# Here, because a launcher's worker process imports this module with the task before it needs the folder.
OmegaConf.register_new_resolver("nsde.folder", folder_name, replace=True)


@dataclass
class JobOutcome:
    """What the main process knows of its last run or sweep."""

    run_dir: Path | None = None
    sweep_dir: Path | None = None
    error: Exception | None = None

    def reset(self) -> None:
        self.run_dir = self.sweep_dir = self.error = None


LAST = JobOutcome()


@dataclass(frozen=True)
class HydraJob:
    """What Hydra calls for a job, and a launcher sends to other processes: names, and nothing that must be pickled."""

    command: str
    module: str  # module whose function `run(config, job)` does the work, imported when there is some
    folder: bool  # whether the job has a folder, into which a failure is written

    def __call__(self, config: DictConfig) -> float | None:
        """Check a configuration and run the job; its objective, None without one or where a failure was recorded."""
        hydra = HydraConfig.get()
        job, sweep = Job(Path(hydra.runtime.output_dir)), hydra.mode == RunMode.MULTIRUN
        LAST.error = None
        if self.folder:
            LAST.run_dir = job.run_dir
            (job.run_dir / FAILED).unlink(missing_ok=True)
        see_folders(config_folders(hydra.runtime.config_sources))  # in a launcher's worker process too
        _progress_to_files_alone()
        try:
            check_config(config, self.command, list(hydra.overrides.task))
            if "threads" in config:
                import torch

                torch.set_num_threads(1 if sweep else config.threads)  # beside a job of a sweep others run
            objective: float | None = importlib.import_module(self.module).run(config, job)
            return objective
        except Exception as error:
            LAST.error = error
            message = messages.in_keys(str(error), config) if isinstance(error, NsdeError) else str(error)
            if self.folder:
                record(error, job.run_dir, message)
            if sweep:
                log.error("job failed: %s", message)  # a single run's error is printed by the command
            return None


def _progress_to_files_alone() -> None:
    """Leave progress, which the terminal shows by itself, out of Hydra's log there."""
    for handler in logging.getLogger().handlers:
        if not isinstance(handler, logging.FileHandler):
            handler.addFilter(lambda record: record.name != PROGRESS_LOG.name)


def check_config(config: DictConfig, command: str, words: list[str], prefix: str = "") -> None:
    """Refuse keys that no schema has (`+key=...` lets them in), missing values and values out of range."""
    schema: Any = OmegaConf.get_type(config)
    values: Any = OmegaConf.to_container(config, resolve=True)
    if not (isinstance(schema, type) and is_dataclass(schema)):
        return
    help_of = {field.name: field.metadata["help"] for field in fields(schema)}
    for name, value in values.items():
        path = f"{prefix}{name}"
        if name not in help_of:
            raise ConfigError(messages.unknown_key(path, command, words))
        if value == "???":
            raise ConfigError(f"`{path}` must be given: {help_of[name]}. Add {path}=... to the command.")
        if isinstance(value, dict):
            check_config(config[name], command, words, f"{path}.")
    check(schema, values, prefix)


def record(error: BaseException, folder: Path, message: str) -> None:
    """Write why a job ended into its folder."""
    text = "".join(traceback.format_exception(error))
    content = {"error": type(error).__name__, "message": message, "traceback": text}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / FAILED).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


class SweepWatch(Callback):
    """Remembers the folder of a sweep, so that the command can say at the end what became of its jobs."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Called by Hydra once, in the main process, before the first job."""
        LAST.sweep_dir = Path(config.hydra.sweep.dir)


def failed_jobs(sweep_dir: Path) -> list[Path]:
    """The folders of the jobs of a sweep that recorded a failure."""
    return sorted(path.parent for path in sweep_dir.glob(f"**/{FAILED}"))
