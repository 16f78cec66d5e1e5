"""What a new user runs first does what is said: the notebook, and the Python of the README."""

import ast
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.cli.main import main
from tests.helpers.diagnosed import assert_interval

pytestmark = pytest.mark.drawn


def run(source: str, names: dict[str, Any]) -> Any:
    """Run a cell; returns the value of its last line, which a notebook shows."""
    tree = ast.parse(source)
    last = tree.body.pop()
    exec(compile(tree, "cell", "exec"), names)
    if isinstance(last, ast.Expr):
        return eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return exec(compile(ast.Module([last], []), "cell", "exec"), names)


@pytest.mark.slow
def test_the_notebook_runs_from_top_to_bottom(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((root / "examples" / "first_hour.ipynb").read_text(encoding="utf-8"))
    names: dict[str, Any] = {}
    shown = [run("".join(c["source"]), names) for c in notebook["cells"] if c["cell_type"] == "code"]
    assert names["found"].added == ["coulomb_friction"]
    assert_interval(names["found"].parameters, "coulomb_friction.size", 0.3)
    assert Path("diagnosis/report.html").is_file()
    data, found, *_, coverage = shown
    assert all(one._repr_html_() for one in (data, found))
    assert all(0.75 < share <= 1.0 for share in coverage.values())


@pytest.mark.slow
def test_the_commands_and_the_python_of_the_readme_name_the_friction(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (root / "README.md").read_text(encoding="utf-8")
    simulate, diagnose = re.findall(r"^nsde ((?:simulate|diagnose) .*cart.*)$", text, re.MULTILINE)
    assert main([*shlex.split(simulate, comments=True), "durations=[4,4,4,4]"]) == 0
    assert main([*shlex.split(diagnose, comments=True), "out_dir=by_command"]) == 0
    assert "Missing: coulomb_friction[cart]." in capsys.readouterr().out
    assert Path("by_command/report.html").is_file()
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(block.splitlines()) <= 15
    names: dict[str, Any] = {}
    exec(block, names)
    assert names["found"].added == ["coulomb_friction[cart]"]
    assert Path("diagnosis/report.html").is_file()
    assert Path("predictions.png").stat().st_size > 10_000
