"""What a command of `nsde` says in this process, and a machine of the user's own for it."""

from collections.abc import Callable
from pathlib import Path

Said = Callable[..., str]
"""Runs `nsde WORDS` and gives what it printed: `shown` where it ends well, `refused` where the user is at fault."""


def own_machine(folder: Path, content: str, name: str = "mine") -> None:
    """A file of a machine of the user's own, which `--config-dir FOLDER` makes a choice of `system`."""
    (folder / "system").mkdir(parents=True, exist_ok=True)
    (folder / "system" / f"{name}.yaml").write_text(content, encoding="utf-8")
