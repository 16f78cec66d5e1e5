"""Libraries of C: compiled once, kept on disk, and loaded.

The key of a library is a hash of its source and of how it is compiled. The source holds all that it computes with,
weights too, and takes 0.1 to 0.3 s to write: whatever changes it makes another library.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import torch

from nsde_torch.cache import cache_folder

LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3"}
"""What compilers call what torch finds of a processor; for others they take their default."""


class NoCompiler(RuntimeError):
    """Machine code cannot be made here; the message says why."""


def compiler() -> str | None:
    """A C compiler: what CC names, or cc, gcc or clang."""
    named = os.environ.get("CC")
    return next((c for c in ([named] if named else ["cc", "gcc", "clang"]) if shutil.which(c)), None)


def compiled(source: Path, made: Path, flags: Sequence[str]) -> None:
    """Compile a file to a library.

    Args:
        source: The file.
        made: The library.
        flags: How.

    Raises:
        NoCompiler: there is no C compiler, or it refuses.
    """
    cc = compiler()
    if cc is None:
        raise NoCompiler("there is no C compiler (cc, gcc or clang; CC names it)")
    words = [cc, *flags, "-shared", "-fPIC", "-o", str(made), str(source), "-lm"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = (done.stderr.strip().splitlines() or ["no word"])[0]
        raise NoCompiler(f"{cc} does not compile it: {said}")


def library(
    source: str, name: str, *, folder: str | Path | None = None, say: Callable[[str], None] | None = None
) -> ctypes.CDLL:
    """A library of this computer, compiled if it is not kept yet.

    Args:
        source: Its text.
        name: What it is, for the file and for messages.
        folder: Where libraries are kept; default: the folder of the package's cache.
        say: Called with one line when it is compiled.

    Raises:
        NoCompiler: there is no C compiler, or it refuses, or what it makes cannot be kept.
    """
    level = LEVELS.get(torch.backends.cpu.get_cpu_capability())
    flags = ("-std=c99", "-O3", *([f"-march={level}"] if level else []))
    key = hashlib.sha256("\0".join((source, *flags)).encode()).hexdigest()[:32]
    path = cache_folder(folder) / f"{name}-{key}.so"
    if _is_whole(path):
        with suppress(OSError):  # of another system: made anew
            return ctypes.CDLL(str(path))
    started = time.perf_counter()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as work:
            text, made = Path(work) / f"{name}.c", Path(work) / path.name
            text.write_text(source, encoding="utf-8")
            compiled(text, made, flags)
            content = made.read_bytes()
            made.write_bytes(content + hashlib.sha256(content).digest())
            os.replace(made, path)
        built = ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"its library cannot be kept in {path.parent} ({error})") from error
    if say is not None:
        say(f"compiled {name} in {time.perf_counter() - started:.0f} s, kept in {path.parent}")
    return built


def _is_whole(path: Path) -> bool:
    """Whether a library ends in its hash: to load one that was cut off ends the process."""
    content = path.read_bytes() if path.is_file() else b""
    return hashlib.sha256(content[:-32]).digest() == content[-32:]
