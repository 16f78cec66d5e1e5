"""What all commands configured by Hydra share: help, completion, runs, sweeps, resuming and messages."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.errors import CheckpointError, ConfigError, NsdeError

from . import groups, help, messages
from .exit_status import CRASHED, FAILED_JOBS, INTERRUPTED, OK, USER_ERROR, EndedError
from .groups import without_file
from .quoted import as_typed, coordinates_named, path_word, quoted, typed_path
from .registry import hydra_commands
from .schemas import CHOICES, NAMES

if TYPE_CHECKING:
    from omegaconf import DictConfig as Config
else:
    Config = Any  # omegaconf's: help and completion do without that

_CONFIG_PATH = "pkg://nsde_torch.conf"
_TRACEBACK = "NSDE_TRACEBACK"
# Hydra's own folders with the keys of ours that set them, and its names of the files inside.
_HYDRA_FOLDERS = {"hydra.run.dir": "run_dir or out_dir", "hydra.sweep.dir": "sweep_dir"}
_HYDRA_GROUPS = ("hydra", "hydra.run", "hydra.sweep", "hydra.job")  # that hold these
_HYDRA_NAMES = ("hydra.output_subdir", "hydra.sweep.subdir", "hydra.job.name")
_LONG = {"-cd": "config-dir", "-cn": "config-name", "-c": "cfg", "-p": "package", "-i": "info"}
WITH_VALUE = {short: f"--{long}" for short, long in _LONG.items()}
"""Hydra's options that are followed by a value, and their long names."""

TEXTS = __file__  # beside the templates of what commands print (`nsde_torch.texts`)
say = partial(print, flush=True)  # prints a line at once, of work that goes on


@dataclass(frozen=True)
class Job:
    """What a command's function is given beside its configuration."""

    run_dir: Path  # folder of this job, made by Hydra
    began: float = field(default_factory=time.perf_counter)

    @property
    def took(self) -> str:
        """How long it has taken so far, `took 3 s`."""
        return f"took {time.perf_counter() - self.began:.0f} s"


@dataclass(frozen=True, kw_only=True)
class HydraCommand:
    """A command whose configuration is composed by Hydra, from its schema and the choices of its groups in `conf/`."""

    name: str  # name of the command
    schema: type
    """Dataclass of its keys (`nsde_torch.cli.keys`). The function `run(config, job)` of its module does the work on the
    composed and checked configuration."""
    groups: Mapping[str, str | None] = field(default_factory=dict)
    """Config groups with the choice that each has by default, in order; None for none."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Values beside the defaults of the schema, as nested mappings."""
    folder: str | None = None
    """Pattern of the folder of a run, for the key `run_dir` or `out_dir`; None for a command without one."""
    result: tuple[str, str] | None = None
    """File that a finished run holds, and what it is called: a folder that has it is not written over."""
    goes_on: bool = False
    """Whether the same command, started again on its folder, goes on from what is finished there."""
    unnamed: tuple[str, ...] = ()  # keys that do not name the jobs of a sweep
    words: Callable[[Sequence[str]], list[str]] = list
    """What is typed, one word at a time, as Hydra is to have it."""
    examples: tuple[tuple[str, str], ...] = ()  # words and what they do, for the help

    @property
    def keys(self) -> list[str]:
        """The keys and groups of the command itself."""
        return [key.name for key in fields(self.schema)]

    @property
    def folder_key(self) -> str:
        """The key that names the folder of a run."""
        return "run_dir" if "run_dir" in self.keys else "out_dir"

    def main(self, arguments: Sequence[str]) -> int:
        """Run the command; returns the exit status."""
        words = _reader_chosen(self.words(arguments), self.name)
        if "-h" in words or "--help" in words:
            print(help.describe(self.name, words))
            return OK
        # A queue that ends a job sends SIGTERM: its log says how to resume, as after Ctrl-C. Only the main thread can.
        with contextlib.suppress(ValueError):
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            return self._run(self._prepare(words))
        except KeyboardInterrupt:
            return self._interrupted()
        except EndedError as error:
            print(f"nsde {self.name}: {error}", file=sys.stderr)
            return error.status
        except NsdeError as error:
            return self._user_error(error, messages.in_keys(str(error), self.keys))
        except BrokenPipeError:
            raise  # `nsde effects | head`: the caller ends without a word
        except Exception as error:
            message = messages.explain(error, self.name, words) or self._sweep_message()
            if message is None:
                traceback.print_exception(error)
                return CRASHED
            return self._user_error(error, message)

    def complete(self, words: Sequence[str]) -> list[str]:
        """Completions of the last of the words typed after the command's name."""
        return help.completions(self.name, words)

    def _prepare(self, words: list[str]) -> list[str]:
        """The words for Hydra: open dicts opened, a resumed run's choices back, the config folder seen.

        `system=module:Class` names no choice of the group, and so its key `name`.
        """
        folder = groups.config_dir(words)
        if folder is not None:
            if not folder.is_dir():
                raise ConfigError(f"`--config-dir {folder}`: no such folder.")
            groups.check_own_files(folder, groups.selected(self.name, words))
            sys.path.insert(0, str(folder.resolve()))
        sweep = "-m" in words or "--multirun" in words
        if sweep:
            if "sweep_dir" not in self.keys:
                raise ConfigError(f"`nsde {self.name}` has no sweeps; leave out -m.")
            if any(word.startswith("run_dir=") for word in words):
                raise ConfigError("`run_dir` is the folder of one run; a sweep takes `sweep_dir=...`.")
            if _resumed(words) is not None:
                raise ConfigError("`resume` continues one run; leave out -m.")
            if any(word.startswith("hydra/sweeper=optuna") for word in words):
                # a failed job is a failed trial, not the end of the sweep; what was typed comes later, and wins
                words = ["hydra.sweeper.max_failure_rate=1.0", *words]
        _check_folders(words)
        words = [re.sub(r"^system=(?=[\w.]+:\w)", "system.name=", word) for word in words]
        resumed, files = _resumed(words), groups.files(self.name)
        words = [path_word(word, files, sweep=sweep) for word in words]
        if resumed is not None:
            words = _resume(words, resumed, self.folder_key)
        return _options_first([_opened(coordinates_named(word), self.name) for word in words])

    def _run(self, words: list[str]) -> int:
        import hydra

        from .jobs import LAST, HydraJob

        LAST.reset()
        store(self)
        if "hydra/launcher=batched" in words:
            from .batched import register

            register()
        # Hydra prints errors and exits by itself unless asked to raise them, which lets us word them.
        os.environ["HYDRA_FULL_ERROR"] = "1"
        old, sys.argv = sys.argv, [f"nsde {self.name}", *words]
        try:
            job = HydraJob(self.name, self.schema.__module__, folder=self.folder is not None)
            with _composed_once(words):
                hydra.main(version_base="1.3", config_path=_CONFIG_PATH, config_name=self.name)(job)()
        finally:
            sys.argv = old
        if LAST.sweep_dir is not None:
            return self._sweep_status(LAST.sweep_dir)
        if LAST.error is not None:
            raise LAST.error
        return OK

    def _sweep_status(self, sweep_dir: Path) -> int:
        from .jobs import failed_jobs

        failed = failed_jobs(sweep_dir)
        if failed:
            names = "\n  ".join(map(str, failed))
            print(f"nsde {self.name}: {len(failed)} job(s) failed:\n  {names}", file=sys.stderr)
        print(f"Compare the jobs with: {_report(sweep_dir)}")
        return FAILED_JOBS if failed else OK

    def _sweep_message(self) -> str | None:
        """What to say if the sweeper gave up because no job was left."""
        from .jobs import LAST, failed_jobs

        if LAST.sweep_dir is None or not failed_jobs(LAST.sweep_dir):
            return None
        return f"the sweep stopped after failed jobs; see: {_report(LAST.sweep_dir)}"

    def _user_error(self, error: Exception, message: str) -> int:
        if os.environ.get(_TRACEBACK) == "1":
            traceback.print_exception(error)
        print(f"nsde {self.name}: {message}", file=sys.stderr)
        return USER_ERROR

    def _interrupted(self) -> int:
        from .jobs import LAST, record

        line = f"nsde {self.name}: interrupted."
        if LAST.sweep_dir is not None:
            line += f" Finished jobs are in {LAST.sweep_dir}; see: {_report(LAST.sweep_dir)}"
        elif LAST.run_dir is not None and _holds_no_work(LAST.run_dir):
            # recorded as failed, so that its folder is free again
            record(KeyboardInterrupt(), LAST.run_dir, "interrupted")
            line += " There is nothing to continue yet: start the same command again."
        elif LAST.run_dir is not None and "resume" in self.keys:
            line += f" Continue with: {as_typed('nsde', self.name, paths={'resume': LAST.run_dir})}"
        elif LAST.run_dir is not None and self.goes_on:
            line += " What is finished is kept: start the same command again with "
            line += f"{as_typed(paths={'out_dir': LAST.run_dir})} to go on."
        print(f"\n{line}", file=sys.stderr)
        return INTERRUPTED


@contextlib.contextmanager
def _composed_once(words: Sequence[str]) -> Iterator[None]:
    """Without Hydra's first composition, a third of a second, which only reads `hydra.mode`: words may set that."""
    from hydra._internal import hydra

    owner: Any = hydra.Hydra
    composes = owner.get_mode
    typed = any(word.lstrip("+").startswith("hydra.mode") for word in words)
    if not typed and groups.config_dir(words) is None:
        owner.get_mode = lambda *_, **__: None
    try:
        yield
    finally:
        owner.get_mode = composes


def _resumed(words: Sequence[str]) -> Path | None:
    """The folder of the run that is to be continued."""
    found = [word.partition("=")[2] for word in words if word.startswith("resume=")]
    return Path(typed_path(found[-1])) if found and found[-1] not in ("", "null") else None


def _reader_chosen(words: list[str], command: str) -> list[str]:
    """The words with `data=log` where a path is named and no reader: then the names of the files decide the format."""
    typed = [word.partition("=")[0].lstrip("+") for word in words]
    open_ = "data" in groups.defaults(command) and _resumed(words) is None
    return ["data=log", *words] if open_ and "data.path" in typed and "data" not in typed else words


def _check_folders(words: Sequence[str]) -> None:
    """Refuse folders that no key of the command names, or that hold a run, before Hydra touches them."""
    for word in words:
        key, _, value = word.lstrip("+").partition("=")
        folder = Path(typed_path(value))
        if wrong := _wrong_with(key, value, folder):
            raise ConfigError(f"`{key}` {wrong}")
        if held := _held(key, folder):
            raise ConfigError(f"`{key}={folder}` holds {held}")


def _wrong_with(key: str, value: str, folder: Path) -> str:
    if key in _HYDRA_FOLDERS:
        return f"is set by the command: name the folder with {_HYDRA_FOLDERS[key]}=..."
    if key in _HYDRA_GROUPS:
        return f"is set key by key: {key}.KEY=VALUE; got {value!r}."
    if key in _HYDRA_NAMES and (folder.is_absolute() or ".." in folder.parts):
        return f"must be a name in the folder of the run, without `..`; got {value!r}."
    nameless = key in ("run_dir", "sweep_dir", "out_dir") and not value.strip("'\"")
    return "is empty; name a folder." if nameless else ""


def _held(key: str, folder: Path) -> str:
    """What a folder holds that would be written over."""
    # a run that failed before it did any work (a wrong key, a missing file) has nothing to keep or continue
    if key == "run_dir" and (folder / ".hydra").is_dir():
        failed = (folder / "failed.json").is_file() and _holds_no_work(folder)
        more = f"Continue it with {as_typed(paths={'resume': folder})}, or name another."
        return "" if failed else f"a run already. {more}"
    if key == "out_dir":
        results = [command.result for command in hydra_commands().values() if command.result]
        held = next((called for file, called in results if (folder / file).is_file()), None)
        return f"{held} already; name another folder." if held else ""
    swept = key == "sweep_dir" and (folder / "multirun.yaml").is_file()
    return "a sweep already; name another folder." if swept else ""


def _holds_no_work(folder: Path) -> bool:
    return all(path.name in (".hydra", "failed.json") or path.suffix == ".log" for path in folder.iterdir())


def _report(sweep_dir: Path) -> str:
    folder = f"./{sweep_dir}" if str(sweep_dir).startswith("-") else str(sweep_dir)
    return as_typed("nsde", "sweep-report", folder, paths={})


def _opened(word: str, command: str) -> str:
    """`system.parameters.mass=1` adds to a dict that is open by design; Hydra wants that said with `++`."""
    path = f"{word.split('=', 1)[0]}."
    opened = any(e.default == {} and path.startswith(f"{e.path}.") for e in groups.every_key(command))
    return f"++{word}" if opened else word


def _options_first(words: Sequence[str]) -> list[str]:
    """Options before overrides, with their values: Hydra's parser does not take `seed=1 -cd DIR` or `-cd -DIR`."""
    options: list[str] = []
    overrides: list[str] = []
    rest = iter(words)
    for word in rest:
        name = WITH_VALUE.get(word, word)
        if word.startswith(("=", "~")):
            raise ConfigError(f"`{word}` is not KEY=VALUE; no key can be taken out of the configuration.")
        if not word.startswith("-"):
            overrides.append(word)
        elif name in WITH_VALUE.values() and (value := next(rest, None)) is not None:
            options.append(f"{name}={value}")
        else:
            options.append(word)
    return [*options, *overrides]


def _resume(words: list[str], folder: Path, key: str) -> list[str]:
    """The command line of the run in `folder`, which `key` names, followed by what was typed now."""
    from nsde_torch.plain_yaml import read_yaml

    stored = folder / ".hydra" / "overrides.yaml"
    if not stored.is_file():
        raise CheckpointError(f"`resume={folder}`: there is no run to continue (no {stored}).")
    try:
        typed = [str(word) for word in read_yaml(stored) or []]
        started = read_yaml(folder / ".hydra" / "hydra.yaml")
        sources = [
            (str(s["provider"]), str(s["path"])) for s in started["hydra"]["runtime"]["config_sources"]
        ]
    except (ConfigError, LookupError, TypeError) as error:
        raise CheckpointError(
            f"`resume={folder}`: the record of its command in {stored.parent} is damaged. Start the command again in "
            "another folder."
        ) from error
    before = [word for word in typed if not word.startswith(("resume=", f"{key}="))]
    # Hydra's record of the first start stays as it is, so that the run can be continued again.
    name = quoted(str(folder))
    fixed = [f"{key}={name}", f"hydra.run.dir={name}", "hydra.output_subdir=null"]
    for provider, path in sources:
        if provider == "command-line" and groups.config_dir(words) is None:
            sys.path.insert(0, path)
            fixed = ["--config-dir", path, *fixed]
    return [*before, *words, *fixed]


# what Hydra composes a configuration from: schemas, groups, a defaults list made of the command, its folder

_TOLD: list[Any] = []  # what holds the choices of this module's own schemas


def store(command: HydraCommand) -> None:
    """Tell Hydra of a command; schemas stand apart from the choices, in the group `schema`."""
    from hydra.core.config_store import ConfigStore

    known = ConfigStore.instance()
    known.store(group="schema", name=command.name, node=command.schema)
    known.store(name=command.name, node=primary(command))
    if _TOLD and _TOLD[0] is known.repo:
        return  # these are of no command alone, and take Hydra a tenth of a second
    _TOLD[:] = [known.repo]
    launcher = {"_target_": "hydra_plugins.nsde_torch.Batched", "n_jobs": 0}  # see `cli.batched`
    known.store(group="hydra/launcher", name="batched", node=launcher, provider="nsde_torch")
    for group_name in {**CHOICES, **NAMES}:
        for choice, node in without_file(group_name).items():
            known.store(group=group_name, name=choice, node=node)
    for group_name, choices in CHOICES.items():
        for choice, schema in choices.items():
            known.store(group=f"schema/{group_name}", name=choice, node=schema)


def primary(command: HydraCommand) -> dict[str, Any]:
    """The content of a command's primary config: defaults list, values, and where Hydra writes."""
    chosen = [{group: choice} for group, choice in command.groups.items() if choice is not None]
    # a group without a choice comes last: what is chosen for it wins over the command's own values
    open_groups = [{group: None} for group, choice in command.groups.items() if choice is None]
    defaults: list[Any] = [f"/schema/{command.name}@_here_", *chosen, "_self_", *open_groups]
    hydra: dict[str, Any] = {"job": {"name": command.name, "chdir": False}}
    content: dict[str, Any] = {"defaults": defaults, **command.values, "hydra": hydra}
    if command.folder is None:
        # no configuration and no log: beside data of a simulation they would say what is in them
        defaults.append({"override hydra/job_logging": "stdout"})
        hydra |= {"output_subdir": None, "run": {"dir": "."}}
        return content
    content[command.folder_key] = command.folder
    hydra["run"] = {"dir": f"${{{command.folder_key}}}"}
    if "sweep_dir" in command.keys:
        content["sweep_dir"] = "multirun/${now:%Y-%m-%d}/${now:%H-%M-%S}"
        hydra["job"]["config"] = {"override_dirname": {"exclude_keys": list(command.unnamed)}}
        # The overrides name the job; slashes, brackets and quotes would not make a good folder.
        subdir = "${hydra.job.num}_${nsde.folder:${hydra:job.override_dirname}}"
        hydra["sweep"] = {"dir": "${sweep_dir}", "subdir": subdir}
        hydra["callbacks"] = {"nsde_sweep_watch": {"_target_": "nsde_torch.cli.jobs.SweepWatch"}}
    return content
