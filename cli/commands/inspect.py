"""`nsde inspect`: list what is in a log of any format, propose what its columns mean, and check it."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING

from nsde_torch.aligned import aligned
from nsde_torch.data.readers import READERS
from nsde_torch.errors import ConfigError
from nsde_torch.texts import rendered

from ..exit_status import FAILED_JOBS, EndedError
from ..hydra_command import TEXTS, WITH_VALUE, Config, HydraCommand, Job
from ..keys import group, key
from ..own_modules import UNNAMED
from ..quoted import as_typed
from ..schemas import SystemConfig

if TYPE_CHECKING:
    from nsde_torch.api.inspecting import Inspection
    from nsde_torch.systems import System

_SHOWN = 40


@dataclass
class InspectConfig:
    log: str | None = key(
        None,
        "log or folder of logs; `nsde inspect LOG` says the same; null: what a log of the machine holds",
        file=True,
    )
    kind: str | None = key(
        None, "reader of the format; null: by the names of the files", choices=tuple(READERS)
    )
    mapping: str | None = key(
        None,
        "YAML file of a mapping to check; null: mapping.yaml beside the logs, else one is proposed",
        file=True,
    )
    out: str | None = key(
        None,
        "file to write the mapping to, which data=log and the readers of the formats use; null: mapping.yaml beside "
        "the logs; none: nothing is written",
        file=True,
    )
    overwrite: bool = key(False, "replace a mapping that is there by a proposal")
    physics: bool = key(True, "fit the declared physics, which shows signs and orders that are wrong")
    json: str | None = key(None, "file to write all that was found to, for a program", file=True)
    columns: str = key(
        "moving", "columns to list: those that move (40 at most), or all", choices=("moving", "all")
    )
    system: SystemConfig = group(SystemConfig, "machine that the log is of")


def _log_first(words: Sequence[str]) -> list[str]:
    """`nsde inspect LOG`, and `data.path=LOG` as in other commands, as `log=LOG`."""
    if {"-h", "--help"} & set(words):
        return list(words)
    out, logs = [], []
    for before, word in zip(("", *words), words, strict=False):
        name, equals, value = word.partition("=")
        follows = before in {*WITH_VALUE, *WITH_VALUE.values()}
        typed = equals and name.split(".")[0] in InspectConfig.__dataclass_fields__
        if name in ("log", "data.path") and equals:
            logs.append(value)
        elif follows or typed or ((equals or word.startswith("-")) and not Path(word).exists()):
            out += [word] if word != "--" else []
        elif word:
            logs.append(word)
    if len(logs) > 1:
        raise ConfigError(f"one log or folder at a time; got {' and '.join(logs)}.")
    return [*out, *(f"log={log}" for log in logs)]


COMMAND = HydraCommand(
    name="inspect",
    schema=InspectConfig,
    groups={"system": None},
    values={"system": {"name": UNNAMED}},
    words=_log_first,
    examples=(
        ("flights/ system=quadrotor", "what do the columns mean, and is it so?"),
        ("flights/ mapping=corrected.yaml", "check a mapping"),
        ("--config-dir DIR system=mine flights/", "a machine of your own, DIR/system/mine.yaml"),
        ("system=quadrotor", "what would a log of it hold?"),
    ),
)


def run(config: Config, job: Job) -> None:
    """Print what is in a log, and write the mapping; EndedError where it cannot be used so."""
    import torch

    from nsde_torch.api.inspecting import inspect
    from nsde_torch.data.mapping.reader import format_of, mapping_beside

    from .. import build
    from ..own_modules import system_words

    torch.set_num_threads(1)
    sys.path.insert(0, os.getcwd())  # a system of the user's own, in a file there
    machine = build.system_options(config.system)
    if machine.name == UNNAMED and machine.options:
        raise ConfigError(
            f"`system.options.{next(iter(machine.options))}` is of a machine: name it, system=NAME."
        )
    if config.log is None:
        if machine.name == UNNAMED:
            raise ConfigError("name a log, `nsde inspect LOG`, or a machine, `nsde inspect system=NAME`.")
        print(_of_machine(machine.make(), shlex.join(system_words(machine.name))))
        return
    path = config.log
    target = None if config.out == "none" else Path(config.out or _beside(path))
    # what lies beside the logs is what they will be read by, unless another one is to be written
    proposes = config.overwrite or target not in (None, _beside(path))
    kind = config.kind or format_of(path)
    there = mapping_beside(path) if kind in READERS and READERS[kind].mapped and not proposes else None
    named, mapping = None if machine.name == UNNAMED else machine, config.mapping or there
    found = inspect(path, system=named, kind=config.kind, mapping=mapping, physics=config.physics)
    table = "\n".join(_table(found, everything=config.columns == "all"))
    print(rendered(TEXTS, "inspection.txt", found=found, table=table))
    if config.json is not None:
        _save(Path(config.json), json.dumps(found.content(), indent=1, allow_nan=False) + "\n", "json")
    if found.mapping is not None and config.mapping is None and target is not None:
        print(_write(found, target, overwrite=config.overwrite))
    used = Path(config.mapping) if config.mapping else target
    words = system_words(found.system if machine.name == UNNAMED else machine.name)
    words += [f"system.options.{k}={v}" for k, v in machine.options.items()]
    own = found.native or used is None or used == _beside(path)
    paths = {"data.path": path} if own else {"data.path": path, "data.mapping": used}
    train = as_typed("nsde", "train", *words, f"data={found.kind}", paths=paths)
    again = as_typed("nsde", "inspect", path, *words, "mapping=FILE", paths={})
    print(f"\nnext: {_next(found, train, again)}")
    if not found.usable:
        raise EndedError("these logs cannot be used as they are; what to do is said above.", FAILED_JOBS)


def _of_machine(system: System, words: str) -> str:
    """What a log of a machine holds, and what is declared of it; `words` name it in a command."""
    from nsde_torch.systems.parameters import ParameterVector

    def columns(names: Sequence[str], units: Sequence[str]) -> str:
        return ", ".join(f"{name} [{unit}]" for name, unit in zip(names, units, strict=True))

    rows = [("parameter", "first value", "unit", "meaning")]
    vector = ParameterVector(system)
    help_of = {label: spec.help for label, spec in type(system).PARAMETERS.items()}
    for label, value, unit in zip(vector.labels, vector.start.tolist(), vector.units, strict=True):
        rows.append((label, f"{value:.4g}", unit, help_of.get(label, "")))
    values = {
        "system": system,
        "words": words,
        "about": cleandoc(type(system).__doc__ or ""),
        "states": columns(system.state_names, system.state_units),
        "inputs": columns(system.input_names, system.input_units),
        "rates": ", ".join(rate for _, rate, _ in system.position_derivatives if system.quaternion is None),
        "declared": ", ".join(system.effect_names),
        "parameters": "\n".join(aligned(rows, left=4)),
    }
    return rendered(TEXTS, "machine.txt", **values)


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


def _table(found: Inspection, *, everything: bool) -> list[str]:
    rows = found.columns
    if not everything:
        used = {s for e in found.mapping.columns.values() for s in e.source} if found.mapping else set()
        moving = [r for r in rows if r.low != r.high and r.missing < 1.0]
        first = [r for r in moving if r.column in used or f"{r.stream}/{r.column}" in used]
        rest = [r for r in moving if r not in first][: max(_SHOWN - len(first), 0)]
        rows = first + rest
    head = ("column", "unit", "rate [Hz]", "rows", "lowest", "highest", "missing", "gaps")
    cells = []
    for r in rows:
        name, rate = f"{r.stream}/{r.column}" if r.stream else r.column, f"{r.rate:.4g}"
        sizes = (str(r.rows), f"{r.low:.4g}", f"{r.high:.4g}", f"{r.missing:.1%}" if r.missing else "-")
        cells.append(
            (name, r.unit or "-", rate if r.rate == r.rate else "no clock", *sizes, str(r.gaps or "-"))
        )
    left = len(found.columns) - len(rows)
    more = [f"({left} more; columns=all lists them)"] if left else []
    return [*aligned([head, *cells], left=2), *more]
