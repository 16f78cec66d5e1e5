"""The compiled path gives the eager numbers, and gives way to eager steps where nothing can be compiled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nsde_torch.sde import brownian, make_step, rollout
from tests.helpers.sde_problems import SmallNetwork


def case(batch: int, particles: int = 2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(batch)
    noise = brownian(particles, batch, 4, 3, dt=0.1, generator=g)
    z0, u = torch.randn(batch, 3, generator=g), torch.randn(batch, 4, 2, generator=g)
    return z0, u, noise, torch.rand(batch, generator=g)


@pytest.mark.usefixtures("compiler")
@pytest.mark.parametrize("name", ["milstein", "milstein_ito"])
@pytest.mark.slow
def test_compiled_and_eager_rollouts_agree_in_value_and_gradient(name: str) -> None:
    sde, step = SmallNetwork(), make_step(name)
    for batch in (5, 8):

        def run(compile: bool, batch: int = batch) -> tuple[Tensor, ...]:
            z0, u, noise, t0 = case(batch)
            u.requires_grad_()
            path = rollout(sde, z0, u, dt=0.1, step=step, noise=noise, t0=t0, compile=compile)
            return path, *torch.autograd.grad(path.square().sum(), [u, *sde.parameters()])

        for fast, slow in zip(run(True), run(False), strict=True):
            assert torch.allclose(fast, slow, rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("compiler")
@pytest.mark.slow
def test_a_new_time_or_dt_compiles_nothing_new() -> None:
    sde, step = SmallNetwork(), make_step("euler_maruyama")
    z0, u, noise, _ = case(6)
    with torch.no_grad():
        rollout(sde, z0, u, dt=0.1, step=step, noise=noise, compile=True)
        with torch._dynamo.config.patch(error_on_recompile=True):
            fast = rollout(sde, z0, u, dt=0.05, step=step, noise=noise, t0=3.0, compile=True)
        assert torch.allclose(fast, rollout(sde, z0, u, dt=0.05, step=step, noise=noise, t0=3.0), atol=1e-5)


WITHOUT_COMPILER = """
import warnings, torch
from nsde_torch.sde import brownian, make_step, rollout
from tests.helpers.sde_problems import SmallNetwork, SquareRoot
g = torch.Generator().manual_seed(0)
noise, z0, u = brownian(1, 4, 3, 3, dt=0.1, generator=g), torch.randn(4, 3), torch.randn(4, 3, 2)
sde, step = SmallNetwork(), make_step("milstein")
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    paths = [rollout(sde, z0, u, dt=0.1, step=step, noise=noise, compile=on) for on in (True, True, False)]
assert torch.equal(paths[0], paths[2]) and torch.equal(paths[1], paths[2])
ours = [str(w.message) for w in caught if w.category.__name__ == "CompilationWarning"]
assert len(ours) == 1, ours
print(ours[0])
"""


@pytest.mark.slow
def test_without_a_compiler_the_rollout_runs_eagerly_with_one_warning(root: Path, tmp_path: Path) -> None:
    none = {"CXX": str(tmp_path / "no-compiler"), "PATH": str(tmp_path), "PYTHONPATH": str(root)}
    environment = {**os.environ, **none, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache")}
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_COMPILER], env=environment, capture_output=True, text=True, cwd=root
    )
    assert result.returncode == 0, result.stderr[-2000:]
    assert "runs without compilation" in result.stdout
    assert "C++ compiler" in result.stdout
