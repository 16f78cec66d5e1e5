"""Running `nsde` in this process and in one of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Nsde = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def nsde(tmp_path: Path) -> Nsde:
    """Run `nsde WORDS` in an empty folder, as a process of its own."""

    def run(*words: str, **env: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "nsde_torch.cli", *words],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, **env},
            timeout=120,
            check=False,
        )

    return run
