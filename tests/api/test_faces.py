"""Every package says what is public, and each name is what it says."""

import ast
from importlib import import_module
from pathlib import Path
from types import FunctionType

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "nsde_torch").rglob("__init__.py"))
PACKAGES = [".".join(file.parent.relative_to(ROOT).parts) for file in FILES]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_says_what_is_public_and_has_it(package: str) -> None:
    module = import_module(package)
    assert module.__doc__
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        found = getattr(module, name)
        assert not isinstance(found, type | FunctionType) or found.__doc__, name


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_are_told_the_names_that_are_resolved(package: str) -> None:
    folder = ROOT.joinpath(*package.split("."))
    tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
    told = {
        alias.asname or alias.name: f"{node.module}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("nsde_torch.")
        for alias in node.names
        if alias.name != "resolver"
    }
    public = set(import_module(package).__all__) - {"__version__"}
    assert set(told) == public
    homes = [node for node in ast.walk(tree) if isinstance(node, ast.Dict)]
    if homes:
        resolved = ast.literal_eval(homes[-1])
        assert {name: f"{package}.{home}" for name, home in resolved.items()} == told
    if hasattr(import_module(package), "__getattr__"):  # else imported as a whole: the name has the last word
        assert not public & {path.stem for path in folder.iterdir()}


def test_a_name_that_is_not_public_is_none() -> None:
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        import_module("nsde_torch").trian  # noqa: B018
