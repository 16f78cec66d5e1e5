"""What is the user's own in the folder that --config-dir names: modules that a run directory needs, systems."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from nsde_torch.errors import ConfigError
from nsde_torch.plain_yaml import read_yaml

from . import groups


def see_own_modules(folder: Path) -> None:
    """Make modules importable that lay in the user's config folder at training: a system of their own."""
    for record in (folder / ".hydra" / "hydra.yaml", folder.parent / ".hydra" / "hydra.yaml"):
        if not record.is_file():  # the model of a diagnosis lies in a folder of its own
            continue
        content = read_yaml(record)
        for path in config_folders(content["hydra"]["runtime"]["config_sources"]):
            if path not in sys.path:
                sys.path.insert(0, path)


def config_folders(sources: Iterable[Any]) -> list[str]:
    """Folders of `--config-dir` among the sources of a configuration that Hydra made."""
    return [s["path"] for s in sources if s["provider"] == "command-line" and s["schema"] == "file"]


def own_system(system: str, config_dir: Path | None) -> str:
    """What the user's own file `system/NAME.yaml` names, or the name as it is; ConfigError where it names no class."""
    if config_dir is None or not (file := config_dir / "system" / f"{system}.yaml").is_file():
        return system
    groups.check_own_files(config_dir, {"system": system})
    name = groups.choice_values("system", system, config_dir).get("name")
    if not isinstance(name, str):
        raise ConfigError(f"{file} must hold `name: module:Class`, or `defaults: [SYSTEM, _self_]`.")
    return name


def split_config_dir(arguments: Sequence[str]) -> tuple[Path | None, list[str]]:
    """The folder of `--config-dir` (None: none), and the other words; ConfigError where there is no such folder."""
    folder = groups.config_dir(arguments)
    if folder is not None and not folder.is_dir():
        raise ConfigError(f"`--config-dir {folder}`: no such folder.")
    words = [w for w in arguments if not w.startswith("--config-dir=")]
    for flag in ("--config-dir", "-cd"):
        if flag in words:
            k = words.index(flag)
            del words[k : k + 2]
    return folder, words
