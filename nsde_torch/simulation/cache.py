"""Simulated runs on disk: one `.npz` for each hash of their settings and code.

The key is a hash of all settings and of the source files that a simulation runs through, so that no change of the code
can be answered with old runs. No pickle is written or read. A file that cannot be read is made anew. Writers take turns
by nothing but an atomic rename: the last one wins, with equal content.
"""

import functools
import hashlib
import json
import os
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


def path_of(settings: Mapping[str, Any], folder: str | Path | None = None) -> Path:
    """File of the runs of a simulation with these settings."""
    text = json.dumps({**settings, "code": code_hash()}, sort_keys=True, default=list)
    return cache_folder(folder) / f"simulated-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"


def load(path: Path) -> list[RawRun] | None:
    """Runs of a file, or None where there is none that can be read."""
    try:
        with np.load(path, allow_pickle=False) as content:
            names = content["names"].tolist()
            parts = [[content[f"{part}_{i}"] for part in "txu"] for i in range(len(names))]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return [RawRun(name, t, x, u, source="simulated") for name, (t, x, u) in zip(names, parts, strict=True)]


def store(path: Path, runs: Sequence[RawRun]) -> None:
    """Write runs, if the folder can be written: a cache is no necessity."""
    content: dict[str, Any] = {"names": np.array([run.name for run in runs])}
    for i, run in enumerate(runs):
        content |= {f"t_{i}": run.t, f"x_{i}": run.x, f"u_{i}": run.u}
    part = path.with_suffix(f".{os.getpid()}.part")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                np.savez(file, allow_pickle=False, **content)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
