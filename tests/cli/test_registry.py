"""A command is one file and one line of the table: a scratch command is registered here and used."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nsde_torch.cli.commands.completion import query
from nsde_torch.cli.main import main
from nsde_torch.cli.registry import COMMANDS, CommandEntry, hydra_command, hydra_commands
from tests.helpers.commands import Said

SCRATCH = '''
"""`nsde scratch`: weigh a system."""

from __future__ import annotations

import json
from dataclasses import dataclass

from nsde_torch.cli.hydra_command import HydraCommand
from nsde_torch.cli.keys import group, key, of
from nsde_torch.cli.schemas.model import SystemConfig
from nsde_torch.training.options import TrainerOptions


@dataclass
class ScratchConfig:
    """`nsde scratch`."""

    factor: float = key(2.0, "factor on the mass", unit="1", above=0)
    steps: int = of(TrainerOptions, "steps", default=7)
    out_dir: str = key("???", "folder to write into", file=True)
    system: SystemConfig = group(SystemConfig, "the machine")


COMMAND = HydraCommand(
    name="scratch",
    help="Weigh a system",
    schema=ScratchConfig,
    module=__name__,
    groups={"system": "cartpole"},
    folder="scratches/${now:%Y-%m-%d}",
    result=("weight.json", "a weight"),
    examples=(("factor=3", "three times as heavy"),),
)


def run(config, job):
    """Write the weight."""
    content = {"system": config.system.name, "steps": config.steps, "factor": config.factor}
    (job.run_dir / "weight.json").write_text(json.dumps(content))
'''


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A command in a file of its own, registered with one line."""
    (tmp_path / "nsde_scratch.py").write_text(SCRATCH)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(COMMANDS, "scratch", CommandEntry("nsde_scratch", "Weigh a system"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_command_of_one_file_and_one_line_has_help_completion_checks_and_a_folder(
    scratch: Path, refused: Said, shown: Said
) -> None:
    assert "scratch       Weigh a system" in shown("--help")
    text = shown("scratch", "--help")
    assert text.startswith("nsde scratch: weigh a system")
    steps = ("steps=7 [steps]", "largest number of gradient steps (at least 1)")
    assert all(part in text for part in ("factor=2 [1]", *steps, "factor=3")), text
    assert query(["scratch", "system=cart"]) == ["system=cartpole"]
    assert query(["scra"]) == ["scratch"]
    assert main(["scratch", "system=hexacopter", "factor=4", "out_dir=here, or there"]) == 0
    content = json.loads((scratch / "here, or there" / "weight.json").read_text())
    assert content == {"system": "hexacopter", "steps": 7, "factor": 4.0}
    assert "holds a weight already" in refused("scratch", "out_dir=here, or there")
    assert "Did you mean `factor`?" in refused("scratch", "factr=1")
    assert "`factor` must be above 0" in refused("scratch", "factor=0")
    assert main(["scratch"]) == 0
    assert list(scratch.glob("scratches/*/weight.json"))


def test_the_objects_of_the_commands_bear_the_names_of_the_table() -> None:
    assert all(command.name == name for name, command in hydra_commands().items())
    with pytest.raises(KeyError, match="effects"):
        hydra_command("effects")
