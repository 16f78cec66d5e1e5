"""What every test starts from: one torch thread, a folder of its own for caches, no figures on a screen."""

import gc
import os
from collections.abc import Iterator
from contextlib import suppress
from copy import copy
from pathlib import Path
from typing import Any

import pytest

with suppress(ImportError):
    import setuptools  # noqa: F401  torch's compiler imports it, and warns where distutils came before it

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

ROOT = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--regenerate", action="store_true", help="write the files of tests/golden anew")


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """More threads make small rollouts slower, up to a thousand times on a busy machine."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session", autouse=True)
def _imports_are_no_garbage(_one_torch_thread: None) -> None:
    """Collections pass over what was imported, which takes a quarter of a second each time that they look."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _sources_of_configurations_are_shared() -> None:
    """Hydra copies the store of all schemas for each command, which is a quarter of the time of a short one."""
    from hydra._internal.config_repository import ConfigRepository

    # what is changed of a copy is which list of sources it has
    ConfigRepository.__deepcopy__ = lambda self, memo: copy(self)  # type: ignore[attr-defined]


@pytest.fixture(scope="module", autouse=True)
def _blank_pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Pictures are files of one white dot: drawing them is two thirds of the time of a small training or diagnosis.

    Modules marked `drawn` draw theirs: those whose claim is a picture, and one run of each command from end to end.
    """
    from matplotlib.figure import Figure

    draw = Figure.savefig

    def blank(figure: Figure, to: Any, **how: Any) -> None:
        film = how.get("format") == "rgba"  # whose frames have one size
        draw(figure if film else Figure(figsize=(0.1, 0.1)), to, **(how if film else {**how, "dpi": 10}))

    with pytest.MonkeyPatch.context() as patch:
        if not any(mark.name == "drawn" for mark in request.node.iter_markers()):
            patch.setattr(Figure, "savefig", blank)
        yield


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def published(root: Path) -> Path:
    """The authors' published data, which lie beside the checkout where they are at hand."""
    folder = root.parent / "shared" / "data" / "published"
    if not folder.is_dir():
        pytest.skip("needs the published data in ../shared/data/published")
    return folder


@pytest.fixture(scope="session")
def compiler() -> None:
    """A C++ compiler, without which torch compiles nothing."""
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler:
        pytest.skip("needs a C++ compiler")


@pytest.fixture(autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Caches of simulated data go to a folder of the test session, never to the user's."""
    monkeypatch.setenv("NSDE_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
