"""Simulated runs on disk: one `.npz` for each hash of their settings and code.

The key is a hash of all settings and of the source files that a simulation runs through, so that no change
of the code can be answered with old runs. No pickle is written or read. A file that cannot be read, or does
not hold what its key says, is made anew. Writers take turns by nothing but an atomic rename: the last one
wins, with equal content.
"""

import functools
import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from nsde_torch.cache import cache_folder
from nsde_torch.data.raw import RawRun

_SOURCES = (
    "simulation",
    "control/cascade.py",
    "systems",
    "effects",
    "sde",
    "rotation.py",
    "data/quaternion.py",
)


@functools.cache
def code_hash() -> str:
    """Hash of the source files that a simulation runs through."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for part in _SOURCES:
        path = package / part
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.relative_to(package).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def key_of(settings: Mapping[str, Any]) -> str:
    """Key of a simulation (hex); settings are plain containers."""
    text = json.dumps({**settings, "code": code_hash()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def path_of(key: str, folder: str | Path | None = None) -> Path:
    """File of a key."""
    return cache_folder(folder) / f"simulated-{key}.npz"


def load(key: str, folder: str | Path | None = None) -> list[RawRun] | None:
    """Runs of a key, or None where there are none that can be read."""
    path = path_of(key, folder)
    try:
        with np.load(path, allow_pickle=False) as content:
            if str(content["key"]) != key:
                return None
            runs = []
            for i, name in enumerate(content["names"].tolist()):
                t, x, u = (np.asarray(content[f"{part}_{i}"], dtype=np.float64) for part in "txu")
                if not (t.ndim == 1 and x.ndim == u.ndim == 2 and len(t) == len(x) == len(u)):
                    return None
                runs.append(RawRun(str(name), t, x, u, source="simulated"))
            return runs or None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def store(key: str, runs: Sequence[RawRun], folder: str | Path | None = None) -> Path | None:
    """Write runs under a key; None where the folder cannot be written, since a cache is no necessity."""
    path = path_of(key, folder)
    content: dict[str, Any] = {"key": np.array(key), "names": np.array([run.name for run in runs])}
    for i, run in enumerate(runs):
        content |= {f"t_{i}": run.t, f"x_{i}": run.x, f"u_{i}": run.u}
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=".part")
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **content)
        os.replace(temporary, path)
    except OSError:
        if temporary is not None:
            with suppress(OSError):
                os.unlink(temporary)
        return None
    return path
