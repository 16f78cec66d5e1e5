"""The wheel holds all of the tree, and runs the same commands from elsewhere."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

COPIED = ("nsde_torch", "benchmarks/nsde_benchmarks", "cli", "conf", "pyproject.toml", "README.md", "LICENSE")


def _declared_packages(root: Path) -> set[str]:
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    block = re.search(r"^packages = \[(.*?)^\]", text, flags=re.MULTILINE | re.DOTALL)
    return set(re.findall(r'"([^"]+)"', block.group(1)))


def test_pyproject_lists_every_package_of_the_tree(root: Path) -> None:
    found = {"nsde_torch", "nsde_torch.cli", "nsde_torch.conf"}
    for path in (root / "nsde_torch").rglob("*.py"):
        found.add(".".join(path.parent.relative_to(root).parts))
    for path in (root / "cli").rglob("*.py"):
        found.add(".".join(("nsde_torch", *path.parent.relative_to(root).parts)))
    for path in (root / "benchmarks" / "nsde_benchmarks").rglob("*.py"):
        found.add(".".join(path.parent.relative_to(root / "benchmarks").parts))
    assert _declared_packages(root) == found


def test_constraints_pin_every_direct_dependency(root: Path) -> None:
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    block = text[text.index("dependencies = [") : text.index("[project.optional-dependencies]")]
    named = re.findall(r'^    "([^"]+)"', block, flags=re.MULTILINE)
    pinned = re.findall(
        r"^(.+?)==", (root / "constraints.txt").read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    assert {re.split(r"[~<>=]", item)[0] for item in named} <= set(pinned)


def _pip(*words: str) -> None:
    command = [sys.executable, "-m", "pip", *words, "--quiet", "--no-deps", "--no-index"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of the tree, without the network."""
    for tool in ("setuptools", "wheel", "pip"):
        if importlib.util.find_spec(tool) is None:
            pytest.skip(f"building a wheel without the network needs {tool}")
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("wheel")
    for name in COPIED:
        source = root / name
        if source.is_dir():
            shutil.copytree(source, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif source.is_file():
            shutil.copy(source, tree / name)
    _pip("wheel", "--no-build-isolation", "--wheel-dir", str(out), str(tree))
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment in which Python sees the installed wheel and not the checkout."""
    target = tmp_path_factory.mktemp("site")
    _pip("install", "--target", str(target), str(wheel))
    return {**os.environ, "PYTHONPATH": str(target)}


def test_wheel_holds_code_commands_and_every_config_file(wheel: Path, root: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {str(path.relative_to(root)) for path in (root / "nsde_torch").rglob("*.py")}
    expected |= {f"nsde_torch/{path.relative_to(root)}" for path in (root / "cli").rglob("*.py")}
    expected |= {f"nsde_torch/{path.relative_to(root)}" for path in (root / "conf").rglob("*.yaml")}
    for folder in ("cli/serving/page", "cli/shell", "cli/templates"):
        expected |= {f"nsde_torch/{path.relative_to(root)}" for path in (root / folder).iterdir()}
    plug_ins = (root / "benchmarks" / "nsde_benchmarks").rglob("*.py")
    expected |= {str(path.relative_to(root / "benchmarks")) for path in plug_ins}
    for part in ("control/codegen", "design", "diagnosis", "export", "sysid"):
        templates = (root / "nsde_torch" / part / "templates").iterdir()
        expected |= {str(path.relative_to(root)) for path in templates}
    assert expected <= names
    assert not [name for name in names if name.startswith(("benchmarks/", "cli/", "conf/", "tests/"))]


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        ("--help", 0, ["sweep-report", "benchmark     Run a public measured set by its own protocol",
                       "figures       Make the supplement's figures anew"]),
        ("benchmark", 0, ["fetch: biaslab/nsi-silverbox"]),
        ("figures --cfg job figures=[fig5]", 0, ["settings: fast"]),
        ("figures figures=[fig99]", 2, ["`figures` must be `all` or of fig5"]),
        ("train --help", 0, ["hexacopter*"]),
        ("train --cfg job system=cartpole solver=heun", 0, ["name: cartpole", "name: heun"]),
        ("completion query figures settings=", 0, ["settings=fast", "settings=full"]),
    ],
)  # fmt: skip
def test_installed_wheel_runs_its_commands_and_those_of_the_plug_ins(
    installed: dict[str, str], tmp_path: Path, words: str, status: int, told: list[str]
) -> None:
    script = Path(installed["PYTHONPATH"]) / "bin" / "nsde"
    how = {"capture_output": True, "text": True, "cwd": tmp_path, "env": installed, "check": False}
    done = subprocess.run([sys.executable, str(script), *words.split()], **how)
    assert done.returncode == status, done.stderr
    assert [text for text in told if text not in (done.stderr if status else done.stdout)] == []
