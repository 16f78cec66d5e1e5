"""The table of commands."""

from __future__ import annotations

import time

import pytest

from nsde_torch.cli.main import unknown_command
from nsde_torch.cli.registry import all_commands
from tests.helpers.commands import Said


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"], ["help"]])
def test_alone_or_with_help_it_lists_every_command_with_a_line(words: list[str], shown: Said) -> None:
    lines = shown(*words).splitlines()
    for name, command in all_commands().items():
        assert any(line.split() == [name, *command.summary.split()] for line in lines)
    assert max(map(len, lines)) <= 100


def test_unknown_command_suggests_the_nearest(refused: Said) -> None:
    assert "Did you mean `nsde train`?" in refused("trian")
    assert "Did you mean" not in unknown_command("zzz")
    assert "Did you mean" not in unknown_command("nonsense")
    assert "Did you mean `nsde evaluate`?" in unknown_command("eval")


def test_version_is_that_of_the_package(shown: Said) -> None:
    assert shown("--version").split()[0] == "nsde"


def test_help_starts_within_three_tenths_of_a_second(nsde) -> None:  # type: ignore[no-untyped-def]
    nsde("--help")
    times = []
    for _ in range(5):
        start = time.perf_counter()
        assert nsde("--help").returncode == 0
        times.append(time.perf_counter() - start)
    assert min(times) < 0.3
