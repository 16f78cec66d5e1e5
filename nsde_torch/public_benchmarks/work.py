"""Stages of a benchmark: progress, and results that are kept so that what was interrupted goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from nsde_torch.errors import CheckpointError
from nsde_torch.whole_files import write_whole

Say = Callable[[str, int, int], None]


class Work:
    """Where a run keeps its stages.

    Args:
        folder: Folder of the run; stages are kept in `stages/` within.
        key: What the results depend on; stages of another key are refused.
        say: Told stage, number done and number in all.
        tell: Told sentences.
    """

    def __init__(self, folder: Path, key: str, *, say: Say, tell: Callable[[str], None]) -> None:
        self.folder, self.key, self.say, self.tell = folder, key, say, tell

    def stage(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The result of a stage: read where it is kept, made and kept where not.

        Args:
            name: Name of the stage and of its file.
            make: Makes the result, plain values.

        Raises:
            CheckpointError: what is kept is damaged, or belongs to other files or settings.
        """
        path = self.folder / "stages" / f"{name}.json"
        if path.is_file():
            try:
                kept: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
                key, result = kept["key"], dict(kept["result"])
            except (ValueError, KeyError, TypeError) as error:
                raise CheckpointError(
                    f"{path} is damaged ({error}). Delete it, and the stage runs again."
                ) from None
            if key != self.key:
                raise CheckpointError(
                    f"{path} is of other files or settings than these. Name another `out_dir`, or delete the folder."
                )
            self.tell(f"kept from before: {name}")
            return result
        result = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps({"key": self.key, "result": result}, indent=1))
        return result


def key_of(name: str, paths: Sequence[Path], settings: dict[str, Any]) -> str:
    """A hash of a set's files and of the settings, which stages depend on."""
    seen = hashlib.sha256(json.dumps([name, settings], sort_keys=True).encode())
    for path in paths:
        seen.update(path.name.encode())
        seen.update(path.read_bytes())
    return seen.hexdigest()[:16]
