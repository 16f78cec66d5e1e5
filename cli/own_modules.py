"""Modules of the user's own that a run directory needs: they lay in the folder that --config-dir named."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml


def see_own_modules(folder: Path) -> None:
    """Make modules importable that lay in the user's config folder at training: a system of their own."""
    for record in (folder / ".hydra" / "hydra.yaml", folder.parent / ".hydra" / "hydra.yaml"):
        if not record.is_file():  # the model of a diagnosis lies in a folder of its own
            continue
        content = yaml.safe_load(record.read_text(encoding="utf-8"))
        for path in config_folders(content["hydra"]["runtime"]["config_sources"]):
            if path not in sys.path:
                sys.path.insert(0, path)


def config_folders(sources: Iterable[Any]) -> list[str]:
    """Folders of `--config-dir` among the sources of a configuration that Hydra made."""
    return [s["path"] for s in sources if s["provider"] == "command-line" and s["schema"] == "file"]
