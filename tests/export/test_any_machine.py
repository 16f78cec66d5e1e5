"""Controllers of machines that do not fly, as files: what they do is what the controller in Python does."""

import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch

from nsde_torch.control.compiled import compiler
from nsde_torch.control.controller import ANEW, Controller
from nsde_torch.control.problem import problem_of
from nsde_torch.control.reference import setpoint
from nsde_torch.control.solve import SolverOptions
from nsde_torch.export import verify
from nsde_torch.export.exported import ExportedController
from nsde_torch.export.write import controller_of
from nsde_torch.systems import System, make_plant_system
from tests.helpers.exported import made_with, written

pytestmark = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
HANGING, UP = {"theta": 3.1}, {"theta": 0.0}
ARM = "examples.double_pendulum.double_pendulum:DoublePendulum"


@pytest.fixture(scope="module")
def cart() -> System:
    return make_plant_system("cartpole", declared_only=True)


def exported(
    known: System, path: Path, kind: str = "c", *, name: str | None = None, **ends: Any
) -> tuple[ExportedController, Controller]:
    made = {**made_with(), "problem": problem_of(known, **(ends or {"low": -10.0, "high": 10.0}))}
    made["solver"] = SolverOptions(iterations=4)
    file = ExportedController(written(known, path, kind=kind, name=name, latency=0.0, **made))
    return file, controller_of(known, **made)


@pytest.mark.parametrize(
    ("name", "kind"), [("cart.c", "c"), pytest.param("cart.ts", "torchscript", marks=pytest.mark.slow)]
)
def test_a_swing_up_is_planned_as_in_python_also_anew_from_rest_and_in_trouble(
    cart: System, tmp_path: Path, name: str, kind: str
) -> None:
    file, controller = exported(cart, tmp_path / name, kind)
    o, noise = file.options, torch.Generator().manual_seed(0)
    ahead = setpoint(cart, UP, duration=1.0).window(0.0, dt=o.dt, steps=o.steps)[None]
    x = setpoint(cart, HANGING, duration=1.0).states[:1]
    before, words = None, set()
    for k in range(2 * ANEW):
        x = x + 0.02 * torch.randn(x.shape, generator=noise, dtype=torch.float64)
        if k == 17:
            x[0, 1] = torch.nan
        ours = file.plan(x, ahead, before, elapsed=0.02)
        before = controller.plan(x, ahead, before, elapsed=0.02)
        assert ours.status == before.status
        assert torch.allclose(ours.u, before.u, atol=1e-9)
        assert torch.allclose(ours.x, before.x, atol=1e-9)
        words |= set(ours.status)
        z = before.z[:, 0, 0]
        for _ in range(2):
            z = file.sample(z, before.u[:, 0], torch.zeros(1, file.sizes.nd))
        x = z[:, : cart.nx]
    assert "bad_state:kept" in words
    assert controller._solves == file._solves == 2 * ANEW - 1
    names = [entry["name"] for entry in file.record["step"]["outputs"]]
    assert names == ["inputs", "states", "cost", "gap", "status", "iterations", "after"]


@pytest.mark.slow
def test_each_input_has_limits_of_its_own_in_a_file_too(tmp_path: Path) -> None:
    arm = make_plant_system(ARM)
    file, controller = exported(arm, tmp_path / "arm.c", name=ARM, low=(-4.0, -0.5), high=(4.0, 1.0))
    assert file.options == controller.options
    path, out = setpoint(arm, {}, duration=2.0), verify.Verification()
    x, ahead = torch.tensor([1.0, 1.0, -6.0, 6.0], dtype=torch.float64), path.window(0.0, dt=0.05, steps=20)
    verify.compare(file, controller, [(x, ahead)] * 3, out, elapsed=0.02)
    assert out.passed
    assert out.worst < 1e-8
    u = file.plan(x[None], ahead[None]).u[0]
    assert (u.amin(0).tolist(), u.amax(0).tolist()) == ([-4.0, -0.5], [4.0, 1.0])
    verify.attack(file, path, 60, out)
    assert not out.unsafe
    assert "tau1 within [-4, 4], tau2 within [-0.5, 1]" in (tmp_path / "arm.h").read_text()


@pytest.mark.parametrize("precision", ["NSDE_DOUBLE", "NSDE_FLOAT"])
def test_the_file_in_c_compiles_without_a_warning(cart: System, tmp_path: Path, precision: str) -> None:
    exported(cart, tmp_path / "cart.c")
    flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-D{precision}")
    subprocess.run([str(compiler()), *flags, "-c", "cart.c", "-o", "cart.o"], cwd=tmp_path, check=True)
    header = (tmp_path / "cart.h").read_text()
    for part in ("within [-10, 10]", " 9  diverged, rest", "force, 1 axis, torque, 1 axis"):
        assert part in header
    assert "rates[3]" not in header


def test_a_file_stands_numbers_that_no_sensor_should_send(cart: System, tmp_path: Path) -> None:
    file, _ = exported(cart, tmp_path / "cart.c")
    out = verify.Verification()
    verify.attack(file, setpoint(cart, UP, duration=2.0), 400, out)
    assert out.adversarial == 400
    assert not out.unsafe
