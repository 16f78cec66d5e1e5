"""What is the user's own in the folder that --config-dir names: modules that a run directory needs, systems."""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from nsde_torch.plain_yaml import read_yaml
from nsde_torch.systems.names import SYSTEM_HOMES

UNNAMED = "not named"  # value of `system.name` where a command does without a machine and none was named


def see_folders(folders: Iterable[str]) -> None:
    """Make the modules in folders importable."""
    sys.path[:0] = [folder for folder in folders if folder not in sys.path]


def see_own_modules(folder: Path) -> None:
    """Make modules importable that lay in the user's config folder at training: a system of their own."""
    for record in (folder / ".hydra" / "hydra.yaml", folder.parent / ".hydra" / "hydra.yaml"):
        if record.is_file():  # that of a diagnosis lies in the folder above its model
            see_folders(config_folders(read_yaml(record)["hydra"]["runtime"]["config_sources"]))


def config_folders(sources: Iterable[Any]) -> list[str]:
    """Folders of `--config-dir` among the sources of a configuration that Hydra made."""
    return [s["path"] for s in sources if s["provider"] == "command-line" and s["schema"] == "file"]


def system_words(name: str) -> list[str]:
    """Words that name the machine of the present command in another one, with the folder of the user's own."""
    from hydra.core.hydra_config import HydraConfig

    runtime = HydraConfig.get().runtime
    choice = runtime.choices.get("system")
    words = [w for folder in config_folders(runtime.config_sources) for w in ("--config-dir", folder)]
    if choice is not None and choice not in SYSTEM_HOMES:
        return [*words, f"system={choice}"]
    return [*words, f"system={name}" if name in SYSTEM_HOMES else f"system.name={name}"]
