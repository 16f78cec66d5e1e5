"""`nsde inspect`: what is in a log, what its columns mean to a system, whether that is so; writes the mapping."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from nsde_torch.aligned import aligned
from nsde_torch.errors import ConfigError

from .. import messages
from ..exit_status import FAILED_JOBS, OK, USER_ERROR
from ..own_modules import own_system, split_config_dir
from ..quoted import as_typed
from ..registry import PlainCommand

if TYPE_CHECKING:
    from nsde_torch.api.inspecting import Inspection

KEYS = {
    "system": "machine that the log is of: name, or module:Class of your own; left out: guessed",
    "system.options.NAME": "further argument of the machine's class (system.options.yaw_direction=-1)",
    "kind": "reader of the format; left out: by the names of the files",
    "mapping": "YAML file of a mapping to check; left out: mapping.yaml beside the logs, else one is proposed",
    "out": "file to write the mapping to; left out: mapping.yaml beside the logs; none: nothing is written",
    "overwrite": "true replaces a mapping that is there by a proposal",
    "physics": "false leaves out the fit of the declared physics",
    "json": "file to write all that was found to, for a program",
    "columns": "all lists every column, else those that move (40 at most)",
}
_HELP = """Usage: nsde inspect LOG [KEY=VALUE ...] [--config-dir DIR]

List what is in a log or a folder of logs, propose what its columns mean to a system, check that by kinematics and by
the signs of the physics, and write it as mapping.yaml, which `data=log` and the readers of the formats use.

"""
_OPTION = "system.options."
_SHOWN = 40
_MARKS = {True: "ok  ", False: "NO  ", None: "?   "}


def main(arguments: Sequence[str]) -> int:
    """Print what is in a log, and write the mapping; returns the exit status (1: it cannot be used so)."""
    words = list(arguments)
    if not words or "-h" in words or "--help" in words:
        width = max(map(len, KEYS))
        print(_HELP + "\n".join(f"  {key:<{width}}  {text}" for key, text in KEYS.items()))
        print("\n  --config-dir DIR  folder with system/NAME.yaml and the modules of a machine of your own")
        return OK if words else USER_ERROR

    import torch

    from nsde_torch.api.inspecting import inspect
    from nsde_torch.data.mapping.reader import format_of, mapping_beside
    from nsde_torch.data.readers import READERS
    from nsde_torch.systems.options import SystemOptions

    torch.set_num_threads(1)
    folder, words = split_config_dir(words)
    path, given = _given(words)
    sys.path.insert(0, str((folder or Path.cwd()).resolve()))  # a system of the user's own, in a file there
    target = None if given.get("out") == "none" else Path(given.get("out") or _beside(path))
    # what lies beside the logs is what they will be read by, unless another one is to be written
    proposes = given.get("overwrite") == "true" or target not in (None, _beside(path))
    kind = given.get("kind") or format_of(path)
    there = mapping_beside(path) if kind in READERS and READERS[kind].mapped and not proposes else None
    options = {k.removeprefix(_OPTION): _value(k, v) for k, v in given.items() if k.startswith(_OPTION)}
    if options and "system" not in given:
        raise ConfigError(f"`{_OPTION}{next(iter(options))}` is of a machine: name it, system=NAME.")
    machine = own_system(given["system"], folder) if "system" in given else None
    found = inspect(
        path,
        system=SystemOptions(machine, options=options) if machine else None,
        kind=given.get("kind"),
        mapping=given.get("mapping") or there,
        physics=given.get("physics", "true") != "false",
    )
    print(report(found, everything=given.get("columns") == "all"))
    if "json" in given:
        _save(Path(given["json"]), json.dumps(found.content(), indent=1, allow_nan=False) + "\n", "json")
    if found.mapping is not None and "mapping" not in given and target is not None:
        print(_write(found, target, overwrite=given.get("overwrite") == "true"))
    used = Path(given["mapping"]) if "mapping" in given else target
    words = [] if folder is None else ["--config-dir", str(folder)]
    words.append(f"system={given.get('system', found.system)}")
    words += [f"{_OPTION}{k}={v}" for k, v in options.items()]
    named = found.native or used is None or used == _beside(path)
    paths = {"data.path": path} if named else {"data.path": path, "data.mapping": used}
    train = as_typed("nsde", "train", *words, f"data={found.kind}", paths=paths)
    again = as_typed("nsde", "inspect", path, *words, "mapping=FILE", paths={})
    print(f"\nnext: {_next(found, train, again)}")
    return OK if found.usable else FAILED_JOBS


def _value(key: str, text: str) -> Any:
    """The value of an option of the machine, as training reads it."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise ConfigError(f"`{key}={text}`: {text!r} is no value.") from None


def _next(found: Inspection, train: str, again: str) -> str:
    """What to do now: nothing is trained before a doubt is mended."""
    if found.doubts:
        return f"mend this first, then `nsde inspect` again: {found.doubts[0]}"
    if not found.usable:
        return f"complete the mapping (`missing` above), then {again}"
    if found.open:
        return f"choose in the mapping what is open above (`look at`); then {train}"
    return train


def _beside(path: str) -> Path:
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    return folder / "mapping.yaml"


def _write(found: Inspection, target: Path, *, overwrite: bool) -> str:
    if found.missing:
        return f"\nnot written: complete the mapping above and save it as {target}"
    if target.exists() and not overwrite:
        if target.is_file() and target.read_text(encoding="utf-8", errors="replace") == found.yaml:
            return f"\n{target} holds this mapping"
        return f"\n{target} is there and was not replaced (overwrite=true, or out=FILE)"
    _save(target, found.yaml, "out")
    after = "" if found.usable else " (to be corrected: a check failed)"
    return f"\nwrote {target}{after}"


def _save(target: Path, text: str, key: str) -> None:
    try:
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            f"`{key}`: {target} cannot be written ({error.strerror}); name another file, {key}=FILE."
        ) from error


def report(found: Inspection, *, everything: bool = False) -> str:
    """What was found, as text."""
    count = len(found.runs)
    names = ", ".join(found.runs[:5]) + (", ..." if count > 5 else "")
    lines = [f"{found.path}: data={found.kind}, {count} run{'s' * (count > 1)} ({names})", ""]
    lines += _table(found, everything=everything)
    if found.native:
        lines += ["", f"The reader `{found.kind}` needs no mapping; the system is {found.system}."]
    elif found.mapping is not None:
        lines += ["", f"mapping for {found.system}:", *(f"  {line}" for line in found.yaml.splitlines())]
    lines += ["", *(f"missing: {one}" for one in found.missing)] if found.missing else []
    lines += ["", *(f"look at: {one}" for one in found.open)] if found.open else []
    lines += ["", *(f"note: {one}" for one in found.notes)] if found.notes else []
    if found.checks:
        lines += ["", "checks:", *(f"  {_MARKS[c.passed]}{c.name}: {c.text}" for c in found.checks)]
    return "\n".join(lines)


def _table(found: Inspection, *, everything: bool) -> list[str]:
    rows = found.columns
    if not everything:
        used = {s for e in found.mapping.columns.values() for s in e.source} if found.mapping else set()
        moving = [r for r in rows if r.low != r.high and r.missing < 1.0]
        first = [r for r in moving if r.column in used or f"{r.stream}/{r.column}" in used]
        rest = [r for r in moving if r not in first][: max(_SHOWN - len(first), 0)]
        rows = first + rest
    head = ("column", "unit", "rate [Hz]", "rows", "lowest", "highest", "missing", "gaps")
    cells = [
        (
            f"{r.stream}/{r.column}" if r.stream else r.column,
            r.unit or "-",
            f"{r.rate:.4g}" if r.rate == r.rate else "no clock",
            str(r.rows),
            f"{r.low:.4g}",
            f"{r.high:.4g}",
            f"{r.missing:.1%}" if r.missing else "-",
            str(r.gaps) if r.gaps else "-",
        )
        for r in rows
    ]
    left = len(found.columns) - len(rows)
    more = [f"({left} more; columns=all lists them)"] if left else []
    return [*aligned([head, *cells], left=2), *more]


def _given(words: Sequence[str]) -> tuple[str, dict[str, str]]:
    """The log, and the keys."""
    path: str | None = None
    out: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if word == "--" or key == "data.path":  # as in other commands
            word, equals = value, ""
        if word == "":
            continue
        if equals and (key in KEYS or key.startswith(_OPTION)):
            out[key] = value
        elif equals and not Path(word).exists():
            raise ConfigError(messages.no_key(word, KEYS))
        elif path is None:
            path = word
        else:
            raise ConfigError(f"one log or folder at a time; got {path} and {word}.")
    if path is None:
        raise ConfigError("name a log or a folder of logs: `nsde inspect LOG`.")
    for key in ("overwrite", "physics"):
        if out.get(key, "true") not in ("true", "false"):
            raise ConfigError(f"`{key}` must be true or false; got {out[key]!r}.")
    return path, out


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word: keys, and names of systems and readers."""
    last = words[-1] if words else ""
    key, equals, start = last.partition("=")
    if not equals:
        return [f"{k}=" for k in KEYS if k.startswith(key) and not k.endswith("NAME")]
    choices: Sequence[str] = ()
    if key == "system":
        from nsde_torch.systems.names import SYSTEM_HOMES

        choices = list(SYSTEM_HOMES)
    elif key == "kind":
        from nsde_torch.data.readers import READERS

        choices = [name for name, one in READERS.items() if one.streams]
    elif key in ("physics", "overwrite"):
        choices = ("true", "false")
    return [f"{key}={choice}" for choice in choices if choice.startswith(start)]


COMMAND = PlainCommand(main, complete)
