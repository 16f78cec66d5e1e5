"""Imports point one way, and listing the commands imports nothing heavy."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

# Each part may import itself and what it names here.
TOOLS = ("cache", "lazy", "progress", "recall", "texts", "threads", "time_limit", "whole_files")
ALONE = ("aligned", "arrays", "errors", *TOOLS)
ONLY_ERRORS = ("options", "columns", "lookup", "plain_yaml", "shown")
BASE = {*ALONE, *ONLY_ERRORS, "jit", "rotation"}
MACHINES = {*BASE, "systems", "effects"}
LEARNED = {*MACHINES, "data", "recording", "sde", "models", "plots"}
TRAINED = {"inference", "sysid", "evaluation", "training"}
MAY_IMPORT = {
    **{name: set() for name in ALONE},
    **{name: {"errors"} for name in ONLY_ERRORS},
    "jit": {"progress"},
    "rotation": {"errors", "columns"},
    "plots": {*MACHINES, "data"},
    "effects": {*BASE, "systems"},
    "systems": {*BASE, "effects"},
    "data": MACHINES,
    "recording": {*MACHINES, "data"},
    "sde": {*MACHINES, "data"},
    "models": {*MACHINES, "data", "recording", "sde", "plots"},
    "inference": {*MACHINES, "data", "sde"},
    "sysid": {*LEARNED, "inference"},
    "evaluation": {*LEARNED, "inference", "sysid"},
    "training": {*LEARNED, "inference", "sysid", "evaluation"},
    "control": LEARNED,
    "simulation": {*LEARNED, "control"},
    "policy": {*LEARNED, "simulation"},
    "api": {*LEARNED, *TRAINED, "simulation", "diagnosis"},
    "diagnosis": {*LEARNED, *TRAINED, "control"},
    "design": {*LEARNED, "inference", "sysid", "diagnosis", "control"},
    "px4": {*LEARNED, "control", "export", "simulation"},
    "export": {*LEARNED, "control"},
}
INSIDE_PX4 = {"link": (), "flight": ("link",), "simulator": ("link", "flight")}
"""Folder of `px4` -> the others that it may import; the simulator of machines is for the simulated autopilot alone."""
FORBIDDEN = {"hydra", "omegaconf", "hydra_plugins", "cli", "conf", "tests", "nsde_benchmarks"}


def _modules(root: Path) -> list[Path]:
    return sorted((root / "nsde_torch").rglob("*.py"))


@cache
def _imports(path: Path, package: str) -> tuple[str, ...]:
    """Dotted names that a file imports, at the top or inside functions, relative ones resolved."""
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            name = ".".join([*parents, *([node.module] if node.module else [])])
            names += [name, *(f"{name}.{alias.name}" for alias in node.names)]
    return tuple(names)


def _package(root: Path, path: Path) -> str:
    return ".".join(path.relative_to(root).parent.parts)


def _part(name: str) -> str | None:
    """`nsde_torch.sde.steps` belongs to `sde`; the package itself belongs to none."""
    pieces = name.split(".")
    return pieces[1] if pieces[0] == "nsde_torch" and len(pieces) > 1 else None


def test_imports_inside_the_package_point_one_way_and_never_to_hydra_commands_or_tests(root: Path) -> None:
    wrong = []
    for path in _modules(root):
        part = path.relative_to(root / "nsde_torch").parts[0].removesuffix(".py")
        face = part == "__init__"  # which gathers names from everywhere
        for name in _imports(path, _package(root, path)):
            other = _part(name)
            astray = other in MAY_IMPORT and not face and other not in {part, *MAY_IMPORT[part]}
            if astray or name.split(".")[0] in FORBIDDEN or other in FORBIDDEN:
                wrong.append(f"{path.relative_to(root)} imports {name}")
    assert not wrong
    for path in (root / "cli").rglob("*.py"):
        assert "nsde_benchmarks" not in path.read_text(encoding="utf-8"), path


def test_inside_px4_the_link_knows_no_flight_and_neither_knows_the_simulator(root: Path) -> None:
    wrong, looked = [], 0
    for folder, allowed in INSIDE_PX4.items():
        for path in sorted((root / "nsde_torch" / "px4" / folder).glob("*.py")):
            looked += 1
            for name in _imports(path, _package(root, path)):
                pieces = name.split(".")
                other = pieces[2] if pieces[:2] == ["nsde_torch", "px4"] and len(pieces) > 2 else folder
                simulates = folder != "simulator" and _part(name) == "simulation"
                if simulates or (other in INSIDE_PX4 and other not in (folder, *allowed)):
                    wrong.append(f"{path.relative_to(root)} imports {name}")
    assert looked > 20
    assert not wrong


def test_the_order_has_no_cycle_but_systems_and_effects() -> None:
    cycles = {
        frozenset((part, other))
        for part, allowed in MAY_IMPORT.items()
        for other in allowed
        if part in MAY_IMPORT[other]
    }
    assert cycles == {frozenset(("systems", "effects"))}


def test_third_party_imports_are_declared_dependencies(root: Path) -> None:
    text = (root / "pyproject.toml").read_text(encoding="utf-8")
    declared = text[text.index("dependencies = [") : text.index("[project.optional-dependencies]")].lower()
    extra = text[text.index("\npolicy = [") : text.index("\ndev = [")].lower()
    own_name = {"yaml": "pyyaml", "hydra": "hydra-core", "serial": "pyserial"}
    missing = set()
    beside = [*(root / "cli").rglob("*.py"), *(root / "benchmarks" / "nsde_benchmarks").rglob("*.py")]
    for path in [*_modules(root), *sorted(beside)]:
        package = _package(root, path)
        for name in _imports(path, package if package.startswith("nsde_torch") else f"nsde_torch.{package}"):
            top = name.split(".")[0]
            if top in sys.stdlib_module_names or top in ("nsde_torch", "nsde_benchmarks", "__future__", ""):
                continue
            extras = ("policy", "diagnosis", "formats", "serving")
            allowed = declared + extra if path.parent.name in extras else declared
            if f'"{own_name.get(top, top).replace("_", "-")}' not in allowed.replace("_", "-"):
                missing.add(f"{path.relative_to(root)} imports {top}")
    assert not missing


LIGHT = "torch hydra omegaconf numpy"
MAIN = "from nsde_torch.cli.main import main; main({})"


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import nsde_torch", "torch"),
        (MAIN.format([]), f"{LIGHT} yaml"),
        (MAIN.format(["--help"]), f"{LIGHT} yaml"),
        (MAIN.format(["train", "--help"]), LIGHT),
        (MAIN.format(["completion", "query", "train", "sys"]), LIGHT),
        (MAIN.format(["sweep-report", "."]), LIGHT),
        (MAIN.format(["train", "trainer.steps=few"]), "torch scipy"),
        (MAIN.format(["diagnose", "alhpa=0.1"]), "torch scipy"),
    ],
)
def test_light_things_stay_light(statement: str, absent: str, tmp_path: Path) -> None:
    check = f"; import sys; bad = [m for m in {absent.split()} if m in sys.modules]; assert not bad, bad"
    command = [sys.executable, "-c", statement + check]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
