"""Running `nsde` in this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from nsde_torch.cli.main import main
from tests.helpers.commands import Said


@pytest.fixture(autouse=True)
def _threads_as_before() -> Iterator[None]:
    """Commands may set torch's threads, which are put back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]) -> Said:
    """Run `nsde WORDS` in this process, which ends well; what it printed."""

    def run(*words: str) -> str:
        assert main([*words]) == 0
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Said:
    """Run `nsde WORDS` in this process, which the user's fault ends; what is said of it."""

    def run(*words: str) -> str:
        assert main([*words]) == 2
        said = capsys.readouterr().err
        assert "Traceback" not in said
        return said

    return run
