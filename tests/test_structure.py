"""The house: one class to a name, and control without a simulator."""

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path


def _files(root: Path, *folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((root / folder).rglob("*.py"))]


def test_no_public_class_shares_its_name(root: Path) -> None:
    homes = defaultdict(list)
    for path in _files(root, "nsde_torch", "cli", "benchmarks/nsde_benchmarks"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(path.relative_to(root).as_posix())
    assert len(homes) > 300
    assert not {name: files for name, files in homes.items() if len(files) > 1}


def test_what_flies_a_machine_loads_no_simulator(root: Path) -> None:
    modules = []
    for part in ("control", "export", "px4.flight", "px4.link"):
        paths = sorted(root.joinpath("nsde_torch", *part.split(".")).glob("*.py"))
        modules += [f"nsde_torch.{part}.{path.stem}" for path in paths if path.stem != "__init__"]
        assert len(paths) > 6
    code = (
        "import importlib, sys\n"
        f"for name in {modules!r}:\n"
        "    importlib.import_module(name)\n"
        "    bad = [other for other in sys.modules if other.startswith('nsde_torch.simulation')]\n"
        "    assert not bad, (name, bad)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_case_that_a_comment_names_exists(root: Path) -> None:
    """A rule names the test or the study whose answer gets worse without it."""
    tests = list((root / "tests").rglob("*.py"))
    names = {path.name for path in (*(root / "benchmarks").rglob("*.py"), *tests)}
    written = "".join(path.read_text() for path in tests)
    cases = set(re.findall(r"def (test_\w+)", written)) | {name[:-3] for name in names}
    lost = []
    for path in _files(root, "nsde_torch", "cli"):
        text = path.read_text()
        files = set(re.findall(r"\b(?:test|bench)_\w+\.py\b", text)) - names
        cited = set(re.findall(r"\btest_\w{16,}\b", text))
        lost += [f"{path}: {name}" for name in sorted(files | (cited - cases))]
    assert lost == []
