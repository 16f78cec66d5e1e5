"""Where what can be made anew is kept: simulated runs, compiled controllers."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(folder: str | Path | None = None) -> Path:
    """Folder of the cache: `folder`, else NSDE_CACHE, else nsde_torch in the user's cache folder."""
    if folder is not None:
        return Path(folder).expanduser()
    if os.environ.get("NSDE_CACHE"):
        return Path(os.environ["NSDE_CACHE"]).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "nsde_torch"
