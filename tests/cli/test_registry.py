"""A command is one file and one line of the table: that of a page of the docs is registered here and used."""

from pathlib import Path

import pytest

from nsde_torch.cli.commands.completion import query
from nsde_torch.cli.registry import COMMANDS, CommandEntry, hydra_command, hydra_commands
from tests.helpers.commands import Said


@pytest.mark.usefixtures("elsewhere")
def test_a_command_of_one_file_and_one_line_has_help_completion_and_checks(
    root: Path, monkeypatch: pytest.MonkeyPatch, refused: Said, shown: Said
) -> None:
    monkeypatch.syspath_prepend(root / "examples" / "extend")
    monkeypatch.setitem(COMMANDS, "rows", CommandEntry("rows"))
    assert "rows          How many rows each run of a data set has" in shown("--help")
    text = shown("rows", "--help")
    assert text.startswith("nsde rows: how many rows each run of a data set has")
    assert all(
        part in text for part in ("least=0", "leave out runs with fewer rows (at least 0)", "data=csv")
    ), text
    assert query(["rows", "system=cart"]) == ["system=cartpole"]
    assert query(["ro"]) == ["rows"]
    assert (
        shown("rows", "system=mass_spring_damper", "data.durations=[2,3]", "least=250")
        == "run_1: 301 rows, 3.0 s\n"
    )
    for word, said in (
        ("laest=1", "Did you mean `least`?"),
        ("least=-1", "`least` must be at least 0"),
        ("system=cartpol", "Did you mean `system=cartpole`?"),
        ("-m", "has no sweeps"),
    ):
        assert said in refused("rows", word)


def test_the_objects_of_the_commands_bear_the_names_of_the_table() -> None:
    assert all(command.name == name for name, command in hydra_commands().items())
    with pytest.raises(KeyError, match="sweep-report"):
        hydra_command("sweep-report")
