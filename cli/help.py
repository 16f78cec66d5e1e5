"""`nsde COMMAND --help`: the config groups and choices, then every key with default, unit and meaning."""

import dataclasses
import os
import textwrap
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from . import groups
from .keys import Key
from .registry import all_commands, hydra_command
from .schemas import CHOICES

WIDTH = 100
_COLUMN = 38
_SCREEN = 50  # lines of help that are shown at once


def describe(command: str, words: Sequence[str]) -> str:
    """Help of a command for the choices among the words; `all` adds the keys of groups that do not fit a screen."""
    lines = _described(command, words, left_out=())
    if "all" not in words and len(lines) > _SCREEN:
        inside = {e.path.split(".")[0]: None for e in groups.typed_keys(command, words) if "." in e.path}
        named = {word.partition("=")[0] for word in words}
        lines = _described(command, words, left_out=[name for name in inside if name not in named])
    return "\n".join(lines)


def _described(command: str, words: Sequence[str], *, left_out: Collection[str]) -> list[str]:
    summary, chosen = all_commands()[command].summary, groups.selected(command, words)
    lines = [
        f"nsde {command}: {summary[0].lower()}{summary[1:]}",
        "",
        f"Usage: nsde {command}{' [group=choice ...]' if chosen else ''} [key=value ...] [--config-dir DIR]"
        + (" [-m]" if groups.sweeps(command) else ""),
    ]
    if chosen:
        lines += ["", "Config groups (* is chosen now; `--help data=csv` shows the keys of another choice)"]
        lines += _group_lines(chosen, groups.config_dir(words))
    section = None
    for entry in groups.typed_keys(command, words):
        name = entry.path.split(".")[0] if "." in entry.path else ""
        if name in left_out:
            continue
        if name != section:
            of = f"{name}={chosen[name]}" if chosen.get(name, groups.NOTHING) != groups.NOTHING else name
            lines += [*_others(section, chosen), "", f"Keys of {of}" if name else "Keys"]
            section = name
        lines += _key_lines(entry)
    lines += _others(section, chosen)
    lines += ["", f"`--help all` has the keys of {', '.join(left_out)} too"] if left_out else []
    return [*lines, "", *_usage(command)]


def value_text(value: Any) -> str:
    """A default as the user would type it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(value_text(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _group_lines(chosen: dict[str, str], extra: Path | None) -> Iterator[str]:
    for name, choice in chosen.items():
        options = groups.choices(name, extra)
        text = " | ".join(f"{option}*" if option == choice else option for option in options)
        yield from _wrapped(text, f"  {name:<9}", 11)


def _key_lines(entry: Key) -> Iterator[str]:
    default = "(required)" if entry.default == "???" else value_text(entry.default)
    if entry.path in ("run_dir", "sweep_dir", "out_dir") and entry.default == "???":
        default = "(dated)"
    left = f"  {entry.path}={default}" + (f" [{entry.unit}]" if entry.unit else "")
    right = entry.help + (f" ({entry.allowed})" if entry.allowed else "")
    if len(left) >= _COLUMN:
        yield left
        left = ""
    yield from _wrapped(right, f"{left:<{_COLUMN}}", _COLUMN)


def _others(section: str | None, chosen: dict[str, str]) -> list[str]:
    """A line on the keys that other choices of a group have and the chosen one has not."""
    own = CHOICES.get(section or "", {})
    if section is None or chosen.get(section) not in own:
        return []
    names = {choice: [field.name for field in dataclasses.fields(schema)] for choice, schema in own.items()}
    lines = []
    for choice, every in names.items():
        if more := [f"{section}.{name}" for name in every if name not in names[chosen[section]]]:
            lines += _wrapped(f"{section}={choice} has also: {', '.join(more)}", "  ", 4)
    return lines


def _wrapped(text: str, start: str, indent: int) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=start, subsequent_indent=" " * indent, break_on_hyphens=False
    )


def _usage(command: str) -> list[str]:
    rows = [*hydra_command(command).examples, ("--cfg job", "print the configuration and stop")]
    lines = [f"{f'  nsde {command} {words}':<45} {meaning}".rstrip() for words, meaning in rows]
    return ["How to override (NSDE_TRACEBACK=1 shows the traceback of an error)", *lines]


# --- what the shell offers after `nsde COMMAND ...`: groups, choices, keys, allowed words, files --------------------

_FLAGS = ("--help", "--config-dir", "--multirun", "--cfg", "--info")
_HYDRA_CHOICES = {
    "hydra/launcher": ("basic", "batched", "joblib", "submitit_local", "submitit_slurm", "ray"),
    "hydra/sweeper": ("basic", "optuna"),
}


def completions(command: str, words: Sequence[str]) -> list[str]:
    """Completions of the last of the words typed after the name of a command that takes overrides; it may be empty."""
    current = words[-1] if words else ""
    before = list(words[:-1])
    if before and before[-1] in ("--config-dir", "-cd"):
        return found_files(current)
    hydra_groups = _HYDRA_CHOICES if groups.sweeps(command) else {}
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


def found_files(start: str) -> list[str]:
    """Files and folders that begin with `start`; a folder ends with a slash."""
    folder, _, begin = start.rpartition("/")
    base = Path(folder or ("/" if start.startswith("/") else "."))
    if not base.is_dir():
        return []
    prefix = f"{folder}/" if "/" in start else ""
    found = [entry for entry in os.scandir(base) if entry.name.startswith(begin)]
    seen = [entry for entry in found if begin.startswith(".") or not entry.name.startswith(".")]
    return sorted(f"{prefix}{entry.name}{'/' if entry.is_dir() else ''}" for entry in seen)


def _values(command: str, before: Sequence[str], name: str, value: str) -> list[str]:
    # In a sweep the choices are a list, `seed=0,1`: complete its last item.
    done, comma, last = value.rpartition(",")
    options: Sequence[str]
    if name in groups.defaults(command):
        options = groups.choices(name, groups.config_dir(before))
    elif name in _HYDRA_CHOICES:
        options = _HYDRA_CHOICES[name]
    elif name in groups.files(command):
        # A list of folders, `run=[a,b`: complete its last item.
        done, comma, last = value.rpartition(",") if value.startswith("[") else ("", "", value)
        if value.startswith("[") and not comma:
            comma, last = "[", value[1:]
        options = found_files(last)
    else:
        options = ()
        for entry in groups.typed_keys(command, before):
            if entry.path == name:
                words = ("true", "false") if isinstance(entry.default, bool) else ()
                options = entry.choices or words
    return [f"{done}{comma}{option}" for option in options if option.startswith(last)]
