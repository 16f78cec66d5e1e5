"""Files of controllers: the same bytes for the same controller, the same plans as the controller, and refusals."""

import json
from pathlib import Path

import pytest
import torch

from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError, ExportError
from nsde_torch.export import container, verify
from nsde_torch.export.exported import ExportedController
from nsde_torch.export.step import STAGES, STATUS, WholeStep
from nsde_torch.export.write import controller_of
from nsde_torch.models import NeuralSDE
from nsde_torch.models.run_directory import save
from nsde_torch.systems import System
from tests.helpers.exported import made_with, step_of, written

OPTIONS = made_with(dtype=torch.float32)


@pytest.fixture(scope="module")
def run_dir(model: NeuralSDE, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory of a model that nobody trained."""
    folder = tmp_path_factory.mktemp("run")
    save(model, folder)
    return folder


@pytest.fixture(scope="module")
def file(model: NeuralSDE, run_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("file")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "0")
        return written(model, folder / "controller.ts", run=run_dir, **OPTIONS)


@pytest.mark.slow
def test_a_file_plans_as_its_controller_and_stands_whatever_it_is_given(
    file: Path, model: NeuralSDE, path: Reference
) -> None:
    exported, out = ExportedController(file), verify.Verification()
    controller = controller_of(model, **OPTIONS)
    samples = verify.along(exported, path, 100, period=0.02)
    verify.compare(exported, controller, samples, out, elapsed=0.02)
    verify.attack(exported, path, 300, out)
    assert out.passed, (out.worst, out.differing, out.unsafe)
    assert out.cost_ratio < 1e-4
    assert {"bad_state:kept", "converged"} <= set(out.words)
    assert out.as_dict()["states"] == 100
    assert len(verify.histogram(out.wall_ms).splitlines()) == 12


def test_what_differs_and_what_is_unsafe_fails() -> None:
    good = verify.Verification(states=1)
    assert good.passed
    assert not verify.Verification(worst=2e-4).passed
    assert not verify.Verification(differing=["sample 1"]).passed
    assert not verify.Verification(unsafe=["sample 1"]).passed


def test_a_file_predicts_as_its_model(file: Path, model: NeuralSDE) -> None:
    exported = ExportedController(file)
    controller = controller_of(model, **OPTIONS)
    assert exported.sample.dt == 0.01
    assert exported.sample.ports == controller.predictor.ports
    assert torch.allclose(exported.hover, controller.hover)
    still = controller.hovering()
    z = exported.sample(still.z[0, 0, :2], still.u[0, :2] + 0.01, torch.zeros(2, 6))
    assert z.shape == (2, 13)
    assert float(z[0, 5]) > 0.0


def _refused(path: Path, why: str) -> None:
    with pytest.raises(ExportError, match=why):
        ExportedController(path)


def test_damaged_files_are_refused_with_the_reason(file: Path, tmp_path: Path) -> None:
    content, bad = file.read_bytes(), tmp_path / "bad.ts"
    code = content.index(b"def step")
    for damaged in (
        content[: len(content) // 2],
        b"no archive",
        content[: code + 4] + b"S" + content[code + 5 :],
    ):
        bad.write_bytes(damaged)
        _refused(bad, "truncated or damaged|was changed")
    _refused(tmp_path / "none.ts", "no file")


def _rewritten(file: Path, out: Path, **changed: object) -> Path:
    """A file with another record, whose hash fits."""
    members = container.members_of(file.read_bytes())
    about = json.loads(members.pop(container.RECORD))
    container.write(out, members, {k: v for k, v in {**about, **changed}.items() if k != "sha256"})
    return out


def test_files_that_were_changed_or_are_of_another_version_are_refused(file: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.ts"
    members = container.members_of(file.read_bytes())
    name = next(n for n in members if n.startswith("constants/") and len(members[n]) > 100)
    members[name] = members[name][:-1] + bytes([members[name][-1] ^ 1])
    bad.write_bytes(container.archive_of(members))
    _refused(bad, "was changed after it was written")
    _refused(_rewritten(file, bad, format="nsde_torch controller/0"), "of the format")
    _refused(_rewritten(file, bad, versions={"torch": "1.13.0", "nsde_torch": "0.1.0"}), "torch 1.13.0")
    _refused(_rewritten(file, bad, kind="else"), "of the kind 'else'")
    _refused(_rewritten(file, bad, kind="aoti", processor="Linux 8086"), "compiled for Linux 8086")
    _refused(_rewritten(file, bad, status=["fine"]), "other words")
    _refused(_rewritten(file, bad, sizes=None), "another version")
    del members[container.RECORD]
    bad.write_bytes(container.archive_of(members))
    _refused(bad, "no exported controller")


def test_what_a_file_cannot_hold_is_refused(declared: System, tmp_path: Path) -> None:
    out = tmp_path / "c.ts"
    with pytest.raises(ConfigError, match="needs a clock"):
        written(declared, out, **{**OPTIONS, "solver": SolverOptions(deadline=0.01)})
    with pytest.raises(ConfigError, match="torchscript, aoti or c"):
        written(declared, out, kind="onnx", **OPTIONS)
    with pytest.raises(ConfigError, match="gauss_newton"):
        written(declared, out, **made_with(solver="apg"))
    assert not out.exists()


def test_a_state_that_is_not_valid_is_bad_whatever_it_says(declared: System) -> None:
    step = step_of(controller_of(declared, **OPTIONS), declared)
    arguments = step.first()
    arguments[1] = torch.zeros((), dtype=torch.float64)
    with torch.no_grad():
        out = WholeStep({name: step.stage(name) for name in STAGES}, step.loops).step(*arguments)
    assert STATUS[int(out[7])] == "bad_state:hover"
    assert all(bool(torch.isfinite(out[k]).all()) for k in (0, 1, 2, 3, 4))
