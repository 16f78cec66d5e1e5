"""What the shell offers after `nsde COMMAND ...`: groups, choices, keys, allowed words, files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from . import groups

_FLAGS = ("--help", "--config-dir", "--multirun", "--cfg", "--info")
_HYDRA_GROUPS = {
    "hydra/launcher": ("basic", "batched", "joblib", "submitit_local", "submitit_slurm", "ray"),
    "hydra/sweeper": ("basic", "optuna"),
}


def overrides(command: str, words: Sequence[str]) -> list[str]:
    """Completions of the last of the words typed after the name of a command that takes overrides; it may be empty."""
    current = words[-1] if words else ""
    before = list(words[:-1])
    if before and before[-1] in ("--config-dir", "-cd"):
        return files(current)
    hydra_groups = _HYDRA_GROUPS if groups.sweeps(command) else {}
    if current.startswith("-"):
        flags = [flag for flag in _FLAGS if flag != "--multirun" or groups.sweeps(command)]
        return [flag for flag in flags if flag.startswith(current)]
    chosen = groups.selected(command, before)
    name, equals, value = current.partition("=")
    if equals:
        return [f"{name}={option}" for option in _values(command, before, name, value)]
    names = [f"{group}=" for group in [*chosen, *hydra_groups]]
    names += [f"{entry.path}=" for entry in groups.typed_keys(command, before)]
    matching = [option for option in names if option.startswith(current)]
    # As a shell does with folders: a group's keys are offered once its name and a dot are typed.
    depth = current.count(".")
    near = [option for option in matching if option.split("=")[0].count(".") <= depth]
    deeper = {".".join(option.split(".")[: depth + 1]) + "." for option in matching if option not in near}
    return sorted({*near, *deeper})


def files(start: str) -> list[str]:
    """Files and folders that begin with `start`; a folder ends with a slash."""
    folder, _, begin = start.rpartition("/")
    base = Path(folder or ("/" if start.startswith("/") else "."))
    if not base.is_dir():
        return []
    prefix = f"{folder}/" if "/" in start else ""
    found = [entry for entry in os.scandir(base) if entry.name.startswith(begin)]
    return sorted(
        f"{prefix}{entry.name}/" if entry.is_dir() else f"{prefix}{entry.name}"
        for entry in found
        if begin.startswith(".") or not entry.name.startswith(".")
    )


def _values(command: str, before: Sequence[str], name: str, value: str) -> list[str]:
    # In a sweep the choices are a list, `seed=0,1`: complete its last item.
    done, comma, last = value.rpartition(",")
    options: Sequence[str]
    if name in groups.defaults(command):
        options = groups.choices(name, groups.config_dir(before))
    elif name in _HYDRA_GROUPS:
        options = _HYDRA_GROUPS[name]
    elif name in groups.files(command):
        # A list of folders, `run=[a,b`: complete its last item.
        done, comma, last = value.rpartition(",") if value.startswith("[") else ("", "", value)
        if value.startswith("[") and not comma:
            comma, last = "[", value[1:]
        options = files(last)
    else:
        options = ()
        for entry in groups.typed_keys(command, before):
            if entry.path == name:
                words = ("true", "false") if isinstance(entry.default, bool) else ()
                options = entry.choices or words
    return [f"{done}{comma}{option}" for option in options if option.startswith(last)]
